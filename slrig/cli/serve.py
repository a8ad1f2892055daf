"""`slrig serve`: the service as a command. Loads nothing heavy before it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slrig.cli.options import RigFile, given
from slrig.cli.pool import Certificates, Store


def serve(
    rig: RigFile,
    host: Annotated[str | None, typer.Option(help="Address to listen on. Default 127.0.0.1: this machine.")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 takes any free one. Default 8731.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder for scans and records. Default: ~/.local/share/slrig.")
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="TOML file with settings of the service.")] = None,
    compute: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a pool that reconstructs, tls://HOST:PORT.")
    ] = None,
    store: Store = None,
    certificates: Certificates = None,
    allow_host: Annotated[
        list[str] | None, typer.Option(help="A name by which clients may call this machine; may be repeated.")
    ] = None,
    new_key: Annotated[bool, typer.Option("--new-key", help="Make a new API key; the old one stops working.")] = False,
    no_key: Annotated[bool, typer.Option("--no-key", help="Ask for no API key; only on this machine.")] = False,
    until_eof: Annotated[bool, typer.Option("--until-eof", help="Stop when standard input ends.")] = False,
) -> None:
    """Start the service: it holds the rig and scans over HTTP."""
    from slrig.api.server import serve as run_service
    from slrig.config import read_rig, read_settings

    told = given(
        host=host,
        port=port,
        data_dir=data,
        allowed_hosts=tuple(allow_host or ()) or None,
        require_key=False if no_key else None,
        compute=compute,
        compute_store=store,
        compute_certificates=certificates,
    )
    run_service(read_settings(settings, **told), read_rig(rig), new_key=new_key, until_eof=until_eof, say=typer.echo)

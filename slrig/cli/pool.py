"""`slrig pool` and `slrig worker`: machines that reconstruct for rigs. Loads nothing heavy before it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slrig.cli.options import given

app = typer.Typer(invoke_without_command=True, help="Schedule what a pool of machines reconstructs for rigs.")

Certificates = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="This machine's certificates, as slrig pool certificates makes them."),
]
Store = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Where bundles and results travel: s3://BUCKET/PREFIX, or file:///FOLDER."),
]
Settings = Annotated[Path | None, typer.Option(help="TOML file with settings of the service.")]


@app.callback()
def pool(
    ctx: typer.Context,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes any free one.")] = 8786,
    certificates: Certificates = None,
    settings: Settings = None,
) -> None:
    """Be the scheduler of a pool: machines that reconstruct for many rigs.

    With certificates, over TLS; without, for 127.0.0.1 alone.
    """
    if ctx.invoked_subcommand is not None:
        return
    from slrig.compute.security import pool_security, require_pool_extra
    from slrig.config import read_settings
    from slrig.logs import set_up_logs

    chosen = read_settings(settings, **given(compute_certificates=certificates))
    require_pool_extra()
    from slrig.compute.serving import serve_scheduler

    set_up_logs(chosen.log_level, chosen.log_format)
    scheme = "tcp" if chosen.compute_certificates is None else "tls"
    address = f"{scheme}://{host}:{port}"
    serve_scheduler(address, pool_security(address, chosen.compute_certificates), say=typer.echo)


@app.command()
def certificates(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where they are made, on a machine that is safe.")],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Machines. Default: scheduler worker rig.", show_default=False),
    ] = None,
) -> None:
    """Make an authority, and for each machine a folder.

    Copy each folder to its machine, and nothing else. Called again, it makes those of further names.
    """
    from slrig.compute.security import require_pool_extra

    require_pool_extra()
    from slrig.compute.certificates import make_certificates

    for place in make_certificates(folder, names or ("scheduler", "worker", "rig")):
        typer.echo(place)


def worker(
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Scheduler of the pool, tls://HOST:PORT.")
    ] = None,
    store: Store = None,
    certificates: Certificates = None,
    settings: Settings = None,
) -> None:
    """Reconstruct for the rigs of a pool, one scan at a time."""
    from slrig.compute.security import pool_security, require_pool_extra
    from slrig.config import read_settings
    from slrig.errors import ConfigError
    from slrig.logs import set_up_logs

    options = given(compute=scheduler, compute_store=store, compute_certificates=certificates)
    chosen = read_settings(settings, **options)
    if chosen.compute is None or chosen.compute_store is None:
        message = "A worker needs the pool's scheduler and its store: give --scheduler and --store."
        raise ConfigError(message)
    require_pool_extra()
    from slrig.compute.serving import serve_worker
    from slrig.compute.store import open_store

    set_up_logs(chosen.log_level, chosen.log_format)
    security = pool_security(chosen.compute, chosen.compute_certificates)
    place = open_store(chosen.compute_store, chosen.compute_login_file)
    serve_worker(chosen.compute, security, place, cache=chosen.data_dir / "cache", say=typer.echo)

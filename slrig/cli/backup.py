"""`slrig backup` and `slrig restore`. Loads nothing heavy before it runs: `slrig --help` reads this file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slrig.cli.options import AsJson, given

if TYPE_CHECKING:
    from slrig.jobs.backup import Manifest


def backup(
    to: Annotated[Path, typer.Argument(metavar="TO", help="New folder for the backup, best on another disk.")],
    data: Annotated[Path | None, typer.Option(help="The data folder. Default: that of slrig serve.")] = None,
    settings: Annotated[Path | None, typer.Option(help="TOML file with settings of the service.")] = None,
    link_previous: Annotated[
        Path | None,
        typer.Option(metavar="BACKUP", help="Earlier backup on the same disk: files as they were then are linked."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Copy all data of a service, while it runs.

    Records, scans that have ended, calibrations, acceptance tests.
    """
    from slrig.config import read_settings
    from slrig.jobs.backup import back_up

    folder = read_settings(settings, **given(data_dir=data)).data_dir
    _tell(back_up(folder, to, previous=link_previous), f"backup of {folder} in {to}", as_json=as_json)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="A backup.")],
    data: Annotated[Path, typer.Option(help="The data folder to make: new, or empty.")],
    as_json: AsJson = False,
) -> None:
    """Make a data folder of a backup.

    Every byte is checked first; nothing is overwritten.
    """
    from slrig.jobs.backup import restore as restore_backup

    _tell(restore_backup(source, data), f"{data} made from {source}", as_json=as_json)


def _tell(manifest: Manifest, what: str, *, as_json: bool) -> None:
    if as_json:
        from slrig.cli.display import print_json

        print_json(
            {
                "made_at": manifest.made_at.isoformat(),
                "scans": manifest.scans,
                "files": len(manifest.files),
                "size_bytes": manifest.size_bytes,
                "left_out": list(manifest.left_out),
            }
        )
        return
    found = f"{manifest.scans} scans, {len(manifest.files)} files, {manifest.size_bytes / 1e6:.1f} MB"
    typer.echo(f"{what}: {found}, as of {manifest.made_at:%Y-%m-%d %H:%M} UTC")
    for each in manifest.left_out:
        typer.echo(f"left out: {each}", err=True)

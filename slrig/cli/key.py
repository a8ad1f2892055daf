"""`slrig key`: who may use a service. Works on its data folder, on the machine where that lies."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slrig.api.scopes import Scope
from slrig.cli.options import AsJson, given, grouped

if TYPE_CHECKING:
    from slrig.api.keys import KeyRing

app = typer.Typer(no_args_is_help=True, help="Who may use a service, and what for.")

Data = Annotated[
    Path | None,
    typer.Option(
        help="Data folder of the service. Default: SLRIG_DATA_DIR, or ~/.local/share/slrig.", show_default=False
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Whose key it is: a person, or a program.")]


def _ring(data: Path | None) -> KeyRing:
    from slrig.api.keys import KeyRing
    from slrig.config import read_settings

    path = read_settings(None, **given(data_dir=data)).key_path
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    return KeyRing(path)


@app.command()
@grouped
def add(
    *,
    name: Name,
    scope: Annotated[
        list[Scope] | None,
        typer.Option(help="What for; may be repeated. Every key may look. Default: scan."),
    ] = None,
    days: Annotated[float | None, typer.Option(min=0.001, help="After how many days it ends. Default: never.")] = None,
    data: Data = None,
) -> None:
    """Make a key, and show it once.

    A running service takes it at once. Scopes: look reads everything, scan scans and looks through cameras, calibrate
    also shoots poses, solves, verifies and tests, administer schedules and reads the audit record.
    """
    life = None if days is None else timedelta(days=days)
    typer.echo(_ring(data).add(name, scope or [Scope.SCAN], life=life))


@app.command(name="list")
@grouped
def list_keys(data: Data = None, as_json: AsJson = False) -> None:
    """List the keys: whose, what for, until when. The keys themselves are kept nowhere."""
    from slrig.cli.display import print_json, print_table
    from slrig.jobs.records import utc_now

    keys = _ring(data).everybody
    if as_json:
        print_json({"keys": [key.model_dump(mode="json", exclude={"digest"}) for key in keys]})
        return
    if not keys:
        typer.echo("no keys; make one with: slrig key add NAME")
        return
    rows = [
        (
            key.name,
            " ".join(key.scopes),
            f"{key.created_at:%Y-%m-%d}",
            key.fault(utc_now()) or ("" if key.expires_at is None else f"until {key.expires_at:%Y-%m-%d}"),
        )
        for key in keys
    ]
    print_table(("name", "scopes", "made", "state"), rows)


@app.command()
@grouped
def revoke(name: Name, data: Data = None) -> None:
    """Have a key open nothing any more, from the next request on."""
    _ring(data).revoke(name)
    typer.echo(f"the key of '{name}' opens nothing any more")

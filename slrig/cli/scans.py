"""`slrig scans`: list, rename, delete and fetch the scans that a service has on record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slrig.cli.options import AsJson, ServiceOptions, given, grouped
from slrig.errors import ConfigError, JobNotFoundError, ServiceError

if TYPE_CHECKING:
    from slrig.client import Client

app = typer.Typer(no_args_is_help=True, help="Scans on record: find, rename, fetch, delete.")

Scan = Annotated[str, typer.Argument(metavar="SCAN", help="Name of the scan, or the beginning of its id.")]
SomeScans = Annotated[list[str], typer.Argument(metavar="SCAN", help="Names, or beginnings of ids.")]
_PAGE = 200


@app.command(name="list")
@grouped
def list_scans(
    *,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A part of the name, or the beginning of the id.")
    ] = None,
    state: Annotated[list[str] | None, typer.Option(help="Such as succeeded or failed; may be repeated.")] = None,
    since: Annotated[datetime | None, typer.Option(help="Created then or later, by the clock here.")] = None,
    until: Annotated[datetime | None, typer.Option(help="Created before, by the clock here.")] = None,
    rig: Annotated[str | None, typer.Option(help="Name of the rig that scanned.")] = None,
    preset: Annotated[str | None, typer.Option(help="Name of the requested preset.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many, from the newest.")] = 20,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """List scans, the newest first."""
    from rich.table import Column

    from slrig.cli.display import print_json, print_table

    begin, end = (None if each is None else each.astimezone().isoformat() for each in (since, until))
    named = given(name=name, state=state, since=begin, until=end, rig=rig, preset=preset)
    with service.client() as client:
        found = [each for each, _ in zip(_listed(client, limit=min(limit, _PAGE), **named), range(limit), strict=False)]
    if as_json:
        print_json({"scans": found})
        return
    if not found:
        typer.echo("no such scan" if named else "no scans; make one with: slrig scan --output FOLDER")
        return
    heads = ("id", "name", "created", "state", Column("triangles", justify="right"), Column("σ mm", justify="right"))
    print_table(heads, [_row(each) for each in found])


@app.command()
@grouped
def rename(
    scan: Scan,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Its new name; '' takes the name away.")],
    service: ServiceOptions,
) -> None:
    """Give a scan another name."""
    with service.client() as client:
        client.scans.rename(_chosen(client, scan)["id"], name or None)


@app.command()
@grouped
def fetch(
    *,
    scans: SomeScans,
    output: Annotated[Path, typer.Option(help="Folder for the files.")] = Path(),
    file: Annotated[
        list[str] | None, typer.Option(help="File of each scan, such as mesh.stl; may be repeated. Default: mesh.ply.")
    ] = None,
    service: ServiceOptions,
) -> None:
    """Fetch files of scans, each called RIG-NAME-FILE."""
    from slrig.disk import storage_errors

    with service.client() as client:
        found = [client.scans.get(_chosen(client, each)["id"])["links"] for each in scans]
        for links in found:
            for name in file or ["mesh.ply"]:
                if name not in links["files"]:
                    message = (
                        f"Scan {links['self'].rpartition('/')[2]} has no {name}. It has: {', '.join(links['files'])}."
                    )
                    raise ConfigError(message)
        with storage_errors(output):
            output.mkdir(parents=True, exist_ok=True)
        for links in found:
            for name in file or ["mesh.ply"]:
                typer.echo(client.save(links["files"][name], output))


@app.command()
@grouped
def delete(
    *,
    scans: SomeScans,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    service: ServiceOptions,
) -> None:
    """Delete scans with all their files; those that are pinned stay."""
    from slrig.cli.display import print_table

    with service.client() as client:
        found = {each["id"]: each for each in (_chosen(client, word) for word in scans)}
        pinned = [each for each in found.values() if each["pinned"]]
        if pinned:
            names = ", ".join(map(_called, pinned))
            message = f"Nothing was deleted: {names} is pinned. Unpin it first: DELETE /scan/ID/pin."
            raise ServiceError(message)
        if not yes:
            print_table(("id", "name", "created", "state", "", ""), [_row(each) for each in found.values()])
            typer.confirm(f"Delete {len(found)} with all files? Nothing brings them back.", abort=True)
        for each in found:
            client.scans.delete(each)
            typer.echo(f"deleted {_called(found[each])}")


def _row(scan: Mapping[str, Any]) -> Sequence[str]:
    created = f"{datetime.fromisoformat(scan['created_at']).astimezone():%Y-%m-%d %H:%M}"
    triangles, sigma_mm = scan["triangles"], scan["sigma_mm"]
    return (
        scan["id"][:8],
        scan["label"] or "",
        created,
        scan["state"] + (", pinned" if scan["pinned"] else ""),
        "" if triangles is None else f"{triangles:,}",
        "" if sigma_mm is None else f"{sigma_mm:.4f}",
    )


def _called(scan: Mapping[str, Any]) -> str:
    return f"{scan['label'] or 'scan'} ({scan['id'][:8]})"


def _listed(client: Client, **named: Any) -> Iterator[dict[str, Any]]:
    """The scans that match, from new to old, page after page."""
    page = client.scans.list(**named)
    yield from page["scans"]
    while page["next"] is not None:
        page = client.get(page["next"])
        yield from page["scans"]


def _chosen(client: Client, word: str) -> Mapping[str, Any]:
    """The one scan with this name or beginning of its id. Raises JobNotFoundError."""
    found = [
        each
        for each in _listed(client, name=word, limit=_PAGE)
        if each["label"] == word or each["id"].startswith(word.lower())
    ]
    if len(found) == 1:
        return found[0]
    if found:
        ids = ", ".join(each["id"][:8] for each in found[:10])
        message = f"{len(found)} scans are called '{word}': {ids}. Say the beginning of an id."
    else:
        message = f"No scan is called '{word}', and no id begins so. See: slrig scans list"
    raise JobNotFoundError(message)

"""`slrig serve`, `key`, `backup`, `restore`, `pool`, `worker`, `fleet`: run and administer services. Loads nothing
heavy before a command runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slrig.api.scopes import KeyScope
from slrig.cli.options import AsJson, RigFile, ServiceOptions, given, grouped
from slrig.disk import storage_errors
from slrig.examples import copy_example, is_example

if TYPE_CHECKING:
    from slrig.api.auth import KeyRing
    from slrig.jobs.backup import Manifest

pool_app = typer.Typer(invoke_without_command=True, help="Schedule what a pool of machines reconstructs for rigs.")

Certificates = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="This machine's certificates, as slrig pool certificates makes them."),
]
Store = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Where bundles and results travel: s3://BUCKET/PREFIX, or file:///FOLDER."),
]
Settings = Annotated[Path | None, typer.Option(help="TOML file with settings of the service.")]


@pool_app.callback()
def pool(
    ctx: typer.Context,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes any free one.")] = 8786,
    certificates: Certificates = None,
    settings: Settings = None,
) -> None:
    """Be the scheduler of a pool: machines that reconstruct for many rigs.

    Without certificates it makes some, for workers and services of the same user on this machine.
    """
    if ctx.invoked_subcommand is not None:
        return
    from slrig.compute.security import PoolAddress, pool_address, require_pool_extra
    from slrig.config import read_settings
    from slrig.logs import set_up_logs

    chosen = read_settings(settings, **given(compute_certificates=certificates))
    require_pool_extra()
    from slrig.compute.scheduler import serve_scheduler

    set_up_logs(chosen.log_level, chosen.log_format)
    place = pool_address(str(PoolAddress(host, port)), chosen.compute_certificates)
    serve_scheduler(place, say=typer.echo)


@pool_app.command()
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
    from slrig.compute.security import pool_address, require_pool_extra
    from slrig.config import read_settings
    from slrig.errors import ConfigError
    from slrig.logs import set_up_logs

    options = given(compute=scheduler, compute_store=store, compute_certificates=certificates)
    chosen = read_settings(settings, **options)
    if chosen.compute is None or chosen.compute_store is None:
        message = "A worker needs the pool's scheduler and its store: give --scheduler and --store."
        raise ConfigError(message)
    require_pool_extra()
    from slrig.compute.host import open_store, serve_worker

    set_up_logs(chosen.log_level, chosen.log_format)
    address = pool_address(chosen.compute, chosen.compute_certificates)
    place = open_store(chosen.compute_store, chosen.compute_login_file)
    serve_worker(address, place, cache=chosen.data_dir / "cache", say=typer.echo)


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
    no_key: Annotated[bool, typer.Option("--no-key", help="Need no API key; only on this machine.")] = False,
    until_eof: Annotated[bool, typer.Option("--until-eof", help="Stop when standard input ends.")] = False,
) -> None:
    """Start the service: it holds the rig and scans over HTTP."""
    from slrig.api.server import serve as run_service
    from slrig.config import read_rig, read_settings

    options = given(
        host=host,
        port=port,
        data_dir=data,
        allowed_hosts=tuple(allow_host or ()) or None,
        require_key=False if no_key else None,
        compute=compute,
        compute_store=store,
        compute_certificates=certificates,
    )
    chosen = read_settings(settings, **options)
    if is_example(rig):
        rig = _own_copy(rig, chosen.data_dir)
    run_service(chosen, read_rig(rig), new_key=new_key, until_eof=until_eof, say=typer.echo)


def _own_copy(rig: Path, data: Path) -> Path:
    """A copy of an example's rig file in the data folder, which the page may change, or the one made before."""
    own = data / rig.name
    if not own.exists():
        with storage_errors(own):
            data.mkdir(parents=True, exist_ok=True)
            copy_example(rig.stem, own)
    return own


key_app = typer.Typer(no_args_is_help=True, help="Who may use a service, and what for.")

Data = Annotated[
    Path | None,
    typer.Option(
        help="Data folder of the service. Default: SLRIG_DATA_DIR, or ~/.local/share/slrig.", show_default=False
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Owner of the key: a person, or a program.")]


def _ring(data: Path | None) -> KeyRing:
    from slrig.api.auth import KeyRing
    from slrig.config import read_settings

    path = read_settings(None, **given(data_dir=data)).key_path
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    return KeyRing(path)


@key_app.command()
@grouped
def add(
    *,
    name: Name,
    scope: Annotated[
        list[KeyScope] | None,
        typer.Option(help="A permission; may be repeated. Every key may read. Default: scan."),
    ] = None,
    days: Annotated[float | None, typer.Option(min=0.001, help="After how many days it ends. Default: never.")] = None,
    data: Data = None,
) -> None:
    """Make a key, and show it once.

    A running service takes it at once. Scopes: look reads everything, scan scans and previews cameras, calibrate
    also shoots poses, solves, verifies and tests, administer schedules and reads the audit record.
    """
    from slrig.api.scopes import KeyScope

    life = None if days is None else timedelta(days=days)
    typer.echo(_ring(data).add(name, scope or [KeyScope.SCAN], life=life))


@key_app.command(name="list")
@grouped
def list_keys(data: Data = None, as_json: AsJson = False) -> None:
    """List the keys: owner, scopes, end. The keys themselves are kept nowhere."""
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


@key_app.command()
@grouped
def revoke(name: Name, data: Data = None) -> None:
    """Revoke a key, from the next request on."""
    _ring(data).revoke(name)
    typer.echo(f"the key of '{name}' is revoked")


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
    _print_manifest(back_up(folder, to, previous=link_previous), f"backup of {folder} in {to}", as_json=as_json)


def check(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="The data folder of a service.")],
    as_json: AsJson = False,
) -> None:
    """Compare every file of a data folder with its committed digest.

    Also while the service runs. Exits with 1 if a file is damaged.
    """
    from slrig.errors import ConfigError
    from slrig.jobs.data_folder import SCANS, check_files

    if not (data / SCANS).is_dir():
        message = f"{data}: not a data folder of slrig; expected one with a folder '{SCANS}'."
        raise ConfigError(message)
    checked, found = 0, {}
    for path, cause in check_files(data):
        checked += 1
        if cause is not None:
            found[path] = cause
    if as_json:
        from slrig.cli.display import print_json

        print_json({"files": checked, "damaged": found})
    else:
        for path, cause in found.items():
            typer.echo(f"{path} {cause}")
        typer.echo(f"{checked} files of finished jobs, {len(found) or 'none'} damaged")
        if found:
            typer.echo("Where the bundle is whole: POST /scan/ID/reconstruct. Otherwise restore a backup.", err=True)
    if found:
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="A backup.")],
    data: Annotated[Path, typer.Option(help="The data folder to make: new, or empty.")],
    as_json: AsJson = False,
) -> None:
    """Make a data folder of a backup.

    Every byte is checked first; nothing is overwritten.
    """
    from slrig.jobs.backup import restore as replacebackup

    _print_manifest(replacebackup(source, data), f"{data} made from {source}", as_json=as_json)


def _print_manifest(manifest: Manifest, what: str, *, as_json: bool) -> None:
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


@grouped
def fleet(
    catalogue: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Read this database itself, postgresql://HOST:PORT/DATABASE."),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="TOML file with its settings, as a service has them.")] = None,
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """List the rigs that share a catalogue.

    State, health, last scan and backlog of each. Reads a service, or the catalogue itself where that is named, here or
    as SLRIG_CATALOGUE.
    """
    from slrig.cli.display import print_json, print_table

    found = _of_catalogue(catalogue, settings)
    if found is None:
        with service.client() as client:
            found = client.system.fleet()
    if as_json:
        print_json(found)
    elif not found["rigs"]:
        typer.echo(f"no rig writes to {found['catalogue']} yet; name it in the settings of their services: catalogue")
    else:
        heads = ("rig", "state", "seen", "health", "backlog", "last scan", "of 24 h", "why")
        print_table(heads, map(_row, found["rigs"]))


def _of_catalogue(address: str | None, settings: Path | None) -> Mapping[str, Any] | None:
    """The content of the catalogue of the settings; None where they name none."""
    from pydantic import TypeAdapter

    from slrig.catalogue.store import Fleet, catalogue_of
    from slrig.config import read_settings

    catalogue = catalogue_of(read_settings(settings, **given(catalogue=address)))
    if catalogue is None:
        return None
    try:
        catalogue.open()
        document: Mapping[str, Any] = TypeAdapter(Fleet).dump_python(catalogue.fleet(), mode="json")
    finally:
        catalogue.close()
    return document


def _row(rig: Mapping[str, Any]) -> tuple[str, ...]:
    last, failed = rig["last_scan"], rig["failed_of_day"]
    backlog = "?" if rig["waiting"] is None else str(rig["waiting"] + rig["computing"])
    if rig["uncopied"]:
        backlog += f", {rig['uncopied']} to copy"
    ended = "none" if last is None else f"{datetime.fromisoformat(last['finished_at']).astimezone():%Y-%m-%d %H:%M}"
    return (
        rig["name"],
        rig["state"],
        _ago(rig["seen_s"]),
        rig["health"] or "?",
        backlog,
        ended if last is None or last["state"] == "succeeded" else f"{ended} {last['state']}",
        f"{rig['scans_of_day']}" + (f", {failed} failed" if failed else ""),
        rig["words"] if rig["state"] != "ready" else rig["health_message"] if rig["health"] != "good" else "",
    )


def _ago(seconds: float) -> str:
    """Time since a moment, as text.

    >>> _ago(8.2), _ago(200.0), _ago(7200.0), _ago(300000.0)
    ('8 s ago', '3 min ago', '2 h ago', '3 days ago')
    """
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size or (size == 60 and seconds >= size):
            return f"{seconds // size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"

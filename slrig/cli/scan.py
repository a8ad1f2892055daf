"""`slrig scan`, one scan with a running service or a series of them, and `slrig demo`."""

from __future__ import annotations

import json
import os
import secrets
import shlex
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer
from rich.table import Column

from slrig import KEY_VARIABLE, data_home
from slrig.cli.display import ProgressDisplay, counted, print_table, progress_shown, quality_lines
from slrig.cli.options import ServiceOptions
from slrig.client import Client, ScanJob
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ScanCancelledError, ServiceError
from slrig.examples import example_names, is_example
from slrig.jobs.listener import Listener

_HEADS = ("scan", Column("triangles", justify="right"), Column("σ mm", justify="right"), "")
_DIGITS = 3
"""Digits of a scan's number in its series, which has at most 500."""

FILES = ("mesh.ply", "preview.png", "report.json")


def scan_with(
    client: Client,
    request: Mapping[str, Any],
    output: Path,
    listener: Listener | None = None,
    *,
    files: tuple[str, ...] = FILES,
) -> dict[str, Any]:
    """Scan, fetch the files into `output`, and return the finished scan. Ctrl-C cancels the scan.

    Raises
    ------
    ConfigError
        No scan has one of the files. Nothing was shot.
    ServiceError
        The service refused, is gone, or the scan failed.
    ScanCancelledError
        It was cancelled elsewhere.
    """
    _require_offered(client, files)
    with _followed_by(listener) as shown:
        job = _started(client, request)
        return _completed(client, job, job.scan["links"]["cancel"], output, files, shown)


def series_with(
    client: Client,
    request: Mapping[str, Any],
    output: Path,
    listener: Listener | None = None,
    *,
    files: tuple[str, ...] = FILES,
) -> None:
    """Scan a series, fetch the files of each scan into a folder of its number, and print their outcomes.

    A failed scan is reported at the end; the others go on. Ctrl-C cancels the rest.

    Raises
    ------
    ConfigError
        No scan has one of the files. Nothing was shot.
    ServiceError
        The service refused, is gone, or a scan failed or was cancelled.
    """
    _require_offered(client, files)
    rows: list[tuple[str, ...]] = []
    failures: list[str] = []
    try:
        with _followed_by(listener) as shown:
            job = _started(client, request)
            series, scans = job.scan["links"]["series"], job.series()
            for number, job in enumerate(scans, 1):
                name = f"{number:0{_DIGITS}}"
                one = shown.within(0.0, 1.0, f"{name} of {len(scans)}")
                try:
                    scan = _completed(client, job, f"{series}/cancel", output / name, files, one)
                except (ServiceError, ScanCancelledError) as error:
                    rows.append((name, "", "", str(error)))
                    failures.append(name)
                else:
                    mesh = scan["summary"]["mesh"]
                    rows.append((name, f"{mesh['figures']['triangles']:,}", f"{mesh['sigma_mm']['p50']:.4f}", ""))
    finally:
        if rows:
            print_table(_HEADS, rows)
    typer.echo(f"{'files':<9} {output}")
    if failures:
        message = f"{len(failures)} of {len(scans)} scans did not succeed: {', '.join(failures)}."
        raise ServiceError(message)


def assisted(client: Client, request: Mapping[str, Any], *, budget_s: float | None = None) -> dict[str, Any]:
    """The request with the exposures that the object needs, which are printed. Raises ServiceError: the service
    refused; ConfigError: the request has exposures of its own.
    """
    if request.keys() & {"exposure_s", "exposures_s"}:
        message = "--assist: it finds the exposures itself, and --exposure-s gives some. Leave out one of the two."
        raise ConfigError(message)
    if request["if_busy"] == "queue":
        message = "--assist: it measures the object at once, and --queue waits in line. Leave out one of the two."
        raise ConfigError(message)
    same = {key: request.get(key) for key in ("preset", "patterns", "coloured_light")}
    found = client.scans.exposure(budget_s=budget_s, **same)
    times = " and ".join(f"{1000 * each['exposure_s']:.3g} ms" for each in found["exposures"])
    typer.echo(f"{'exposure':<9} {times}: {found['completeness']:.1%} of the lit area, in {found['seconds']:.1f} s")
    for note in found["notes"]:
        typer.echo(f"{'':<9} {note}")
    return {**request, **found["scan"]}


@contextmanager
def _followed_by(listener: Listener | None) -> Iterator[Listener]:
    """The listener, or a display of its own where there is none."""
    if listener is not None:
        yield listener
        return
    with progress_shown() as display:
        yield Listener(report=display)


def _started(client: Client, request: Mapping[str, Any]) -> ScanJob:
    # Whether it waits for the rig is as the request says, or the service.
    return client.start_scan(**{"if_busy": None, **request})


def _completed(
    client: Client,
    job: ScanJob,
    cancel: str,
    output: Path,
    files: Sequence[str],
    listener: Listener,
) -> dict[str, Any]:
    """Follow a scan to its end, fetch its files, and return it. cancel : path that Ctrl-C posts to."""
    try:
        result = job.result(listener.report)
    except KeyboardInterrupt:
        with suppress(ServiceError):
            client.post(cancel)
        raise
    missing = [name for name in files if name not in result.files]
    if missing:
        from slrig.scan.formats import installed_by

        message = f"The scan has no {', '.join(missing)}. It has: {', '.join(result.files)}."
        for name in missing:
            if (command := installed_by(name)) is not None:
                message += f" For {name}, {command} where the service runs; the scan need not be repeated."
        raise ServiceError(message)
    with storage_errors(output):
        output.mkdir(parents=True, exist_ok=True)
    for name in files:
        listener.report(f"fetching {name}", 1.0, "")
        result.save(name, output)
    listener.report("done", 1.0, "")
    return result.scan


def refuse_earlier(output: Path, files: Sequence[str], *, force: bool) -> None:
    """Raise ConfigError, before anything is shot, if files of an earlier scan or series would be overwritten."""
    there = [name for name in (*files, f"{1:0{_DIGITS}}") if (output / name).exists()]
    if there and not force:
        found = ", ".join(there)
        message = f"{output} has {found} of an earlier scan. Choose another folder, or overwrite it with --force."
        raise ConfigError(message)


def _require_offered(client: Client, files: Sequence[str]) -> None:
    """Refuse names that no scan has before minutes are spent on one."""
    if set(files) <= set(FILES):
        return
    # numpy and all that describes bundles: half a second.
    from slrig.scan.formats import camera_prefixes, offered

    unknown, cameras = [name for name in files if name not in offered(())], []
    if unknown and all(name.startswith(camera_prefixes()) for name in unknown):
        # A file per camera: which there are is known once the rig is open.
        cameras = [each["name"] for each in client.get("/rig")["cameras"]]
        unknown = [name for name in unknown if cameras and name not in offered(cameras)]
    if unknown:
        there_are = ", ".join(offered(cameras or ["CAMERA"]))
        message = f"--file: a scan has no {', '.join(unknown)}. There are: {there_are}."
        raise ConfigError(message)


def print_result(scan: Mapping[str, Any], output: Path, *, files: tuple[str, ...] = FILES) -> None:
    """Print the paths of a scan's files and the quality of the mesh."""
    names = {"mesh.ply": "mesh", "preview.png": "preview", "report.json": "report"}
    for name in files:
        if (output / name).is_file():
            typer.echo(f"{names.get(name, name):<9} {output / name}")
    for line in quality_lines(scan.get("summary") or {}):
        typer.echo(line)


START_LIMIT_S = 120.0
STOP_LIMIT_S = 10.0
_POLL_S = 0.05
_READY_POLL_S = 0.2
"""Each answer takes some milliseconds of the service's time, which opens the rig meanwhile."""
_OPENING_SHARE, _SERVICE_SHARE = 0.15, 0.5
"""Shares of a demonstration's time: until the service has started, and until the rig is rendered and open."""
LABEL = "demo"


def run_demo(rig: Path, output: Path, data: Path | None, *, show: bool) -> None:
    """Start a service, scan, fetch, compare, print; the service is gone afterwards.

    data : data folder of the service; None for `demo` in the usual one. show : open the page at the scan, and keep the
    service until the person ends it.

    Raises ConfigError where there is no such rig file, ServiceError where no service starts or the scan fails.
    """
    data = data_home() / "demo" if data is None else data
    with ExitStack() as stack:
        with progress_shown() as display:
            client = stack.enter_context(rig_service(rig, data, display))
            scan = scan_with(client, {"label": LABEL}, output, Listener(report=display).within(_SERVICE_SHARE, 1.0))
            removed = remove_earlier(client, scan)
        print_result(scan, output)
        size_mb = sum(path.stat().st_size for path in data.rglob("*") if path.is_file()) / 1e6
        typer.echo(f"{'data':<9} {data}, {size_mb:.0f} MB: the frames, and all that the service keeps")
        if removed:
            typer.echo(f"Note: {counted(removed, 'earlier demo scan')} of rig '{scan['rig']}' removed from there.")
        if show:
            _show_page(f"{_url(data)}{client.system.make_link()['path']}#/scan/{scan['id']}")
        else:
            _print_next(rig, data / "scans" / scan["id"] / "bundle", output)
    require_sound(scan)


def _show_page(address: str) -> None:
    """Open the page in the person's browser, and wait for Ctrl-C."""
    opened = webbrowser.open(address)
    typer.echo(f"{'page':<9} {address}{'' if opened else ' (no browser was found here)'}; Ctrl-C ends the service")
    with suppress(KeyboardInterrupt):
        threading.Event().wait()


@contextmanager
def rig_service(rig: Path, data: Path, display: ProgressDisplay) -> Iterator[Client]:
    """A client of a service that holds the rig of a file as long as the block lasts, in a process of its own.

    data : its data folder, which is made. Raises ServiceError: it does not start, or the rig cannot be opened;
    ConfigError: there is no such rig file; StorageError.
    """
    if not rig.is_file():
        message = (
            f"There is no rig file {rig}, and no example of that name ({', '.join(example_names())}). "
            "slrig init writes a rig file for your devices."
        )
        raise ConfigError(message)
    with storage_errors(data):
        data.mkdir(parents=True, exist_ok=True)
    key = secrets.token_urlsafe(32)
    display("starting the service", 0.0, str(rig))
    with _service(rig, data, key) as process, Client(_await_address(process, data), key) as client:
        _await_ready(process, client, data, display)
        yield client


@contextmanager
def client_of(rig: Path | None, service: ServiceOptions, data: Path | None = None) -> Iterator[Client]:
    """The client of a running service; of one that lasts as long as the block where a rig file is given.

    data : the data folder of the latter; None for one that goes with it. Raises as `rig_service`.
    """
    if rig is None:
        with service.client() as client:
            yield client
        return
    place = TemporaryDirectory(prefix="slrig-") if data is None else nullcontext(str(data))
    with place as folder, ExitStack() as stack:
        with progress_shown() as display:
            client = stack.enter_context(rig_service(rig, Path(folder), display))
        yield client


def require_sound(scan: Mapping[str, Any]) -> None:
    """End with exit code 1 if the mesh is not the surface that is known to be there. Its notes say what is wrong."""
    from slrig.scan.artefacts import truth_notes

    if truth_notes((scan.get("summary") or {}).get("truth") or {}):
        raise typer.Exit(1)


@contextmanager
def _service(rig: Path, data: Path, key: str) -> Iterator[subprocess.Popen[bytes]]:
    (data / "service.json").unlink(missing_ok=True)
    command = [sys.executable, "-m", "slrig.cli", "serve", str(rig), "--port", "0", "--until-eof"]
    with (data / "service.log").open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 - our own command
            [*command, "--host", "127.0.0.1", "--data", str(data)],
            # Nothing is ever written: the pipe ends with this process, and the service with the pipe.
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={"SLRIG_LOG_FORMAT": "text", **os.environ, KEY_VARIABLE: key},
            # Ctrl-C is for the client: it cancels the scan, and then ends the service.
            start_new_session=True,
        )
    try:
        yield process
    finally:
        if process.stdin is not None:
            process.stdin.close()
        process.terminate()
        try:
            process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _await_address(process: subprocess.Popen[bytes], data: Path) -> str:
    """Wait for the service, and return its address."""
    deadline = time.monotonic() + START_LIMIT_S
    while not (data / "service.json").is_file():
        _require_running(process, data, deadline)
        time.sleep(_POLL_S)
    return _url(data)


def _url(data: Path) -> str:
    url: str = json.loads((data / "service.json").read_text(encoding="utf-8"))["url"]
    return url


def _await_ready(process: subprocess.Popen[bytes], client: Client, data: Path, display: ProgressDisplay) -> None:
    deadline = time.monotonic() + START_LIMIT_S
    shown = ""
    while (missing := still_missing(client)) is not None:
        if missing != shown:
            # Not given up on a slow machine, as long as it makes progress.
            shown, deadline = missing, time.monotonic() + START_LIMIT_S
            display("opening the rig", _OPENING_SHARE, missing)
        _require_running(process, data, deadline)
        time.sleep(_READY_POLL_S)


def still_missing(client: Client) -> str | None:
    """Reason why the service's rig is not open yet, None once it is. Raises ServiceError with the fault.

    It does not wait for the reconstruction: its kernels are prepared while frames are taken, which their job reports.
    """
    try:
        now = client.system.readiness()
    except ServiceError:
        return "the service is starting"
    found: str = now["checks"].get("rig", "")
    if found == "ok":
        return None
    if "rig" not in now["pending"]:
        message = f"The rig cannot be opened: {found}"
        raise ServiceError(message)
    return f"{found}; {now['checks'].get('reconstruction', '')}" if "reconstruction" in now["pending"] else found


def remove_earlier(client: Client, scan: Mapping[str, Any]) -> int:
    """Delete the scans that earlier demos made with the same rig, and no others; return how many."""
    page: dict[str, Any] = {"next": "/scan?limit=200"}
    scans: list[dict[str, Any]] = []
    while page["next"] is not None:
        page = client.get(page["next"])
        scans += page["scans"]
    ours = [each for each in scans if (each["label"], each["rig"]) == (LABEL, scan["rig"]) and each["id"] != scan["id"]]
    for old in ours:
        client.delete(old["links"]["self"])
    return len(ours)


def _require_running(process: subprocess.Popen[bytes], data: Path, deadline: float) -> None:
    log = data / "service.log"
    if process.poll() is not None:
        tail = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-8:])
        message = f"The service ended before it was ready, with exit code {process.returncode}. Its log ends:\n{tail}"
        raise ServiceError(message)
    if time.monotonic() > deadline:
        message = f"The service was not ready within {START_LIMIT_S:.0f} s. Its log is {log}."
        raise ServiceError(message)


def _print_next(rig: Path, bundle: Path, output: Path) -> None:
    live, again = (shlex.quote(str(output.parent / f"{output.name}-{end}")) for end in ("live", "again"))
    # As it was called: in a fresh checkout that is .venv/bin/slrig, and no slrig is on the path.
    program = shlex.quote(sys.argv[0]) if Path(sys.argv[0]).name == "slrig" else "slrig"
    if is_example(rig):
        rig_text, own = rig.stem, Path("my-rig.toml")
        copy = f"{program} init --example {rig.stem} --output {own}"
    else:
        # Paths in a rig file are relative to it, so that a copy belongs next to it.
        rig_text, own = shlex.quote(str(rig)), rig.with_name("my-rig.toml")
        copy = f"cp {rig_text} {shlex.quote(str(own))}"
    own_text, bundle_text = (shlex.quote(str(path)) for path in (own, bundle))
    typer.echo(
        f"""
Next:
  1. Your own rig: copy a rig file, change it, and run it.
       {copy}
       {program} demo {own_text}
  2. A live service: start it, and scan with it from another terminal.
       {program} serve {rig_text}
       {program} scan --output {live}
  3. A recorded bundle: reconstruct this scan, or one of yours, again.
       {program} reconstruct {bundle_text} --output {again}"""
    )

"""`slrig scan`: one scan with a running service, or a series of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import typer
from rich.table import Column

from slrig.cli.display import print_table, progress_shown
from slrig.cli.quality import quality_lines
from slrig.client import Client, ScanJob
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ScanCancelledError, ServiceError
from slrig.scan.offered import camera_prefixes, installed_by, offered

_HEADS = ("scan", Column("triangles", justify="right"), Column("σ mm", justify="right"), "")
_DIGITS = 3
"""Of a scan's number in its series, which has at most 500."""

FILES = ("mesh.ply", "preview.png", "report.json")


def scan_with(
    client: Client,
    request: Mapping[str, Any],
    output: Path,
    *,
    files: tuple[str, ...] = FILES,
    display: Callable[[str, float, str], None] | None = None,
) -> dict[str, Any]:
    """Scan, fetch the files into `output`, and return the finished scan. Ctrl-C cancels the scan.

    Raises
    ------
    ConfigError
        No scan has one of the files. Nothing was shot.
    ServiceError
        The service refused, is gone, or the scan failed.
    ScanCancelledError
        Somebody else cancelled it.
    """
    _require_offered(client, files)
    with progress_shown() if display is None else nullcontext(display) as told:
        job = _started(client, request)
        return _completed(client, job, job.scan["links"]["cancel"], output, files, told)


def series_with(
    client: Client,
    request: Mapping[str, Any],
    output: Path,
    *,
    files: tuple[str, ...] = FILES,
    display: Callable[[str, float, str], None] | None = None,
) -> None:
    """Scan a series, fetch the files of each scan into a folder of its number, and print what became of them.

    A scan that fails is told at the end; the others go on. Ctrl-C cancels those that are left.

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
        with progress_shown() if display is None else nullcontext(display) as told:
            job = _started(client, request)
            series, scans = job.scan["links"]["series"], job.series()
            for number, job in enumerate(scans, 1):
                name = f"{number:0{_DIGITS}}"

                def of_all(stage: str, fraction: float, detail: str, name: str = name) -> None:
                    told(f"{name} of {len(scans)}: {stage}", fraction, detail)

                try:
                    scan = _completed(client, job, f"{series}/cancel", output / name, files, of_all)
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
    """The request with the exposures that the object needs, which are told. Raises ServiceError: the service refused;
    ConfigError: the request has exposures of its own.
    """
    if request.keys() & {"exposure_s", "exposures_s"}:
        message = "--assist: it finds the exposures itself, and --exposure-s gives some. Leave out one of the two."
        raise ConfigError(message)
    if request["if_busy"] == "queue":
        message = "--assist: it looks at the object at once, and --queue waits in line. Leave out one of the two."
        raise ConfigError(message)
    same = {key: request.get(key) for key in ("preset", "patterns", "coloured_light")}
    found = client.scans.exposure(budget_s=budget_s, **same)
    times = " and ".join(f"{1000 * each['exposure_s']:.3g} ms" for each in found["exposures"])
    typer.echo(f"{'exposure':<9} {times}: {found['completeness']:.1%} of what is lit, in {found['seconds']:.1f} s")
    for note in found["notes"]:
        typer.echo(f"{'':<9} {note}")
    return {**request, **found["scan"]}


def _started(client: Client, request: Mapping[str, Any]) -> ScanJob:
    # Whether it waits for the rig is as the request says, or the service.
    return client.start_scan(**{"if_busy": None, **request})


def _completed(
    client: Client,
    job: ScanJob,
    cancel: str,
    output: Path,
    files: Sequence[str],
    told: Callable[[str, float, str], None],
) -> dict[str, Any]:
    """Follow a scan to its end, fetch its files, and return it. cancel : what Ctrl-C asks for."""
    try:
        result = job.result(told)
    except KeyboardInterrupt:
        with suppress(ServiceError):
            client.post(cancel)
        raise
    missing = [name for name in files if name not in result.files]
    if missing:
        message = f"The scan has no {', '.join(missing)}. It has: {', '.join(result.files)}."
        for name in missing:
            if (command := installed_by(name)) is not None:
                message += f" For {name}, {command} where the service runs; the scan need not be repeated."
        raise ServiceError(message)
    with storage_errors(output):
        output.mkdir(parents=True, exist_ok=True)
    for name in files:
        told(f"fetching {name}", 1.0, "")
        result.save(name, output)
    told("done", 1.0, "")
    return result.scan


def _require_offered(client: Client, files: Sequence[str]) -> None:
    """Refuse names that no scan has before minutes are spent on one."""
    unknown, cameras = [name for name in files if name not in offered(())], []
    if unknown and all(name.startswith(camera_prefixes()) for name in unknown):
        # A file per camera: which there are is known once the rig is open.
        cameras = [each["name"] for each in client.get("/rig")["cameras"]]
        unknown = [name for name in unknown if cameras and name not in offered(cameras)]
    if unknown:
        there_are = ", ".join(offered(cameras or ["CAMERA"]))
        message = f"--file: a scan has no {', '.join(unknown)}. There are: {there_are}."
        raise ConfigError(message)


def tell_result(scan: Mapping[str, Any], output: Path, *, files: tuple[str, ...] = FILES) -> None:
    """Print where the files of a scan lie and how good the mesh is."""
    names = {"mesh.ply": "mesh", "preview.png": "preview", "report.json": "report"}
    for name in files:
        if (output / name).is_file():
            typer.echo(f"{names.get(name, name):<9} {output / name}")
    for line in quality_lines(scan.get("summary") or {}):
        typer.echo(line)

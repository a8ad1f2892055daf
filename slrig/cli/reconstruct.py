"""`slrig reconstruct`, recorded bundles become meshes in this process, and `slrig warm`, its kernels are compiled."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.table import Column

from slrig.bundle import read_calibration, read_description, write_file
from slrig.cli.bundles import Row, named_bundles, work_through
from slrig.cli.display import counted, progress_shown
from slrig.cli.quality import quality_lines
from slrig.errors import ConfigError, ExtraMissingError
from slrig.jobs.worker import prepare_kernel_cache
from slrig.jobs.worker_wait import PREPARING
from slrig.logs import set_up_console_logs
from slrig.scan.artefacts import MESH, ON_REQUEST, REPORT, write_converted
from slrig.scan.offered import BUNDLE_ZIP, CALIBRATION_USED, missing_for, offered, on_demand
from slrig.scan.plan import ProgressCallback, ReconstructionPlan
from slrig.scan.records import report_summary


def decode_and_tell(asked: Sequence[Path], output: Path) -> None:
    """Decode bundles without a calibration, and print what was found and what to change. Raises as decoding does, and
    of several as `work_through` does.
    """
    from slrig.scan.decoding_only import decode_bundle

    set_up_console_logs()
    bundles, several = named_bundles(asked)
    if several:

        def decoded(bundle: Path, folder: Path, progress: ProgressCallback) -> list[Row]:
            progress("decode", 0.0, "")
            found, notes = decode_bundle(bundle, folder)
            progress("done", 1.0, "")
            return [
                (f"{each.camera}, {each.axis.value}s", f"{each.lit:.0%}", f"{each.decoded:.0%}",
                 "; ".join([*each.advice, *(notes if each is found[0] else ())]))
                for each in found
            ]  # fmt: skip

        heads = [Column("camera"), *map(_figures, ("lit", "decoded"))]
        work_through(bundles, output, decoded, heads=heads, places=[f"{'pictures':<10}{output / '*'}"])
        return
    (bundle,) = bundles
    with progress_shown() as display:
        display("decode", 0.0, str(bundle))
        found, notes = decode_bundle(bundle, output)
        display("done", 1.0, "")
    for each in found:
        typer.echo(f"{'decoded':<10}{each}")
        for advice in each.advice:
            typer.echo(f"{'':<10}{advice}")
    for note in notes:
        typer.echo(f"{'note':<10}{note}")
    typer.echo(f"{'pictures':<10}{output}")


def reconstruct_and_tell(
    asked: Sequence[Path], output: Path, *, calibration: Path | None, further: Sequence[str], options: Mapping[str, Any]
) -> None:
    """Reconstruct, show the progress, and print where the results lie. Raises what the pipeline raises, and of several
    bundles what `work_through` does.

    further : names of files that are written as well; options : fields of `ReconstructionPlan` that were given.
    """
    set_up_console_logs()
    plan = ReconstructionPlan(**options)
    bundles, several = named_bundles(asked)
    # What is wrong with the files is said at once, not after a minute in which kernels are compiled.
    further = tuple(dict.fromkeys(further))
    if not several:
        _require_offered(further, bundles[0])
    if calibration is not None:
        read_calibration(calibration)

    def reconstructed(bundle: Path, folder: Path, progress: ProgressCallback) -> dict[str, Any]:
        from slrig.scan.reconstruct import reconstruct_bundle

        cameras = _require_offered(further, bundle)
        report = reconstruct_bundle(
            bundle, folder, plan=plan, calibration=calibration, progress=progress, cancelled=lambda: False
        )
        for name in further:
            progress(f"writing {name}", 1.0, "")
            _write_further(folder, name, cameras, bundle, calibration)
        return report_summary(report)

    always = (MESH, "preview.png", REPORT)
    told = [(Path(name).suffix[1:], name) for name in further if name not in always]
    files = (("mesh", MESH), *told, ("preview", "preview.png"), ("report", "report.json"))
    if several:
        work_through(
            bundles, output, lambda *each: [_row(reconstructed(*each))], prepare=prepare_kernels,
            heads=[_figures(name) for name in ("triangles", "median σ", "covered")],
            places=[f"{what:<10}{output / '*' / name}" for what, name in files],
        )  # fmt: skip
        return
    with progress_shown() as display:
        prepare_kernels(display)
        summary = reconstructed(bundles[0], output, display)
    for what, name in files:
        typer.echo(f"{what:<10}{output / name}")
    for line in quality_lines(summary):
        typer.echo(line)


def _require_offered(names: Sequence[str], bundle: Path) -> list[str]:
    """The cameras of a bundle. Raises ConfigError: its reconstruction has not one of the files; ExtraMissingError: one
    takes a library that is not installed; and as `read_description`.
    """
    cameras = list(read_description(bundle).camera_formats())
    there_are = [name for name in offered(cameras) if name not in (CALIBRATION_USED, BUNDLE_ZIP)]
    unknown = [name for name in names if name not in there_are]
    if unknown:
        message = f"{bundle}: it gives no {', '.join(unknown)}. There are: {', '.join(there_are)}."
        raise ConfigError(message)
    for name in names:
        lacking = missing_for(name)
        if lacking is not None:
            message = f"{name} takes a library that is not installed: {lacking}"
            raise ExtraMissingError(message)
    return cameras


def _write_further(folder: Path, name: str, cameras: Sequence[str], bundle: Path, calibration: Path | None) -> None:
    """Write a file of a reconstruction that is made only when it is asked for. Raises as its maker does."""
    found = on_demand(name, cameras)
    if found is not None:
        from slrig.scan.cloud_files import cloud_file

        write_file(folder / name, cloud_file(folder, *found, bundle=bundle, calibration=calibration))
    elif name in ON_REQUEST:
        write_converted(folder, name)


def _figures(name: str) -> Column:
    return Column(name, justify="right", no_wrap=True)


def _row(summary: Mapping[str, Any]) -> Row:
    """What a table says of a reconstruction: triangles, median of the stated deviations, share covered, a remark."""
    mesh = summary["mesh"]
    sigma_mm, covered, notes = mesh["sigma_mm"]["p50"], mesh["covers_of_decoded"], summary["notes"]
    return (
        f"{mesh['figures']['triangles']:,}",
        "" if sigma_mm is None else f"{sigma_mm:.4f} mm",
        "" if covered is None else f"{covered:.1%}",
        f"{counted(len(notes), 'note')} in report.json" if notes else "",
    )


def warm() -> None:
    """Compile or load the kernels of a usual scan, and tell how many there are and where they are kept."""
    began_s = time.monotonic()
    with progress_shown() as display:
        count = prepare_kernels(display)
    place = os.environ.get("NUMBA_CACHE_DIR") or "beside slrig's own files"
    typer.echo(f"{count} kernels are ready, kept {place} ({time.monotonic() - began_s:.0f} s)")


def prepare_kernels(display: ProgressCallback) -> int:
    """Compile the kernels of a usual scan that no earlier run has, under progress; return how many there are."""
    keep_kernels()
    display("loading", 0.0, "")
    # numba itself: a second.
    from slrig.kernels import KernelCount, are_all_cached, count_prepared
    from slrig.scan.reconstruct import warm_kernels

    def told(now: KernelCount) -> None:
        display(PREPARING, 0.0, f"first time only: {now.done} of {now.total}")

    if not are_all_cached():
        warm_kernels(told)
    return count_prepared().total


def keep_kernels() -> None:
    """Have the kernels of this process kept in the cache of the person who runs it."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prepare_kernel_cache(Path(base) / "slrig")

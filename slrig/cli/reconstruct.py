"""`slrig reconstruct`, a recorded bundle becomes a mesh in this process, and `slrig warm`, its kernels are compiled."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from slrig.bundle.calibration_file import read_calibration
from slrig.bundle.description import read_description
from slrig.cli.display import progress_shown
from slrig.cli.scan import quality_lines
from slrig.jobs.worker import prepare_kernel_cache
from slrig.jobs.worker_wait import PREPARING
from slrig.logs import set_up_logs_for_a_person
from slrig.scan.artefacts import MESH, write_converted
from slrig.scan.plan import Progress, ReconstructionPlan
from slrig.scan.records import report_summary


def decode_and_tell(bundle: Path, output: Path) -> None:
    """Decode a bundle without a calibration, and print what was found and what to change. Raises as decoding does."""
    from slrig.scan.decoding_only import decode_bundle

    set_up_logs_for_a_person()
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


def reconstruct_with_progress(
    bundle: Path, output: Path, *, calibration: Path | None, formats: Sequence[str] = (), options: Mapping[str, Any]
) -> None:
    """Reconstruct, show the progress, and print where the results lie. Raises what the pipeline raises.

    formats : further formats of the mesh, "stl" or "obj"; options : fields of `ReconstructionPlan` that were given.
    """
    set_up_logs_for_a_person()
    plan = ReconstructionPlan(**options)
    # What is wrong with the files is said at once, not after a minute in which kernels are compiled.
    read_description(bundle)
    if calibration is not None:
        read_calibration(calibration)
    with progress_shown() as display:
        prepare_kernels(display)
        from slrig.scan.reconstruct import reconstruct_bundle

        report = reconstruct_bundle(
            bundle, output, plan=plan, calibration=calibration, progress=display, cancelled=lambda: False
        )
        further = [f"mesh.{name}" for name in dict.fromkeys(formats)]
        for name in further:
            display(f"writing {name}", 1.0, "")
            write_converted(output, name)
    told = [(Path(name).suffix[1:], name) for name in further]
    for what, name in (("mesh", MESH), *told, ("preview", "preview.png"), ("report", "report.json")):
        typer.echo(f"{what:<10}{output / name}")
    for line in quality_lines(report_summary(report)):
        typer.echo(line)


def warm() -> None:
    """Compile or load the kernels of a usual scan, and tell how many there are and where they are kept."""
    began_s = time.monotonic()
    with progress_shown() as display:
        count = prepare_kernels(display)
    place = os.environ.get("NUMBA_CACHE_DIR") or "beside slrig's own files"
    typer.echo(f"{count} kernels are ready, kept {place} ({time.monotonic() - began_s:.0f} s)")


def prepare_kernels(display: Progress) -> int:
    """Compile or load the kernels of a usual scan in this process, under progress; return how many."""
    keep_kernels()
    display("loading", 0.0, "")
    # numba itself: a second.
    from slrig.kernels import Prepared, prepared
    from slrig.scan.reconstruct import warm_kernels

    def told(now: Prepared) -> None:
        display(PREPARING, 0.0, f"first time only: {now.done} of {now.total}")

    warm_kernels(told)
    return prepared().total


def keep_kernels() -> None:
    """Have the kernels of this process kept in the cache of the person who runs it."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prepare_kernel_cache(Path(base) / "slrig")

"""`slrig reconstruct`: a recorded bundle becomes a mesh, in this process."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from slrig.cli.display import progress_shown
from slrig.cli.scan import quality_lines
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.records import report_summary
from slrig.scan.worker import prepare_kernel_cache


def reconstruct_with_progress(
    bundle: Path, output: Path, *, calibration: Path | None, options: Mapping[str, Any]
) -> None:
    """Reconstruct, show the progress, and print where the results lie. Raises what the pipeline raises.

    options : fields of `ReconstructionPlan` that were given.
    """
    plan = ReconstructionPlan(**options)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prepare_kernel_cache(Path(base) / "slrig")
    with progress_shown() as display:
        display("loading", 0.0, "")
        # numba and its kernels: a second or two, and many the first time.
        from slrig.scan.pipeline import reconstruct_bundle

        report = reconstruct_bundle(
            bundle,
            output,
            plan=plan,
            calibration=calibration,
            progress=display,
            cancelled=lambda: False,
        )
    for what, name in (("mesh", "mesh.ply"), ("preview", "preview.png"), ("report", "report.json")):
        typer.echo(f"{what:<10}{output / name}")
    for line in quality_lines(report_summary(report)):
        typer.echo(line)

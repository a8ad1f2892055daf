"""`slrig warm`, and the same before a reconstruction in this process: kernels are compiled once on a machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import typer

from slrig.cli.display import progress_shown
from slrig.jobs.worker import prepare_kernel_cache
from slrig.jobs.worker_wait import PREPARING

Display = Callable[[str, float, str], None]


def warm() -> None:
    """Compile or load the kernels of a usual scan, and tell how many there are and where they are kept."""
    began_s = time.monotonic()
    with progress_shown() as display:
        count = prepare_here(display)
    place = os.environ.get("NUMBA_CACHE_DIR") or "beside slrig's own files"
    typer.echo(f"{count} kernels are ready, kept {place} ({time.monotonic() - began_s:.0f} s)")


def prepare_here(display: Display) -> int:
    """Compile or load the kernels of a usual scan in this process, under progress; return how many."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prepare_kernel_cache(Path(base) / "slrig")
    display("loading", 0.0, "")
    # numba itself: a second.
    from slrig.kernels import Prepared, prepared
    from slrig.scan.reconstruct import warm_kernels

    def told(now: Prepared) -> None:
        display(PREPARING, 0.0, f"first time only: {now.done} of {now.total}")

    warm_kernels(told)
    return prepared().total

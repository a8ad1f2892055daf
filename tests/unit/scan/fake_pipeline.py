"""Stands in for `slrig.scan.pipeline` in a worker process: what it does is written in the bundle it is given."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from slrig.errors import NothingToReconstructError, ScanCancelledError
from slrig.scan.plan import ReconstructionPlan

ARTEFACTS = ("mesh.ply", "mesh.glb", "mesh.stl", "points.ply", "preview.png")


def reconstruct_bundle(
    bundle: Path,
    output: Path,
    *,
    plan: ReconstructionPlan,
    progress: Callable[[str, float, str], None],
    cancelled: Callable[[], bool],
) -> Mapping[str, object]:
    """Do what `bundle/order` says: finish, fail, break, die, or wait to be cancelled."""
    order = (bundle / "order").read_text()
    progress("decode", 0.1, "")
    if order == "fail":
        message = "No stripe was found in any frame."
        raise NothingToReconstructError(message)
    if order == "break":
        message = "an index error, say"
        raise RuntimeError(message)
    if order == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if order in {"hang", "hang-deaf"}:
        while order == "hang-deaf" or not cancelled():
            progress("mesh", 0.5, "")
            threading.Event().wait(0.01)
        message = "The reconstruction was cancelled."
        raise ScanCancelledError(message)
    partial = output.with_name("result.part")
    partial.mkdir()
    for name in ARTEFACTS:
        (partial / name).write_bytes(f"{name} of {plan}".encode())
    report = {"seconds": 1.5, "stages": [1, 2], "truth": {"rms_mm": 0.01}}
    (partial / "report.json").write_text('{"seconds": 1.5, "stages": [1, 2], "truth": {"rms_mm": 0.01}}')
    partial.rename(output)
    progress("done", 1.0, "")
    return report

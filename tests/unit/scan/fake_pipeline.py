"""Stands in for `slrig.scan.reconstruct` in a worker process: what it does is written in the bundle it is given."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from slrig.capture.verifier import EvidenceSummary
from slrig.errors import NothingToReconstructError, ScanCancelledError
from slrig.jobs.listener import Listener
from slrig.model import Calibration, Mesh, Region, Shot
from slrig.model.capture import CaptureHeader
from slrig.scan.artefacts import MESH, encode_mesh_ply
from slrig.scan.formats import encode_mesh_glb
from slrig.scan.plan import ReconstructionPlan

PICTURE = cv2.imencode(".png", np.zeros((64, 160, 3), dtype=np.uint8))[1].tobytes()

TRIANGLE = Mesh(
    vertices_mm=np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], dtype=np.float32),
    faces=np.array([[0, 1, 2]], dtype=np.int32),
    normals=np.array([[0, 0, 1]] * 3, dtype=np.float32),
    colour=np.array([[10, 20, 30], [100, 90, 80], [200, 210, 220]], dtype=np.uint8),
    mark=np.array([0, 1, 2], dtype=np.uint8),
    sigma_mm=np.full(3, 0.01, dtype=np.float32),
    stripe=np.array([3, 4, 5], dtype=np.int32),
)


class LiveScan:
    """Counts the frames that come. The first pixel of a frame says what else to do: die (1), raise (2), hang (3)."""

    def __init__(self, header: CaptureHeader, _calibration: Calibration, _region: Region | None) -> None:
        self.listed = len(header.frames)
        self.taken = 0
        self.ended = False

    def take(self, shot: Shot) -> None:
        """Count it."""
        match shot.image[0, 0]:
            case 1:
                _die()
            case 2:
                message = "a frame that cannot be used"
                raise ValueError(message)
            case 3:
                threading.Event().wait()
        self.taken += 1

    def end(self, _evidence: EvidenceSummary) -> None:
        """Remember that it was the end."""
        self.ended = True


def _die() -> None:
    assert multiprocessing.parent_process() is not None, "this needs a worker with a process of its own"
    os.kill(os.getpid(), signal.SIGKILL)


def warm_kernels(_told: object) -> None:
    """Nothing is compiled here."""


def process_id() -> int:
    """The process that a task runs in."""
    return os.getpid()


def crash(*_given: object, **_options: object) -> None:
    """Touch what is not there, as a defect in compiled code does."""
    os.kill(os.getpid(), signal.SIGSEGV)


def wait_for(gate: Path) -> str:
    """Wait, without progress, until a file is there."""
    while not gate.exists():
        threading.Event().wait(0.01)
    return gate.name


def exhaust(*_given: object, **_options: object) -> None:
    """Ask for more memory than this process may have."""
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (2**33, most))
    try:
        np.ones(2**33)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def reconstruct_into(
    bundle: Path,
    folder: Path,
    listener: Listener,
    *,
    plan: ReconstructionPlan,
    live: LiveScan | None = None,
    judged: EvidenceSummary | None = None,  # noqa: ARG001 - as it is called
    where: Mapping[str, str] | None = None,
) -> Mapping[str, object]:
    """Do what `bundle/order` says: finish, fail, break, die, or wait to be cancelled."""
    order = (bundle / "order").read_text()
    listener.report("decode", 0.1, "")
    if order == "fail":
        message = "No stripe was found in any frame."
        raise NothingToReconstructError(message)
    if order == "break":
        message = "an index error, say"
        raise RuntimeError(message)
    if order == "die":
        _die()
    if order in {"hang", "hang-deaf"}:
        while order == "hang-deaf" or not listener.cancelled():
            listener.report("mesh", 0.5, "")
            threading.Event().wait(0.01)
        message = "The reconstruction was cancelled."
        raise ScanCancelledError(message)
    # A real one, because other formats are made of it.
    (folder / MESH).write_bytes(encode_mesh_ply(TRIANGLE))
    listener.file_ready(MESH)
    if order == "mesh-first":
        while not (bundle / "go-on").exists():
            listener.report("pictures", 0.8, "")
            threading.Event().wait(0.01)
    (folder / "mesh.glb").write_bytes(encode_mesh_glb(TRIANGLE))
    (folder / "points.ply").write_bytes(f"points of {plan}".encode())
    (folder / "preview.png").write_bytes(PICTURE)
    report: dict[str, object] = {
        "bundle": bundle.parent.name,
        "seconds": 1.5,
        "stages": [1, 2],
        "truth": {"rms_mm": 0.01},
        **({} if where is None or where == {"where": "local"} else {"computed": dict(where)}),
    }
    if live is not None:
        report["live"] = [live.taken, live.listed, live.ended]
    (folder / "report.json").write_text(json.dumps(report))
    listener.report("done", 1.0, "")
    return report

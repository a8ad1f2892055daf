"""The OAK driver before a stage: a mono pair of one device, with the library's own messages, queues and Sync."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.depthai import open_camera
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.unit.capture.fake_rig import PROJECTOR, Scene

FPS = 60.0
SOCKETS = {"left": "CAM_B", "right": "CAM_C"}


@dataclass(frozen=True)
class OakHead(BenchHead):
    """Cameras of one device, and a projector on the same stage."""

    oak: Any
    stage: Stage

    def close(self) -> None:
        self.projector.close()
        for camera in self.cameras.values():
            camera.close()


def oak_head(stage: Stage, *, fps: float = FPS, options: Mapping[str, object] | None = None, **oak: Any) -> OakHead:
    """A mono pair before a stage; `oak` are the fields of `FakeOak`, `options` more of the driver's."""
    from tests.unit.drivers.depthai.fake_oak import DEVICE, FakeOak

    tables = {
        name: {"device": DEVICE, "socket": socket, "fps": fps, **(options or {})} for name, socket in SOCKETS.items()
    }
    device = FakeOak(stage, **oak)
    with device.connected():
        cameras = {name: open_camera(name, table, Path()) for name, table in tables.items()}
    return OakHead(cameras, StagedProjector(stage), device, stage)


def bench(folder: Path, **oak: Any) -> Bench:  # noqa: ARG001 - every bench takes a folder
    """The pair as an instrument for the contract suite. Skips where the library is missing; fails there on CI."""
    importlib.import_module("tests.unit.drivers.depthai.fake_oak")
    seeds = iter(range(1_000))

    def open_head() -> OakHead:
        scene = Scene(noise_dn=0.8, seed=next(seeds))
        return oak_head(Stage(scene, latency_s=0.002, jitter_s=0.003), **oak)

    return Bench(open_head, sequence_for(PROJECTOR))

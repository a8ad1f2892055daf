"""The drivers v4l2 and opencv before vivid's looped video, in the guest: each frame is its pattern's, bit by bit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from drivers import opencv, v4l2
from slrig.devices import Camera, DisplayedPattern, ProjectorInfo
from slrig.model import Pixels, Size
from tests.contract.guest.vivid import Control, Node, Output, nodes
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.unit.capture.fake_rig import Scene

SIGNAL = (640, 480)
"""The looped signal's extent, columns and rows; vivid scales from and to it by 4 at the most."""
CAMERA = Size(160, 120)
PROJECTOR = Size(96, 72)
_CUT_NS = 1_000
"""Flip times are cut to whole microseconds."""


@cache
def stage() -> Stage:
    return Stage(Scene(camera=CAMERA, projector=PROJECTOR))


@cache
def camera_node(instance: int) -> Node:
    """A far side handle on a capture node: its signal is looped, and shows no text."""
    node = Node(nodes()[f"vivid-{instance:03d}-vid-cap"])
    node.set(Control.OSD_TEXT, 2)
    output = nodes().get(f"vivid-{instance:03d}-vid-out")
    if output is not None:
        node.set_timing(*SIGNAL)
        node.set_named("Loop Video", 1)
        far = Node(output)
        far.set_timing(*SIGNAL)
        far.close()
    return node


@cache
def output(instance: int) -> Output:
    """The output node, showing the dark. It stays open: a signal that ends is not dark, but noise."""
    camera_node(instance)
    path = nodes()[f"vivid-{instance:03d}-vid-out"]
    return Output(path, "GREY", CAMERA.width_px, CAMERA.height_px, dark=expected(None).tobytes())


def expected(profile: Pixels | None) -> Pixels:
    return stage().expected(profile)


class LoopedProjector(StagedProjector):
    """A projector on vivid's output node."""

    def __init__(self, output: Output) -> None:
        super().__init__(stage())
        self._output = output
        self._lock = threading.Lock()
        self.blank()

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`. It changes at the next frame of its signal."""
        return replace(super().info, latency_s=1 / 60)

    def show(self, index: int) -> DisplayedPattern:
        profile = self._state.require_pattern(index).profiles[index]
        with self._lock:
            at_ns = self._output.show(expected(profile).tobytes())
        return DisplayedPattern(index, at_ns, _CUT_NS)

    def blank(self) -> None:
        if not self._state.closed.is_set():
            with self._lock:
                self._output.show(expected(None).tobytes())


def options(instance: int, driver: str = "v4l2", /, **more: object) -> dict[str, object]:
    return {
        "device": str(camera_node(instance).path),
        "size_px": [CAMERA.width_px, CAMERA.height_px],
        **({"pixel_format": "GREY"} if driver == "v4l2" else {"fourcc": "GREY"}),
        **more,
    }


def head(folder: Path, driver: str = "v4l2") -> BenchHead:
    projector = LoopedProjector(output(0))
    return BenchHead({"left": DRIVERS[driver]("left", options(0, driver), folder)}, projector)


def bench(folder: Path, driver: str = "v4l2") -> Bench:
    """The contract suite's bench; only in the guest."""
    return Bench(lambda: head(folder, driver), sequence_for(PROJECTOR))


DRIVERS: Mapping[str, Callable[[str, Mapping[str, object], Path], Camera]] = {
    "v4l2": v4l2.open_camera,
    "opencv": opencv.open_camera,
}

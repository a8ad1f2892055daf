"""The process of live depth: which pixels it decodes for whom."""

from __future__ import annotations

import multiprocessing
from typing import Any

import numpy as np
import pytest

from slrig.client.live import LiveFrame, frames, split_messages
from slrig.devices import ProjectorInfo
from slrig.errors import ConfigError
from slrig.live.plan import live_plan
from slrig.live.process import PLACES, DepthCame, FrameCame, GeometryCame, LiveTask, NoDepth, PlayBegan, Wanted
from slrig.live.server import LiveServer
from slrig.model import Axis, CameraFormat, Region
from tests.unit.live.scene import CAMERA, EXPOSURE_S, FRAME_S, PROJECTOR, Photographer, Plane, calibration


class Bench:
    """A server, and the service that gives it frames and reads its messages."""

    def __init__(self, **options: Any) -> None:
        self.plan = live_plan(ProjectorInfo("p", "p", "1", PROJECTOR, False, 0.0, shades=True), Axis.COLUMN)
        self._pipe, far = multiprocessing.Pipe()
        self._memory, self._numbers = np.zeros((PLACES, *CAMERA.shape), np.uint8), [0] * (PLACES + 1)
        task = LiveTask(self.plan, calibration(), "left", CameraFormat(CAMERA, 8), **options)
        self._server = LiveServer(far, task, self._memory, self._numbers)
        self.photographer = Photographer(Plane(), self.plan.patterns)
        self._geometry: dict[int, bytes] = {}
        self._number = 0
        self.said: list[str] = []

    def want(self, *steps: int) -> None:
        self._pipe.send(Wanted(steps))
        self._server.turn()
        while self._pipe.poll():
            came = self._pipe.recv()
            assert isinstance(came, GeometryCame)
            self._geometry.update(came.messages)

    def begin(self) -> None:
        self._pipe.send(PlayBegan())
        self._server.turn()

    def shoot(self, count: int) -> list[dict[int, LiveFrame]]:
        """Give so many frames; return the images of each by step, none where there is none yet."""
        made: list[dict[int, LiveFrame]] = []
        for _ in range(count):
            self._number += 1
            pattern, place = self._number % len(self.plan.patterns), self._number % PLACES
            begin_s = self._number * FRAME_S
            self._memory[place] = self.photographer.frame(pattern, 0.0)
            self._numbers[place] = self._number
            self._pipe.send(FrameCame(self._number, pattern, begin_s, begin_s + EXPOSURE_S, 0.0))
            self._server.turn()
            made.append({})
            while self._pipe.poll():
                came = self._pipe.recv()
                if isinstance(came, NoDepth):
                    self.said.append(came.cause)
                    continue
                assert isinstance(came, DepthCame)
                for step, message in came.messages.items():
                    made[-1][step] = next(frames(split_messages([self._geometry[step] + message])))
        return made


def test_a_viewer_of_finer_points_comes_and_goes_and_nobodys_picture_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("slrig.live.server._FEWEST_POINTS", 2_000)
    bench = Bench()
    bench.want(4)
    twice = 2 * len(bench.plan.patterns)
    alone = bench.shoot(twice)[-1][4]
    assert alone.depth_mm.shape == (45, 60)
    bench.want(2, 4)
    both = bench.shoot(twice)
    assert all(4 in each for each in both)
    fine, coarse = both[-1][2], both[-1][4]
    assert np.array_equal(fine.depth_mm[::2, ::2], coarse.depth_mm, equal_nan=True)
    assert np.array_equal(coarse.directions, fine.directions[::2, ::2])
    assert np.nanmax(np.abs(coarse.depth_mm - alone.depth_mm)) < 8 * np.nanmedian(alone.sigma_mm)
    bench.want(4)
    assert all(4 in each for each in bench.shoot(twice))


def test_no_depth_is_made_of_frames_from_before_a_scan_and_after_it() -> None:
    bench = Bench()
    bench.want(1)
    twice = 2 * len(bench.plan.patterns)
    assert 1 in bench.shoot(twice)[-1]
    bench.begin()
    plane = bench.photographer.plane = Plane((0.3, 0.1, -1.0))
    *before, last = bench.shoot(twice)
    assert not any(before)
    frame = last[1]
    wrong = np.abs(frame.depth_mm - plane.depth_mm(bench.photographer.camera, 0.0)) > 8 * frame.sigma_mm
    assert wrong.mean() < 1e-3
    assert (frame.state == 0).mean() > 0.8


def test_frames_that_make_no_depth_for_some_time_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.live.server._TELL_S", 0.0)
    bench = Bench()
    bench.want(1)
    # The camera is a frame late from the first one on.
    bench.photographer.patterns = (*bench.plan.patterns[-1:], *bench.plan.patterns[:-1])
    bench.shoot(3 * len(bench.plan.patterns))
    assert "frames may be one pattern late" in bench.said[-1]


def test_a_region_that_the_camera_does_not_see_is_told_so() -> None:
    with pytest.raises(ConfigError, match="nothing of it is in the image of camera 'left'"):
        Bench(region=Region(box_mm=((900.0, 0.0, 0.0), (950.0, 10.0, 10.0))))

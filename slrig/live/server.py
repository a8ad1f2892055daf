"""What the process of live depth does: take frames, make depth images, and say what they show."""

from __future__ import annotations

import time
from collections import Counter
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.capture import NEAR_SATURATION
from slrig.live.depth import FARTHEST, NEAREST, DepthImage, LiveDecoder, PixelState
from slrig.live.process import PLACES, DepthCame, FrameCame, GeometryCame, LiveTask, Wanted
from slrig.live.stream import depth_message, geometry_message

_FACTS_STEP = 12  # of rows and columns, by which what an image says is computed
_LEAST_POINTS = 100
_PLANE_TURNS = 3


class LiveServer:
    """The child's side of `LiveProcess`. frames, numbers : shared memory."""

    def __init__(self, pipe: Connection, task: LiveTask, frames: NDArray[Any], numbers: Any) -> None:
        self._pipe, self._task, self._frames, self._numbers = pipe, task, frames, numbers
        full = float(task.format.full_scale)
        self._decoder = LiveDecoder(
            task.plan, task.calibration, task.camera, step=task.step, clipped_at=NEAR_SATURATION * full, full_scale=full
        )
        depth_mm = self._decoder.table.depth_mm
        # Ends of the quantised depths: as far as `LiveDecoder` looks.
        self._near_mm, self._unit_mm = NEAREST * depth_mm, (FARTHEST - NEAREST) * depth_mm / 65534
        self._steps: tuple[int, ...] = ()
        self._left_out: Counter[str] = Counter()
        self._lost = 0
        self._came_s = 0.0

    def run(self) -> None:
        """Serve until the parent's end of the pipe is gone. Raises EOFError or ConnectionError then."""
        number = 0
        while True:
            came = self._receive(self._pipe.recv())
            # Newest frame wins: all that have come are taken, and one depth image is made of them.
            while self._pipe.poll():
                came = self._receive(self._pipe.recv()) or came
            if not came or not self._steps:
                continue
            image = self._decoder.depth()
            if image is None:
                if self._decoder.contradiction is not None:
                    self._left_out[self._decoder.contradiction] += 1
                continue
            number += 1
            facts = {**depth_facts(image, self._decoder), "number": number, "left_out": sum(self._left_out.values()),
                     "lost": self._lost, "causes": dict(self._left_out.most_common(3))}  # fmt: skip
            facts["age_s"] = round(time.monotonic() - self._came_s, 4)
            made = {each: depth_message(image, each, self._near_mm, self._unit_mm, facts) for each in self._steps}
            self._pipe.send(DepthCame(number, made, facts))

    def _receive(self, message: object) -> bool:
        """Take a message; return whether it brought a frame that counts."""
        if isinstance(message, Wanted):
            facts = {"camera": self._task.camera, "axis": str(self._task.plan.axis)}
            steps = message.steps
            new = {
                each: geometry_message(self._decoder.table.directions, each, {**facts, "step": each * self._task.step})
                for each in steps
                if each not in self._steps
            }
            self._steps = steps
            if new:
                self._pipe.send(GeometryCame(new))
            return False
        if not isinstance(message, FrameCame):
            return False
        place, self._numbers[PLACES] = message.number % PLACES, message.number
        if self._numbers[place] != message.number:
            self._lost += 1
            return False
        image = self._frames[place].copy()
        if self._numbers[place] != message.number:
            self._lost += 1
            return False
        self._came_s = message.came_s
        cause = self._decoder.add(message.pattern, image, message.begin_s, message.end_s)
        if cause is not None:
            self._left_out[cause] += 1
        return cause is None


def depth_facts(image: DepthImage, decoder: LiveDecoder) -> dict[str, Any]:
    """What one depth image says of the aim: shares of its pixels by state, distance and tilt of what it shows.

    tilt_deg : angle between the camera's axis and the normal of the plane through most of the points; None without one.
    """
    few = np.s_[::_FACTS_STEP, ::_FACTS_STEP]
    state = image.state[few]
    shares = np.bincount(state.ravel(), minlength=len(PixelState)) / state.size
    measured = state == PixelState.MEASURED
    z = image.depth_mm[few][measured].astype(np.float64)
    facts: dict[str, Any] = {
        "time_s": round(image.time_s, 6),
        "window_s": round(image.window_s, 6),
        "moved_mm": None if image.moved_mm is None else round(image.moved_mm, 3),
        "blur_px": None if image.blur_px is None else round(image.blur_px, 2),
        "shares": {state.name.lower(): round(float(shares[state]), 5) for state in PixelState},
        "meeting_mm": round(decoder.table.depth_mm, 1),
        "distance_mm": None,
        "sigma_mm": None,
        "tilt_deg": None,
        "in_volume": None,
    }
    if len(z) < _LEAST_POINTS:
        return facts
    rays = decoder.table.directions[few][measured].astype(np.float64)
    points = np.column_stack([rays * z[:, None], z])
    facts["distance_mm"] = round(float(np.median(z)), 2)
    facts["sigma_mm"] = round(float(np.median(image.sigma_mm[few][measured])), 4)
    facts["tilt_deg"] = _tilt_deg(points)
    facts["in_volume"] = decoder.share_in_volume(points)
    return facts


def _tilt_deg(points: NDArray[np.float64]) -> float | None:
    """Tilt of the plane through most of the points (n, 3): least squares, without those far off."""
    kept = points
    for _ in range(_PLANE_TURNS):
        centre = kept.mean(axis=0)
        normal = np.linalg.eigh(np.cov(kept - centre, rowvar=False))[1][:, 0]
        distance = np.abs((points - centre) @ normal)
        kept = points[distance <= max(2.5 * float(np.median(distance)), 1e-6)]
        if len(kept) < 10:
            return None
    return round(float(np.degrees(np.arccos(min(abs(normal[2]), 1.0)))), 2)

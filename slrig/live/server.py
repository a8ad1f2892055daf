"""What the process of live depth does: take frames, make depth images, and say what they show."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.capture import NEAR_SATURATION
from slrig.live.depth import FARTHEST, NEAREST, DepthImage, LiveDecoder, LiveView, PixelState
from slrig.live.process import PLACES, DepthCame, FrameCame, GeometryCame, LiveTask, NoDepth, PlayBegan, Wanted
from slrig.live.stream import depth_message, geometry_message

_FACTS_POINTS = 9_000  # by which what an image says is computed
_TELL_S = 1.0  # without an image, until it is said why
_FEWEST_POINTS = 60_000  # that are decoded: the noise is told by them
_LEAST_POINTS = 100
_PLANE_TURNS = 3


class LiveServer:
    """The child's side of `LiveProcess`. frames, numbers : shared memory."""

    def __init__(self, pipe: Connection, task: LiveTask, frames: NDArray[Any], numbers: Any) -> None:
        self._pipe, self._task, self._frames, self._numbers = pipe, task, frames, numbers
        self._view = LiveView(task.calibration, task.camera, task.plan.axis, task.region)
        self._decoder = self._decoding(task.step)
        # Another step is decoded beside the one before until it has an image, so that nobody's picture stands still.
        self._next: LiveDecoder | None = None
        depth_mm = self._view.table.depth_mm
        # Ends of the quantised depths: as far as `LiveDecoder` looks.
        self._near_mm, self._unit_mm = NEAREST * depth_mm, (FARTHEST - NEAREST) * depth_mm / 65534
        self._steps: tuple[int, ...] = ()
        self._left_out: Counter[str] = Counter()
        self._lost, self._made = 0, 0
        self._came_s = 0.0
        self._cause: str | None = None
        self._told_s = time.monotonic()

    def run(self) -> None:
        """Serve until the parent's end of the pipe is gone. Raises EOFError or ConnectionError then."""
        while True:
            self.turn()

    def turn(self) -> None:
        """Wait for messages, and send the depth image of the frames that have come. Raises as `run` does."""
        came = self._receive(self._pipe.recv())
        # Newest frame wins: all that have come are taken, and one depth image is made of them.
        while self._pipe.poll():
            came = self._receive(self._pipe.recv()) or came
        if not self._steps:
            return
        if not came:
            self._tell()
            return
        image = None if self._next is None else self._next.depth()
        if self._next is not None and image is not None:
            self._decoder, self._next = self._next, None
        else:
            image = self._decoder.depth()
        if image is None:
            if self._decoder.contradiction is not None:
                self._cause = self._decoder.contradiction
                self._left_out[self._cause] += 1
            self._tell()
            return
        self._cause, self._told_s = None, time.monotonic()
        self._made += 1
        facts = {**depth_facts(image, self._decoder), "number": self._made, "left_out": sum(self._left_out.values()),
                 "lost": self._lost, "causes": dict(self._left_out.most_common(3))}  # fmt: skip
        age_s = time.monotonic() - self._came_s
        facts.update(age_s=round(age_s, 4), came_s=round(self._came_s, 4))
        made = {
            each: depth_message(image, each // self._decoder.step, self._near_mm, self._unit_mm, facts)
            for each in self._steps
            if each % self._decoder.step == 0
        }
        self._pipe.send(DepthCame(self._made, made, facts))

    def _receive(self, message: object) -> bool:
        """Take a message; return whether it brought a frame that counts."""
        if isinstance(message, Wanted):
            self._want(message.steps)
            return False
        if isinstance(message, PlayBegan):
            self._cause = None
            for each in filter(None, (self._decoder, self._next)):
                each.forget()
        if not isinstance(message, FrameCame):
            return False
        place, self._numbers[PLACES] = message.number % PLACES, message.number
        if self._numbers[place] != message.number:
            self._lost += 1
            return False
        part = self._view.part
        image = self._frames[place][part.rows, part.columns].copy()
        if self._numbers[place] != message.number:
            self._lost += 1
            return False
        self._came_s = message.came_s
        cause = self._decoder.add(message.pattern, image, message.begin_s, message.end_s)
        if self._next is not None:
            self._next.add(message.pattern, image, message.begin_s, message.end_s)
        if cause is not None:
            self._cause = f"a frame of pattern {message.pattern + 1} was left out: {cause}"
            self._left_out[cause] += 1
        return cause is None

    def _tell(self) -> None:
        """Say why there is no image, where there has been none for some time."""
        if self._cause is not None and time.monotonic() - self._told_s > _TELL_S:
            self._told_s = time.monotonic()
            self._pipe.send(NoDepth(self._cause))

    def _want(self, steps: tuple[int, ...]) -> None:
        """Make depth images for these steps from now on, and decode no more than they show."""
        part = self._view.part
        facts = {
            "camera": self._task.camera, "axis": str(self._task.plan.axis),
            "part_px": [part.columns.start, part.rows.start, part.columns.stop, part.rows.stop],
        }  # fmt: skip
        directions = self._view.table.directions
        new = {
            each: geometry_message(directions, each, {**facts, "step": each})
            for each in steps
            if each not in self._steps
        }
        self._steps = steps
        if new:
            self._pipe.send(GeometryCame(new))
        step = decoded_step(steps, self._task.step, part.mask.size)
        if not steps or step == self._decoder.step:
            self._next = None
        elif self._next is None or self._next.step != step:
            self._next = self._decoding(step)

    def _decoding(self, step: int) -> LiveDecoder:
        task, full = self._task, float(self._task.format.full_scale)
        return LiveDecoder(task.plan, self._view, step=step, clipped_at=NEAR_SATURATION * full, full_scale=full)


def decoded_step(watched: Iterable[int], least: int, pixels: int) -> int:
    """The coarsest step that has every pixel of those that are watched, and enough of all to tell their noise. least :
    divides what is watched.

    >>> decoded_step([4, 6], 1, 1_310_720), decoded_step([16], 1, 1_310_720), decoded_step([4], 1, 80_000)
    (2, 4, 1)
    """
    common = math.gcd(*watched)
    steps = range(least, common + 1, least)
    return max((each for each in steps if common % each == 0 and pixels / each**2 >= _FEWEST_POINTS), default=least)


def depth_facts(image: DepthImage, decoder: LiveDecoder) -> dict[str, Any]:
    """What one depth image says of the aim: shares of its pixels by state, distance and tilt of what it shows.

    shares : of the pixels within the region; "outside" is the share of all that are not. tilt_deg : angle between the
    camera's axis and the normal of the plane through most of the points; None without one.
    """
    step = max(1, round(math.sqrt(image.state.size / _FACTS_POINTS)))
    few = np.s_[::step, ::step]
    state = image.state[few]
    counts = np.bincount(state.ravel(), minlength=len(PixelState))
    within = max(state.size - counts[PixelState.OUTSIDE], 1)
    measured = state == PixelState.MEASURED
    z = image.depth_mm[few][measured].astype(np.float64)
    facts: dict[str, Any] = {
        "time_s": round(image.time_s, 6),
        "window_s": round(image.window_s, 6),
        "moved_mm": None if image.moved_mm is None else round(image.moved_mm, 3),
        "blur_px": None if image.blur_px is None else round(image.blur_px, 2),
        "shares": {
            each.name.lower(): round(float(counts[each]) / (state.size if each is PixelState.OUTSIDE else within), 5)
            for each in PixelState
        },
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

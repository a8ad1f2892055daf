"""Light in time, for fakes that stand below a camera driver: a projector, and what a sensor sees of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.devices import Clock, DisplayedPattern, ProjectorInfo, ProjectorState, SystemClock
from slrig.model import CameraFormat, PatternSequence, Pixels
from tests.unit.capture.fake_rig import Scene

REFERENCE_EXPOSURE_S = 0.01
"""The exposure at which a fake camera is as bright as `Scene` says; brightness grows in proportion."""


_REMEMBERED = 500
"""Changes of light that are kept."""


def exposed_shares(
    changes: Sequence[tuple[int, Pixels]], t_start_ns: int, t_end_ns: int, *, rows: int, readout_ns: int
) -> Iterator[tuple[NDArray[np.float64], Pixels]]:
    """Each light of an exposure, and its share of it in each row, (rows, 1). The last row begins `readout_ns` late."""
    start_ns = t_start_ns + np.linspace(0, readout_ns, rows)[:, None]
    span_ns = max(t_end_ns - t_start_ns, 1)
    until_ns = np.asarray(start_ns + span_ns)
    for at_ns, profile in reversed(changes):
        share = (until_ns - np.maximum(at_ns, start_ns)) / span_ns
        if (share > 0).any():
            yield np.maximum(share, 0), profile
        if at_ns <= t_start_ns:
            return
        until_ns = np.minimum(until_ns, at_ns)


class Stage:
    """What a projector showed when (ns, by the clock), and what a camera sees of it. Safe between threads.

    latency_s, jitter_s : from `show` to light: the latency, and up to so much more, at random. clock : of all devices
    on this stage.
    """

    def __init__(
        self, scene: Scene, *, latency_s: float = 0.0, jitter_s: float = 0.0, seed: int = 0, clock: Clock | None = None
    ) -> None:
        self.clock = clock or SystemClock()
        self.scene = scene
        self.latency_s = latency_s
        self.jitter_s = jitter_s
        self._rng = np.random.default_rng(seed)
        self._lock = threading.Lock()
        self._light: dict[bytes, NDArray[np.float64]] = {}
        self.dark: Pixels = np.zeros((1, 1), np.uint8)
        self.changes: list[tuple[int, Pixels]] = [(0, self.dark)]

    @property
    def format(self) -> CameraFormat:
        return self.scene.format

    def show(self, profile: Pixels | None, *, asked_ns: int | None = None) -> int:
        """Change the light to a pattern, or to the dark, now or at an instant to come; return when it will change."""
        with self._lock:
            late_s = self.latency_s + self.jitter_s * float(self._rng.random())
            asked_ns = self.clock.now_ns() if asked_ns is None else asked_ns
            at_ns = max(asked_ns + round(late_s * 1e9), self.changes[-1][0])
            # No camera looks back so far.
            del self.changes[:-_REMEMBERED]
            self.changes.append((at_ns, self.dark if profile is None else profile))
            return at_ns

    def exposed(
        self, t_start_ns: int, t_end_ns: int, *, gain: float = 1.0, readout_ns: int = 0, defocus_px: float = 0.0
    ) -> Pixels:
        """What the sensor read out after an exposure, (H, W), with the scene's noise.

        The times are those of the first row; a rolling shutter's last one comes `readout_ns` later. defocus_px : the
        lens's, a standard deviation.
        """
        with self._lock:
            changes = list(self.changes)
        exposure_s = (t_end_ns - t_start_ns) / 1e9
        seen = np.zeros(self.format.size.shape)
        for share, profile in exposed_shares(changes, t_start_ns, t_end_ns, rows=len(seen), readout_ns=readout_ns):
            seen += share * self._seen(profile)
        if defocus_px > 0:
            seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), defocus_px), np.float64)
        with self._lock:
            noise = self.scene.noise_dn * self._rng.standard_normal(seen.shape)
        return self._whole(self._level(seen, exposure_s * gain) + noise)

    def expected(self, profile: Pixels | None, *, exposure_s: float = REFERENCE_EXPOSURE_S) -> Pixels:
        """What the sensor reads of a pattern without noise: the truth that a frame is compared with."""
        return self._whole(self._level(self._seen(self.dark if profile is None else profile), exposure_s))

    def _level(self, seen: NDArray[np.float64], exposure_s: float) -> NDArray[np.float64]:
        scene = self.scene
        light = scene.albedo * (scene.ambient + scene.white * seen) * exposure_s / REFERENCE_EXPOSURE_S
        return np.asarray(scene.format.full_scale * np.clip(light, 0, 1))

    def _whole(self, values: NDArray[np.float64]) -> Pixels:
        form = self.format
        kind = np.uint8 if form.bit_depth <= 8 else np.uint16
        return np.clip(np.rint(values), 0, form.full_scale).astype(kind)

    def _seen(self, profile: Pixels) -> NDArray[np.float64]:
        key = profile.tobytes() + bytes(str(profile.shape), "ascii")
        with self._lock:
            found = self._light.get(key)
        if found is None:
            found = self.scene.light(profile)
            with self._lock:
                self._light[key] = found
        return found


class StagedProjector:
    """Implements `slrig.devices.Projector` on a stage. It steps; it does not play."""

    _ERR_NS = 100_000

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._state = ProjectorState("the staged projector")

    @property
    def info(self) -> ProjectorInfo:
        size = self._stage.scene.projector
        return ProjectorInfo("projector", "staged projector", "stage", size, False, self._stage.latency_s)

    def load(self, sequence: PatternSequence) -> None:
        self._state.require_open()
        self._state.require_size(sequence, self._stage.scene.projector)
        self.blank()
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        at_ns = self._stage.show(self._state.require_pattern(index).profiles[index])
        self._stage.clock.wait_until(at_ns + self._ERR_NS, self._state.closed)
        return DisplayedPattern(index, at_ns, self._ERR_NS)

    def play(self, exposure_s: float, period_s: float) -> None:
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        self.blank()

    def blank(self) -> None:
        if not self._state.closed.is_set():
            self._stage.show(None)

    def close(self) -> None:
        self.blank()
        self._state.loaded = None
        self._state.closed.set()

"""What one capture works with: the rig, its settings and triggers, and what a frame says of itself."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from slrig.capture.checks import named
from slrig.capture.latency import stable_from_ns
from slrig.devices import AppliedSettings, Rig, Shown, Trigger
from slrig.errors import ScanCancelledError
from slrig.model import Frame, PatternSequence

SETTINGS_TOLERANCE = 0.01
"""How far a camera's exposure and gain may be from what was asked, as a fraction."""


@dataclass(frozen=True, slots=True)
class Session:
    """One capture. `applied` has the cameras that were set; `timeout_s` is how long a frame may take beyond that."""

    rig: Rig
    sequence: PatternSequence
    applied: Mapping[str, AppliedSettings]
    triggers: Mapping[str, Trigger]
    timeout_s: float
    cancelled: Callable[[], bool]

    def pattern(self, index: int) -> str:
        """Words for a pattern."""
        return named(index, self.sequence.patterns[index])

    def patience_s(self, name: str) -> float:
        """How long to wait for a frame of this camera."""
        return self.timeout_s + self.applied[name].exposure_s if name in self.applied else self.timeout_s

    def stop_if_cancelled(self, index: int) -> None:
        """Raise ScanCancelledError if somebody asked for it."""
        if self.cancelled():
            raise ScanCancelledError(f"the scan was cancelled at {self.pattern(index)} of {len(self.sequence)}")

    def settled_ns(self, shown: Shown) -> int:
        """Wait until a pattern's light is the only one, and return since when it is."""
        stable_ns = stable_from_ns(shown, self.rig.synchronisation)
        self.rig.clock.wait_until(stable_ns, threading.Event())
        return stable_ns

    def read(self, name: str, after_ns: int, timeout_s: float) -> Frame:
        """Return the next frame under the name that the rig gives its camera. Raises as `Camera.read` does."""
        return under_name(name, self.rig.cameras[name].read(after_ns, timeout_s))

    def own_fault(self, frame: Frame, after_ns: int, before: Frame | None) -> str | None:
        """Say why a frame was exposed too early, was delivered before, or was exposed otherwise than asked."""
        if frame.t_start_ns < after_ns or frame.t_end_ns < frame.t_start_ns:
            return (
                f"the frame was exposed from {frame.t_start_ns} to {frame.t_end_ns} ns (± {frame.t_err_ns} ns), its "
                f"light was stable from {after_ns} ns only: the driver delivered a stale frame; report it to the "
                "driver's maintainer, and use another driver for this camera"
            )
        if before is not None and frame.sequence_number <= before.sequence_number:
            return (
                f"frame number {frame.sequence_number} came after number {before.sequence_number}: a frame was "
                "delivered twice, or the camera restarted; scan again"
            )
        asked = self.applied.get(frame.camera)
        if asked is not None and differ(frame.exposure_s, asked.exposure_s):
            return (
                f"exposed for {frame.exposure_s:.6g} s, set to {asked.exposure_s:.6g} s: switch off automatic "
                "exposure, and scan again"
            )
        return None


def under_name(name: str, frame: Frame) -> Frame:
    """A frame under the name that the rig gives its camera."""
    return frame if frame.camera == name else replace(frame, camera=name)


def differ(got: float, asked: float) -> bool:
    """Whether a setting is not what was asked."""
    return abs(got - asked) > SETTINGS_TOLERANCE * abs(asked)

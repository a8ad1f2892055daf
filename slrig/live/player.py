"""Plays the patterns of live depth over and over on the thread that owns the rig, and hands every frame on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

from slrig.bundle import RefusedFrame
from slrig.capture import Contradiction
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Rig
from slrig.errors import FrameTimeoutError, ScanCancelledError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.live.plan import LivePlan
from slrig.model import Shot
from slrig.patterns import encode

_CYCLES = (40, 8, 1)
"""Cycles that are loaded at once: as many of them as the projector takes."""

_TIMEOUT_S = 0.3
"""A frame that takes longer beyond its exposure is lost, and its pattern is shown again."""

_MOST_FAILED = 3  # plays in a row without a frame

Take = Callable[[int, Shot, float, float], None]
"""Is given the pattern of a frame, the frame, and begin and end of its exposure in the rig's clock, s."""


class _TimesOnly:
    """Implements `slrig.capture.retries.FrameChecks`: frames count by their times here. What they show is checked where
    they are decoded, because a scene that moves contradicts itself.
    """

    def __init__(self) -> None:
        self.refused: list[RefusedFrame] = []

    def add_shot(self, _shot: Shot) -> tuple[Contradiction, ...]:
        return ()

    def retract(self, _camera: str, patterns: Collection[int]) -> tuple[int, ...]:
        return tuple(patterns)

    def came_alike(self, _camera: str, _patterns: Iterable[int]) -> bool:
        return False

    def clear(self) -> None:
        self.refused.clear()

    def record_refused(self, refused: RefusedFrame) -> None:
        self.refused.append(refused)


def play(
    rig: Rig, plan: LivePlan, camera: str, take: Take, stop: Callable[[], bool], *, exposure_s: float | None = None
) -> None:
    """Play until `stop` says so. The projector is dark and the camera disarmed afterwards.

    exposure_s : as near as the camera can; None that of the rig file.

    Raises as `slrig.capture.sequencer.capture` does; single frames that fail are shown again, and end nothing.
    """
    settings = {name: each for name, each in rig.settings.items() if name == camera}
    if exposure_s is not None:
        least_s, most_s = rig.cameras[camera].info.exposure_range_s
        within_s = min(max(exposure_s, least_s), most_s)
        settings[camera] = replace(settings.get(camera, CameraSettings(within_s)), exposure_s=within_s)
    alone = replace(rig, cameras={camera: rig.cameras[camera]}, settings=settings)
    cycles, failed = 0, 0
    while not stop():
        came = 0
        sequence = encode(plan.patterns * _CYCLES[cycles], rig.projector.info.size)
        try:
            for shot in capture(
                alone, sequence, cancelled=stop, timeout_s=_TIMEOUT_S, evidence=_TimesOnly(), since_ns=0
            ):
                begin_s = shot.time_s or 0.0
                take(shot.pattern % len(plan.patterns), shot, begin_s, begin_s + (shot.exposure_s or 0.0))
                came += 1
        except ScanCancelledError:
            return
        except UnsupportedByDeviceError:
            # Its memory may hold fewer patterns.
            if came or cycles + 1 == len(_CYCLES):
                raise
            cycles += 1
        except (FrameTimeoutError, ScanEvidenceError):
            failed = 0 if came >= len(plan.patterns) else failed + 1
            if failed == _MOST_FAILED:
                raise
        else:
            failed = 0

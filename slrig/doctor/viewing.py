"""One camera before the projector: patterns shown, and frames taken of them alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from slrig.capture import stable_from_ns
from slrig.devices import Camera, CameraSettings, Projector, Rig, Trigger
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Frame, PatternSequence

_TRIES = 3
_LONGEST_FRAME_S = 2.0  # that a frame may take beyond its exposure
_NS = 1e9


class Viewer:
    """Looks through one camera of an open rig, and waits for its synchronisation, if it has one. One thread uses it.

    wait_s : how much later than that a pattern may come all the same, where latency was not measured yet. Raises
    UnsupportedByDeviceError if the camera can be triggered by wire only.
    """

    def __init__(self, rig: Rig, name: str, *, wait_s: float = 0.0) -> None:
        self.rig = rig
        self.name = name
        self.exposure_s = rig.settings[name].exposure_s
        self._wait_ns = round(wait_s * _NS)
        self._never = threading.Event()
        offered = self.camera.info.triggers
        possible = [trigger for trigger in (Trigger.SOFTWARE, Trigger.FREE) if trigger in offered]
        if not possible:
            message = (
                f"camera '{name}' can be triggered by wire only ({', '.join(sorted(offered)) or 'no trigger at all'}), "
                "it is examined with a software trigger or running freely"
            )
            raise UnsupportedByDeviceError(message)
        self.trigger = possible[0]

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.rig.cameras[self.name]

    @property
    def projector(self) -> Projector:
        """The projector."""
        return self.rig.projector

    def within(self, exposure_s: float) -> float:
        """The nearest exposure that the camera declares it can do."""
        least_s, most_s = self.camera.info.exposure_range_s
        return min(max(exposure_s, least_s), most_s)

    @contextmanager
    def armed(self, sequence: PatternSequence | None, exposure_s: float, frames: int) -> Iterator[None]:
        """Have the camera armed for some frames, and a sequence loaded; afterwards all is dark and disarmed.

        `self.exposure_s` is what the camera then uses. Without a sequence, that which was loaded last stays.
        """
        camera = self.camera
        camera.disarm()
        gain = self.rig.settings[self.name].gain
        self.exposure_s = camera.configure(CameraSettings(self.within(exposure_s), gain)).exposure_s
        if sequence is not None:
            self.projector.load(sequence)
        camera.arm(_TRIES * frames, self.trigger)
        try:
            yield
        finally:
            # The light first; what ended the block matters more than a device that does not answer.
            with suppress(Exception):
                self.projector.blank()
            with suppress(Exception):
                camera.disarm()

    def frames(self, index: int, count: int = 1) -> list[Frame]:
        """Show a pattern and return frames of its light alone."""
        after_ns = self.show(index)
        return [self.next(after_ns) for _ in range(count)]

    def show(self, index: int) -> int:
        """Show a pattern, wait for its light, and return since when it is the only one, ns."""
        stable_ns = stable_from_ns(self.projector.show(index), self.rig.synchronisation) + self._wait_ns
        self.rig.clock.wait_until(stable_ns, self._never)
        return stable_ns

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        self.rig.clock.wait_until(self.rig.clock.now_ns() + round(seconds * _NS), self._never)

    def next(self, after_ns: int) -> Frame:
        """Return the next frame that begins after an instant; one that is lost is taken again."""
        for attempt in range(_TRIES):
            if self.trigger is Trigger.SOFTWARE:
                self.camera.trigger()
            try:
                return self.camera.read(after_ns, _LONGEST_FRAME_S + self.exposure_s)
            except FrameTimeoutError:
                if attempt == _TRIES - 1:
                    raise
        raise AssertionError

"""Live pictures of a camera between scans, to aim, to focus and to see what is lit.

They are taken on the thread that owns the rig, between scans: a scan that wants the rig gets it after the picture that
is being taken. The projector is dark unless a viewer requested light, and dark again when the last viewer leaves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slrig.devices import Camera, CameraSettings, Rig, Trigger
from slrig.errors import FrameTimeoutError, SlrigError, UnsupportedByDeviceError
from slrig.model import Frame, White
from slrig.patterns import encode

PICTURES_PER_S = 15.0
_ARMED_FOR = 32  # pictures; some drivers hold a buffer for each
_TRIES = 3
_TIMEOUT_S = 1.0
LONGEST_S = 1.0
"""No picture is exposed longer: a scan that wants the rig waits for it."""


class Light(StrEnum):
    """Light of the projector during a preview."""

    OFF = "off"
    WHITE = "white"


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One picture of a camera. image : (H, W) uint8, 255 at full scale; `number` counts the camera's pictures."""

    image: NDArray[np.uint8]
    number: int
    _made: dict[Hashable, bytes] = field(default_factory=dict)
    _making: threading.Lock = field(default_factory=threading.Lock)

    def made(self, kind: Hashable, make: Callable[[NDArray[np.uint8]], bytes]) -> bytes:
        """A product of the image, computed once per kind for all viewers."""
        with self._making:
            if kind not in self._made:
                self._made[kind] = make(self.image)
            return self._made[kind]


class Watch:
    """A viewer of one camera, until the end of the `with` block."""

    def __init__(self, room: Previews, camera: str, light: Light, exposure_s: float | None = None) -> None:
        self.camera = camera
        self.light = light
        self.exposure_s = exposure_s
        self._room = room

    def picture(self, after: int, timeout_s: float) -> Picture | None:
        """The next picture with a number above `after`; None when none came in time.

        Raises
        ------
        SlrigError
            The rig gives no more pictures: the device failed, or the service ends.
        """
        return self._room.picture(self, after, timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._room.leave(self)


class Previews:
    """Viewers, and the latest picture of each camera. All but `run` may be called from any thread.

    woken : called when a viewer comes.
    """

    def __init__(self, woken: Callable[[], None]) -> None:
        self._woken = woken
        self._changed = threading.Condition()
        self._watches: list[Watch] = []
        self._pictures: dict[str, Picture] = {}
        self._faults: dict[Watch, SlrigError] = {}

    @property
    def wanted(self) -> bool:
        """Whether there are viewers."""
        with self._changed:
            return bool(self._watches)

    def watch(self, camera: str, light: Light, exposure_s: float | None = None) -> Watch:
        """Add a viewer of a camera. exposure_s : as near as the camera can; None the rig file's. All viewers of the
        camera get the exposure requested last.
        """
        watch = Watch(self, camera, light, exposure_s)
        with self._changed:
            if not self._watches:
                # Earlier pictures no longer show the scene.
                self._pictures.clear()
            self._watches.append(watch)
        self._woken()
        return watch

    def leave(self, watch: Watch) -> None:
        """Remove a viewer. Idempotent."""
        with self._changed:
            self._watches = [each for each in self._watches if each is not watch]
            self._faults.pop(watch, None)
            self._changed.notify_all()

    def picture(self, watch: Watch, after: int, timeout_s: float) -> Picture | None:
        """See `Watch.picture`."""

        def found() -> bool:
            there = self._pictures.get(watch.camera)
            return watch in self._faults or (there is not None and there.number > after)

        with self._changed:
            came = self._changed.wait_for(found, timeout_s)
            if watch in self._faults:
                raise self._faults[watch]
            return self._pictures[watch.camera] if came else None

    def fail(self, error: SlrigError) -> None:
        """End all viewers with an error."""
        with self._changed:
            self._faults.update(dict.fromkeys(self._watches, error))
            self._watches = []
            self._changed.notify_all()

    def run(self, rig: Rig, stop: Callable[[], bool]) -> None:
        """Take pictures until no viewer is left, or `stop` says so. For the thread that owns the rig.

        Raises the devices' errors. The projector is dark and the cameras are disarmed afterwards.
        """
        shown: dict[str, _CameraPreview] = {}
        light: Light | None = None
        try:
            while not stop():
                began_s = time.monotonic()
                requested = self._requested()
                if not requested:
                    break
                wanted = Light.WHITE if any(each is Light.WHITE for each, _ in requested.values()) else Light.OFF
                if wanted is not light:
                    light = wanted
                    _set_light(rig, light)
                for name in [name for name in shown if name not in requested]:
                    shown.pop(name).close()
                for name, (_, exposure_s) in requested.items():
                    if name not in shown:
                        shown[name] = _CameraPreview(rig, name)
                    shown[name].expose(exposure_s)
                    frame = shown[name].frame(rig.clock.now_ns())
                    self._put(name, _picture(frame, rig.cameras[name].info.format.full_scale))
                self._rest(began_s + 1 / PICTURES_PER_S, stop)
        finally:
            for each in shown.values():
                with suppress(Exception):
                    each.close()
            rig.projector.blank()

    def _requested(self) -> Mapping[str, tuple[Light, float | None]]:
        """The cameras with viewers, each with the requested light and exposure."""
        with self._changed:
            requested: dict[str, tuple[Light, float | None]] = {}
            for watch in self._watches:
                light, exposure_s = requested.get(watch.camera, (watch.light, None))
                requested[watch.camera] = (
                    Light.WHITE if watch.light is Light.WHITE else light,
                    watch.exposure_s or exposure_s,
                )
            return requested

    def _put(self, camera: str, image: NDArray[np.uint8]) -> None:
        with self._changed:
            before = self._pictures.get(camera)
            self._pictures[camera] = Picture(image, 1 if before is None else before.number + 1)
            self._changed.notify_all()

    def _rest(self, until_s: float, stop: Callable[[], bool]) -> None:
        """Keep the pace, unless the rig is wanted or the last viewer has left."""
        with self._changed:
            self._changed.wait_for(lambda: stop() or not self._watches, max(until_s - time.monotonic(), 0.0))

    def interrupt(self) -> None:
        """Make `run` check `stop` now."""
        with self._changed:
            self._changed.notify_all()


class _CameraPreview:
    """A camera that is armed for pictures."""

    def __init__(self, rig: Rig, name: str) -> None:
        self._camera: Camera = rig.cameras[name]
        self._left = 0
        offered = self._camera.info.triggers
        fit = [trigger for trigger in (Trigger.SOFTWARE, Trigger.FREE) if trigger in offered]
        if not fit:
            message = (
                f"camera '{name}' takes pictures by a wire's pulses only ({', '.join(sorted(offered))}), and nothing "
                "gives any while the rig is idle; scan instead"
            )
            raise UnsupportedByDeviceError(message)
        self._trigger = fit[0]
        self._own = rig.settings.get(name)
        self._exposure_s: float | None = None
        if self._own is not None:
            self._camera.configure(self._own)

    def expose(self, exposure_s: float | None) -> None:
        """Use an exposure from the next frame on; None is the rig file's."""
        if exposure_s == self._exposure_s:
            return
        self._exposure_s = exposure_s
        settings = self._own
        if exposure_s is not None:
            least_s, most_s = self._camera.info.exposure_range_s
            within_s = min(max(exposure_s, least_s), most_s, LONGEST_S)
            settings = replace(self._own or CameraSettings(within_s), exposure_s=within_s)
        if settings is not None:
            self._camera.disarm()
            self._left = 0
            self._camera.configure(settings)

    def frame(self, after_ns: int) -> Frame:
        """One frame, begun after this instant."""
        if not self._left:
            self._camera.disarm()
            self._camera.arm(_ARMED_FOR, self._trigger)
            self._left = _ARMED_FOR
        self._left -= 1
        for _ in range(_TRIES - 1):
            with suppress(FrameTimeoutError):
                return self._shot(after_ns)
        return self._shot(after_ns)

    def _shot(self, after_ns: int) -> Frame:
        if self._trigger is Trigger.SOFTWARE:
            self._camera.trigger()
        return self._camera.read(after_ns, _TIMEOUT_S + (self._exposure_s or 0.0))

    def close(self) -> None:
        self._camera.disarm()


def _set_light(rig: Rig, light: Light) -> None:
    if light is Light.OFF:
        rig.projector.blank()
    else:
        rig.projector.load(encode((White(),), rig.projector.info.size))
        rig.projector.show(0)


def _picture(frame: Frame, full_scale: int) -> NDArray[np.uint8]:
    if full_scale == 255:
        return np.asarray(frame.image, dtype=np.uint8)
    return np.asarray(frame.image.astype(np.float32) * np.float32(255 / full_scale), dtype=np.uint8)

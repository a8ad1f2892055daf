"""A world that is lit by what a display output shows."""

from __future__ import annotations

import threading
import time
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slrig.model import CameraFormat, Pixels
from tests.contract.screen_server import OutputPixels
from tests.e2e.closed_loop.world import World, profile_of

_BETWEEN_LOOKS_S = 0.003
_LOOKS_AGAIN_IN_S = 10.0


class WatchedOutput:
    """Looks at an output's pixels all the time and lights a world with them. A context manager.

    Stands before a sensor as the world itself does. A frame is read out only after a look at the output that follows
    its exposure, so a program that waits for the frame cannot have changed the picture before. A change is known to
    within two looks, and taken to have done so right after the first of them. A picture that is no pattern ends the
    watch, and is raised on leaving. `pictures` : each that was there, (H, W, 3).
    """

    def __init__(self, pixels: OutputPixels, world: World) -> None:
        self._pixels, self._world = pixels, world
        self._left = threading.Event()
        self._looked = threading.Condition()
        self._seen_until_ns = 0
        self._fault: Exception | None = None
        self.pictures: list[NDArray[np.uint8]] = []
        self._thread = threading.Thread(target=self._watch, name="watched output", daemon=True)

    @property
    def format(self) -> CameraFormat:
        return self._world.format

    def exposed(self, t_start_ns: int, t_end_ns: int, *, gain: float = 1.0) -> Pixels:
        """See `World`. Waits until the output was seen after the exposure."""
        self._see(t_end_ns)
        return self._world.exposed(t_start_ns, t_end_ns, gain=gain)

    def _see(self, t_ns: int) -> None:
        with self._looked:
            seen = self._looked.wait_for(lambda: self._fault or self._seen_until_ns > t_ns, _LOOKS_AGAIN_IN_S)
        assert seen, "the output was not looked at"

    def _watch(self) -> None:
        last_ns = time.monotonic_ns()
        try:
            while not self._left.is_set():
                now_ns = time.monotonic_ns()
                picture = self._pixels.colours()
                if not self.pictures or not np.array_equal(picture, self.pictures[-1]):
                    self._world.changed(profile_of(picture), at_ns=last_ns)
                    self.pictures.append(picture)
                last_ns = now_ns
                with self._looked:
                    self._seen_until_ns = now_ns
                    self._looked.notify_all()
                self._left.wait(_BETWEEN_LOOKS_S)
        except (AssertionError, ValueError) as fault:
            with self._looked:
                self._fault = fault
                self._looked.notify_all()

    def __enter__(self) -> Self:
        self._thread.start()
        self._see(0)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        # The last picture counts as well.
        self._see(time.monotonic_ns())
        self._left.set()
        self._thread.join(_LOOKS_AGAIN_IN_S)
        self._pixels.close()
        if self._fault is not None and kind is None:
            raise self._fault

"""The projector on a display output, as the rest of slrig sees it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from drivers.display.options import UNMEASURED_S, DisplayOptions
from drivers.display.stage import Stage
from drivers.display.timing import Presented, whole_light
from drivers.display.working import OwnThread
from slrig.devices import DisplayedPattern, ProjectorInfo, ProjectorState, SystemClock
from slrig.errors import DeviceError, DeviceStateError
from slrig.model import PatternSequence, Primary

Result = TypeVar("Result")

_OPENS_IN_S = 30.0
_LOADS_IN_S = 60.0
_SHOWS_IN_S = 5.0
_DARKENS_IN_S = 2.0
_USUAL_WAIT = 2.0
"""Refreshes from show to the end of a picture's scan-out: half a one to wait, one or one and a half to be shown."""


class DisplayProjector:
    """Implements `slrig.devices.Projector` on one output of this computer.

    opened : gives the stage, dark; called on the thread that is to use it.

    A thread of its own does whatever is done with the stage; `blank` and `close` work from any other, and where that
    thread hangs in a graphics driver, another process makes the output black.

    Raises
    ------
    DeviceError
        As `opened`, or it did not answer in time.
    """

    def __init__(self, options: DisplayOptions, opened: Callable[[], Stage]) -> None:
        self._options = options
        self._thread = OwnThread(f"output {options.output}")
        try:
            self._stage: Stage = self._thread.do(opened, timeout_s=_OPENS_IN_S)
        except BaseException:
            self._thread.end(timeout_s=0)
            raise
        stage = self._stage
        self.refresh_s = stage.refresh_s
        measured = options.latency_s is not None
        self._latency_s = options.latency_s if options.latency_s is not None else UNMEASURED_S
        usual_error_s = self.refresh_s / 2 if measured else UNMEASURED_S
        self._latency_error_s = usual_error_s if options.latency_error_s is None else options.latency_error_s
        self._info = ProjectorInfo(
            name=options.output,
            model=stage.model,
            serial=stage.serial,
            size=stage.size,
            plays=False,
            latency_s=self._latency_s + self._latency_error_s + _USUAL_WAIT * self.refresh_s,
            refresh_s=self.refresh_s,
            lights=True,
        )
        self._state = ProjectorState(f"the projector on output {options.output}")
        self._unchecked = False
        self._darkened = threading.Event()

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Looks at the output again, which may have been changed since it was opened."""
        self._state.require_open()
        self._state.loaded = None
        self._state.require_size(sequence, self._info.size)
        self.blank()
        self._or_dark(lambda: self._thread.do(lambda: self._stage.load(sequence), timeout_s=_LOADS_IN_S))
        self._state.loaded = sequence
        self._unchecked = self._options.check_pixels

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. Dark, if it fails."""
        sequence = self._state.require_pattern(index)
        return self._or_dark(lambda: self._shown(sequence, index))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. A display has no trigger wire."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. From any thread.

        Raises
        ------
        DeviceError
            The output does not go black, and nobody is there to cover it.
        """
        if self._state.closed.is_set():
            return
        self._darkened.set()
        try:
            presented = self._thread.do(lambda: self._stage.show(None), timeout_s=_DARKENS_IN_S)
        except DeviceError:
            if not self._stage.cover():
                raise
        else:
            # The picture before is there until the dark one is scanned out.
            t_visible_ns, t_err_ns = self._light(presented)
            SystemClock().wait_until(t_visible_ns + t_err_ns, self._state.closed)

    def close(self) -> None:
        """See `Projector`. From any thread. The output stays black, `dark_after_s` beyond this process's end."""
        if self._state.closed.is_set():
            return
        self._darkened.set()
        self._state.closed.set()
        self._state.loaded = None
        # Whatever state it is in: what cannot be done any more is not needed.
        with suppress(DeviceError):
            self._thread.do(lambda: self._stage.show(None), timeout_s=_DARKENS_IN_S)
        self._stage.cover()
        with suppress(DeviceError):
            self._thread.do(self._stage.close, timeout_s=_DARKENS_IN_S)
        self._thread.end(timeout_s=_DARKENS_IN_S)

    def _shown(self, sequence: PatternSequence, index: int) -> DisplayedPattern:
        self._darkened.clear()
        presented = self._thread.do(lambda: self._stage.show(index), timeout_s=_SHOWS_IN_S)
        t_visible_ns, t_err_ns = self._light(presented)
        grey = not isinstance(sequence.patterns[index], Primary)
        if self._unchecked and grey and not self._darkened.is_set():
            self._thread.do(lambda: self._stage.compare(sequence.image(index)), timeout_s=_SHOWS_IN_S)
            self._unchecked = False
        if self._darkened.is_set():
            message = f"pattern {index} was darkened from outside before its light was there; show it again"
            raise DeviceStateError(message)
        return DisplayedPattern(index, t_visible_ns, t_err_ns)

    def _light(self, presented: Presented) -> tuple[int, int]:
        return whole_light(
            presented,
            refresh_s=self.refresh_s,
            latency_s=self._latency_s,
            latency_error_s=self._latency_error_s,
        )

    def _or_dark(self, attempt: Callable[[], Result]) -> Result:
        try:
            return attempt()
        except BaseException:
            with suppress(DeviceError):
                self.blank()
            raise

"""A turntable behind a controller on a serial line: where it stands, how it gets there, and when that is not known."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

from drivers.serial_port import SLICE_S, BytePort
from drivers.serial_turntable.options import LineOptions
from slrig.devices import AnyAngle, Clock
from slrig.errors import DeviceError, DeviceStateError, SlrigError, UnsupportedByDeviceError
from slrig.model import StageAxis

NS_PER_S = 1_000_000_000
_MAX_LINE_BYTES = 1024
"""Bytes without an end of line that are kept: no controller sends so long a line."""


@dataclass(slots=True)
class ControllerLink:
    """A controller's port, line by line. `closing` ends a wait from another thread. label : what errors call it."""

    port: BytePort
    clock: Clock
    label: str
    closing: threading.Event = field(default_factory=threading.Event)
    _rest: bytes = b""
    _waiting: deque[str] = field(default_factory=deque)

    def send(self, text: str) -> None:
        """Send a line. Raises DeviceGoneError."""
        self.port.write(text.encode("ascii") + b"\n")

    def send_byte(self, byte: bytes) -> None:
        """Send a byte that is obeyed at once. Raises DeviceGoneError."""
        self.port.write(byte)

    def after(self, seconds: float) -> int:
        """The time in so many seconds, ns."""
        return self.clock.now_ns() + round(seconds * NS_PER_S)

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises DeviceStateError: it was closed meanwhile."""
        self.clock.wait_until(self.after(seconds), self.closing)
        self._require_open()

    def next_line(self, until_ns: int) -> str | None:
        """The next line, or None when it is time. Raises DeviceGoneError; DeviceStateError: it was closed meanwhile."""
        while True:
            self._require_open()
            if self._waiting:
                return self._waiting.popleft()
            left_s = (until_ns - self.clock.now_ns()) / NS_PER_S
            self._split_lines(self.port.read(min(max(left_s, 0.0), SLICE_S)))
            if left_s <= 0 and not self._waiting:
                return None

    def read_waiting(self) -> list[str]:
        """What has come in already. Raises DeviceGoneError."""
        lines: list[str] = []
        while (line := self.next_line(0)) is not None:
            lines.append(line)
        return lines

    def _split_lines(self, data: bytes) -> None:
        *whole, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[-_MAX_LINE_BYTES:]
        for raw in whole:
            line = raw.decode("ascii", "replace").strip()
            if line and line.isascii() and line.isprintable():
                self._waiting.append(line)

    def _require_open(self) -> None:
        if self.closing.is_set():
            message = f"{self.label} was closed while it was waited for; open the rig again"
            raise DeviceStateError(message)


class TurntableController(Protocol):
    """What moves the motor. Places are in its own units."""

    step: float
    """Its smallest move; 0 where it tells none."""

    def position(self) -> float:
        """Where it stands. Raises DeviceError."""
        ...

    def move_to(self, place: float, until_ns: int) -> float:
        """Go there, and return where it stands when it stands still. Raises DeviceError: it did not, or not in time."""
        ...

    def halt(self) -> None:
        """Stop now, wherever that is. Raises DeviceError."""
        ...


class SerialTurntable(AnyAngle):
    """Implements `slrig.devices.Turntable`.

    A controller that restarts begins to count anew. So before each turn it is asked where it stands, and after whatever
    went wrong in a turn nothing is turned any more: the rig has to be opened again, and angles count from there.

    Parameters
    ----------
    port
        Open; the turntable closes it, also when it cannot be opened.
    options
        Checked.
    open_controller
        Returns the controller at the other end of the line.
    clock
        By which it settles and gives up.
    """

    def __init__(
        self,
        port: BytePort,
        options: LineOptions,
        open_controller: Callable[[ControllerLink], TurntableController],
        clock: Clock,
    ) -> None:
        super().__init__(options.poses)
        self._options = options
        self._units_per_deg = -options.units_per_deg if options.reversed else options.units_per_deg
        self._lines = ControllerLink(port, clock, f"the turntable on {options.port}")
        try:
            self._controller = open_controller(self._lines)
            self._origin = self._position = self._controller.position()
        except BaseException:
            port.close()
            raise
        self._last_angle_deg: float | None = None
        self._turning = False
        self._lost: str | None = None

    @property
    def axis(self) -> StageAxis | None:
        """See `Turntable`. Nobody has told it."""
        return None

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`."""
        return self._origin / self._units_per_deg

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. Raises DeviceError, also ever after, once it is not known where the table stands."""
        if self._lines.closing.is_set():
            message = f"{self._lines.label} is closed; open the rig again"
            raise DeviceStateError(message)
        if self._lost is not None:
            message = f"it is not known where {self._lines.label} stands since a turn failed ({self._lost}); "
            raise DeviceError(message + "open the rig again: angles count from there, so begin its views anew")
        if not math.isfinite(angle_deg):
            message = f"asked {self._lines.label} for {angle_deg}°; ask for a number of degrees"
            raise UnsupportedByDeviceError(message)
        until_ns = self._lines.after(self._options.turn_s)
        self._turning = True
        try:
            self._require_unmoved()
            for stop_deg in self._waypoints_deg(angle_deg):
                self._move_to(stop_deg, until_ns)
            self._lines.wait(self._options.settle_s)
        except BaseException as error:
            self._lost = str(error) or type(error).__name__
            raise
        finally:
            self._turning = self._lost is not None
        self._last_angle_deg = angle_deg

    def close(self) -> None:
        """See `Positioner`. From any thread; a turn that is under way is stopped."""
        if self._lines.closing.is_set():
            return
        self._lines.closing.set()
        if self._turning:
            with suppress(SlrigError):
                self._controller.halt()
        self._lines.port.close()

    def _waypoints_deg(self, angle_deg: float) -> tuple[float, ...]:
        """The way to an angle: there, or by way of the side from which angles are approached."""
        approach_deg = self._options.approach_deg
        here_deg = (self._position - self._origin) / self._units_per_deg
        straight = approach_deg == 0 or angle_deg == self._last_angle_deg or (angle_deg - here_deg) / approach_deg >= 1
        return (angle_deg,) if straight else (angle_deg - approach_deg, angle_deg)

    def _move_to(self, angle_deg: float, until_ns: int) -> None:
        self._position = self._controller.move_to(self._origin + angle_deg * self._units_per_deg, until_ns)
        reached_deg = (self._position - self._origin) / self._units_per_deg
        if abs(reached_deg - angle_deg) > self._options.tolerance_deg:
            step_deg = self._controller.step / self._options.units_per_deg
            steps = f", whose steps are {step_deg:.3g}°," if step_deg else ""
            message = (
                f"asked {self._lines.label}{steps} for {angle_deg:.3f}°, it stands at {reached_deg:.3f}°, which is off "
                f"by more than tolerance_deg = {self._options.tolerance_deg:g}; see what holds it, ask for whole "
                "steps, or allow more"
            )
            raise DeviceError(message)

    def _require_unmoved(self) -> None:
        """Raise DeviceError unless it stands where it was left."""
        place = self._controller.position()
        if abs(place - self._position) > self._options.tolerance_deg * self._options.units_per_deg:
            message = (
                f"{self._lines.label} was left at {self._position:.3f} of its controller's units and now says "
                f"{place:.3f}: it was moved by somebody else, or restarted and counts anew; see to its power and cable"
            )
            raise DeviceError(message)

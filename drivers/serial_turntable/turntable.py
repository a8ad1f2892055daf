"""A turntable behind a controller on a serial line: the line-based link, and the turntable itself."""

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
from slrig.devices import Clock, TurntableBase
from slrig.errors import DeviceError, DeviceStateError, SlrigError, UnsupportedByDeviceError
from slrig.model import RotationAxis

NS_PER_S = 1_000_000_000
_MAX_LINE_BYTES = 1024
"""Maximum length of a line; longer data without a line end is dropped."""


@dataclass(slots=True)
class ControllerLink:
    """Line-based access to a controller's port, with time-outs.

    Setting `closing` ends a wait from another thread. Anything that is not a line of printable ASCII is ignored. label
    : name for errors.
    """

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
        """Send a real-time command byte. Raises DeviceGoneError."""
        self.port.write(byte)

    def after(self, seconds: float) -> int:
        """Return the time `seconds` from now, ns."""
        return self.clock.now_ns() + round(seconds * NS_PER_S)

    def wait(self, seconds: float) -> None:
        """Wait for a time. Raises DeviceStateError if the link is closed meanwhile."""
        self.clock.wait_until(self.after(seconds), self.closing)
        self._require_open()

    def next_line(self, until_ns: int) -> str | None:
        """Return the next line; None at `until_ns`. Raises DeviceGoneError, or DeviceStateError if closed meanwhile."""
        while True:
            self._require_open()
            if self._waiting:
                return self._waiting.popleft()
            left_s = (until_ns - self.clock.now_ns()) / NS_PER_S
            self._split_lines(self.port.read(min(max(left_s, 0.0), SLICE_S)))
            if left_s <= 0 and not self._waiting:
                return None

    def read_waiting(self) -> list[str]:
        """Return the lines already received. Raises DeviceGoneError."""
        lines: list[str] = []
        while (line := self.next_line(0)) is not None:
            lines.append(line)
        return lines

    def _split_lines(self, data: bytes) -> None:
        *complete, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[-_MAX_LINE_BYTES:]
        for raw in complete:
            line = raw.decode("ascii", "replace").strip()
            if line and line.isascii() and line.isprintable():
                self._waiting.append(line)

    def _require_open(self) -> None:
        if self.closing.is_set():
            message = f"{self.label} was closed during a request; open the rig again"
            raise DeviceStateError(message)


class TurntableController(Protocol):
    """Controller of the motor. Positions are in its own units."""

    step: float
    """Its smallest step; 0 if unknown."""

    def position(self) -> float:
        """Return the position. Raises DeviceError."""
        ...

    def move_to(self, position: float, until_ns: int) -> float:
        """Move to a position and return the position at rest. Raises DeviceError on failure or time-out."""
        ...

    def halt(self) -> None:
        """Stop immediately. Raises DeviceError."""
        ...


class SerialTurntable(TurntableBase):
    """Implements `slrig.devices.Turntable`.

    A controller that restarts counts from zero again. So its position is checked before each turn, and after a failed
    turn the turntable refuses to move: the rig has to be opened again, and angles count from there.

    port : open; the turntable closes it, also if opening fails. open_controller : returns the controller at the other
    end of the line. clock : for settling and time-outs.
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
    def axis(self) -> RotationAxis | None:
        """See `Turntable`. Unknown."""
        return None

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`."""
        return self._origin / self._units_per_deg

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. Raises DeviceError, also on later calls, once the position is unknown."""
        if self._lines.closing.is_set():
            message = f"{self._lines.label} is closed; open the rig again"
            raise DeviceStateError(message)
        if self._lost is not None:
            message = f"the position of {self._lines.label} is unknown since a turn failed ({self._lost}); "
            raise DeviceError(message + "open the rig again: angles count from there, so repeat all views")
        if not math.isfinite(angle_deg):
            message = f"{self._lines.label} cannot turn to {angle_deg}°; request a finite angle"
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
        """See `Positioner`. From any thread; stops a turn in progress."""
        if self._lines.closing.is_set():
            return
        self._lines.closing.set()
        if self._turning:
            with suppress(SlrigError):
                self._controller.halt()
        self._lines.port.close()

    def _waypoints_deg(self, angle_deg: float) -> tuple[float, ...]:
        """Return the angles on the way to an angle, including the approach against backlash."""
        approach_deg = self._options.approach_deg
        here_deg = (self._position - self._origin) / self._units_per_deg
        straight = approach_deg == 0 or angle_deg == self._last_angle_deg or (angle_deg - here_deg) / approach_deg >= 1
        return (angle_deg,) if straight else (angle_deg - approach_deg, angle_deg)

    def _move_to(self, angle_deg: float, until_ns: int) -> None:
        self._position = self._controller.move_to(self._origin + angle_deg * self._units_per_deg, until_ns)
        reached_deg = (self._position - self._origin) / self._units_per_deg
        if abs(reached_deg - angle_deg) > self._options.tolerance_deg:
            step_deg = self._controller.step / self._options.units_per_deg
            steps = f", whose steps are {step_deg:.3g}°," if step_deg else ","
            message = (
                f"requested {angle_deg:.3f}° of {self._lines.label}{steps} it is at {reached_deg:.3f}°, which is off "
                f"by more than tolerance_deg = {self._options.tolerance_deg:g}; check if it is blocked, request whole "
                "steps, or raise the tolerance"
            )
            raise DeviceError(message)

    def _require_unmoved(self) -> None:
        """Raise DeviceError unless the controller's position is unchanged."""
        position = self._controller.position()
        if abs(position - self._position) > self._options.tolerance_deg * self._options.units_per_deg:
            message = (
                f"{self._lines.label} was left at {self._position:.3f} of its controller's units and is now at "
                f"{position:.3f}: it was moved by someone else, or restarted; check its power and cable"
            )
            raise DeviceError(message)

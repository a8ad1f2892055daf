"""What the protocol core knows of a box: what it is asked for, what it says of itself, and how long it was lit.

Runs unchanged in MicroPython and in CPython.
"""

# MicroPython has neither `__future__` nor `abc` or `dataclasses`: plain classes do.

import binascii

DUTY_WINDOW_US = 10000000
DUTY_SLOTS = 20
DUTY_SLACK = 20
"""Permille of the window by which the light may overrun: no box switches without a delay."""


class HardwareError(Exception):
    """The light engine did not do what it was told. Raised by the methods of a `BoxHardware`."""


class BoxHardware:
    """What the core asks of a box. Every method may raise `HardwareError`; then the box goes dark."""

    def time_us(self) -> int:
        """Microseconds since the box started; never wraps, never goes back."""
        raise NotImplementedError

    def select(self, pattern: int) -> None:
        """Make this pattern of the flash the current one, and return once it is. It is dark until `light`."""
        raise NotImplementedError

    def light(self) -> None:
        """Light the current pattern, and return once it is on the scene."""
        raise NotImplementedError

    def switch_off(self) -> None:
        """Put the light out, and return once it is."""
        raise NotImplementedError

    def pulse(self) -> None:
        """Begin one trigger pulse to the cameras."""
        raise NotImplementedError

    def set_brightness(self, permille: int) -> int:
        """Set the brightness; return what it is now. A box that cannot dim returns 1000."""
        raise NotImplementedError


class BoxDescription:
    """What a box is, as it says in HELLO, and the CRC-32 of every pattern in its flash.

    light_us : longest time from a command to its light. error_us : error of its time stamps. gap_us : least time from
    the end of an exposure to the next one. hold_us : how long a pattern of a sequence stays lit beyond its exposure.
    least_us : shortest exposure. step_us : how much longer it takes for each pattern that it must pass by, or go back
    over, to get from one pattern to the next. on_ms, duty, watchdog_ms : the most that it grants.
    """

    def __init__(
        self,
        model: str,
        firmware: str,
        width_px: int,
        height_px: int,
        crc32: list[int],
        *,
        light_us: int,
        error_us: int,
        gap_us: int,
        hold_us: int,
        least_us: int,
        step_us: int = 0,
        watchdog_ms: int = 10000,
        on_ms: int = 3600000,
        duty: int = 1000,
    ) -> None:
        self.model, self.firmware = model, firmware
        self.width_px, self.height_px = width_px, height_px
        self.crc32 = b"".join([value.to_bytes(4, "big") for value in crc32])
        self.count = len(crc32)
        self.light_us, self.error_us = light_us, error_us
        self.gap_us, self.hold_us, self.least_us, self.step_us = gap_us, hold_us, least_us, step_us
        self.watchdog_ms, self.on_ms, self.duty = watchdog_ms, on_ms, duty

    def find(self, crc32: int) -> int:
        """Where a pattern lies in the flash, the first place if there are several; -1 if it does not."""
        wanted, at = crc32.to_bytes(4, "big"), -1
        while True:
            at = self.crc32.find(wanted, at + 1)
            if at < 0 or at % 4 == 0:
                return at // 4

    def checksum(self, order: list[int]) -> int:
        """The checksum of a sequence of the flash's patterns."""
        return binascii.crc32(b"".join([self.crc32[4 * at : 4 * at + 4] for at in order]))

    def gap_for(self, order: list[int]) -> int:
        """Least time between exposures of a sequence of the flash's patterns, µs."""
        most = 0
        for before, after in zip(order, order[1:]):  # noqa: B905, RUF007 - MicroPython has neither
            # Back means from the first one on, again.
            most = max(most, after - before - 1 if after >= before else after)
        return self.gap_us + most * self.step_us


class LightTime:
    """How long it was lit in the last 10 s, in slots of half a second."""

    def __init__(self) -> None:
        self.slots = [0] * DUTY_SLOTS
        self.until_us = 0

    def note(self, now_us: int, lit: bool) -> None:
        """It was lit, or dark, since the last note."""
        slot_us = DUTY_WINDOW_US // DUTY_SLOTS
        if now_us - self.until_us > DUTY_WINDOW_US:
            self.slots = [slot_us if lit else 0] * DUTY_SLOTS
            self.until_us = now_us
        while self.until_us < now_us:
            at = self.until_us // slot_us
            step_us = min(now_us, (at + 1) * slot_us) - self.until_us
            if self.until_us % slot_us == 0:
                self.slots[at % DUTY_SLOTS] = 0
            if lit:
                self.slots[at % DUTY_SLOTS] += step_us
            self.until_us += step_us

    def left_us(self, duty: int) -> int:
        """How long it may stay lit now."""
        return min(duty + DUTY_SLACK, 1000) * (DUTY_WINDOW_US // 1000) - sum(self.slots)

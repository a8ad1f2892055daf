"""Model of a box for the protocol core: the hardware interface, the box's properties, and the time it was lit.

Runs unchanged in MicroPython and in CPython.
"""

# MicroPython has neither `__future__` nor `abc` or `dataclasses`, so these are plain classes.

import binascii

DUTY_WINDOW_US = 10000000
DUTY_SLOTS = 20
DUTY_SLACK = 20
"""Permille of the window by which the light may overrun, since every box switches with a delay."""


class HardwareError(Exception):
    """The light engine failed. Raised by the methods of a `BoxHardware`."""


class BoxHardware:
    """Hardware interface of a box. Every method may raise `HardwareError`; then the box goes dark."""

    def time_us(self) -> int:
        """Return microseconds since the box started; it never wraps or decreases."""
        raise NotImplementedError

    def select(self, pattern: int) -> None:
        """Make this pattern of the flash current, and return when it is. It is dark until `light`."""
        raise NotImplementedError

    def light(self) -> None:
        """Light the current pattern, and return when it is lit."""
        raise NotImplementedError

    def switch_off(self) -> None:
        """Switch the light off, end a pulse to the cameras that still lasts, and return when it is off."""
        raise NotImplementedError

    def pulse(self, us: int) -> None:
        """Begin one trigger pulse to the cameras, which lasts for an exposure of so many µs."""
        raise NotImplementedError

    def set_brightness(self, permille: int) -> int:
        """Set the brightness; return the actual value. A box that cannot dim returns 1000."""
        raise NotImplementedError


class BoxDescription:
    """Properties of a box for HELLO, and the CRC-32 of every pattern in its flash.

    light_us : longest time from a command to its light. error_us : error of its time stamps. gap_us : least time from
    the end of an exposure to the next one. hold_us : how long a pattern of a sequence stays lit beyond its exposure.
    least_us : shortest exposure. step_us : additional time for each pattern to skip, or to step over again, between two
    patterns. on_ms, duty, watchdog_ms : upper limits that it grants.
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
        """Return the first position of a pattern in the flash; -1 if it is missing."""
        wanted, at = crc32.to_bytes(4, "big"), -1
        while True:
            at = self.crc32.find(wanted, at + 1)
            if at < 0 or at % 4 == 0:
                return at // 4

    def checksum(self, order: list[int]) -> int:
        """Return the checksum of a sequence of the flash's patterns."""
        return binascii.crc32(b"".join([self.crc32[4 * at : 4 * at + 4] for at in order]))

    def gap_for(self, order: list[int]) -> int:
        """Return the least time between exposures of a sequence of the flash's patterns, µs."""
        most = 0
        for before, after in zip(order, order[1:]):  # noqa: B905, RUF007 - MicroPython has neither
            # Stepping back restarts at the first pattern.
            most = max(most, after - before - 1 if after >= before else after)
        return self.gap_us + most * self.step_us


class LightTime:
    """Measures the lit time of the last 10 s, in slots of half a second."""

    def __init__(self) -> None:
        self.slots = [0] * DUTY_SLOTS
        self.until_us = 0

    def note(self, now_us: int, lit: bool) -> None:
        """Note that it was lit, or dark, since the last call."""
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
        """Return how long it may stay lit now."""
        return min(duty + DUTY_SLACK, 1000) * (DUTY_WINDOW_US // 1000) - sum(self.slots)

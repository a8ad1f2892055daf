"""How long a pattern engine lights patterns: what its own rules are held to beside."""

from __future__ import annotations

from dataclasses import dataclass

from slrig.errors import UnsupportedByDeviceError

MAX_UNATTENDED_S = 2.0
"""So long after its host has died a shown pattern is dark."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long each pattern is lit, and from one pattern to the next, whole microseconds."""

    exposure_us: int
    period_us: int

    @property
    def dark_between(self) -> bool:
        """Whether the mirrors are cleared after each pattern."""
        return self.exposure_us < self.period_us


def light_duration_us(exposure_s: float, period_s: float, *, margin_s: float, least_us: int, dark_us: int = 0) -> int:
    """How long to light patterns of which cameras take `exposure_s`, whole microseconds.

    Parameters
    ----------
    margin_s
        Light beyond the exposure: it covers what a camera takes from the pulse to its first row.
    least_us
        The engine's shortest light.
    dark_us
        What the engine needs of dark between two patterns.

    Raises
    ------
    UnsupportedByDeviceError
        It does not fit into the period.
    """
    period_us = round(period_s * 1e6)
    wanted_us = max(round((exposure_s + margin_s) * 1e6), least_us)
    if exposure_s <= 0 or wanted_us + dark_us > period_us:
        dark = f" and the dark after it {dark_us} µs" if dark_us else ""
        message = (
            f"asked for {exposure_s:.6f} s of light every {period_s:.6f} s: with {margin_s:.6f} s for the cameras to "
            f"start, light takes {wanted_us} µs{dark}, the period is {period_us} µs; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)
    return wanted_us


def check_duty(timing: Timing, duty_limit: float) -> None:
    """Raise UnsupportedByDeviceError if light would be on for more of the time than the rig file allows."""
    duty = timing.exposure_us / timing.period_us
    if duty > duty_limit:
        message = (
            f"asked for {timing.exposure_us} µs of light every {timing.period_us} µs: light is on for {duty:.0%} of "
            f"the time, duty_limit of the rig file allows {duty_limit:.0%}; lengthen the period, or shorten exposure_s"
        )
        raise UnsupportedByDeviceError(message)

"""When a picture lights the whole scene, from what is known of when its scan-out began.

A display gets a picture row by row, over one refresh period T, from the instant b of the flip on. So its last row is
there at b + T, and lit `latency_s` later, the display's own delay. A flip is an exchange of frame buffers in the gap
between two pictures: b is its time stamp. A copy into the frame buffer that is being scanned out may come after the
scan-out has passed some of the rows; these come one T later: b lies between the stamp and the stamp + T.
"""

from __future__ import annotations

from dataclasses import dataclass

STAMP_ERROR_NS = 500_000
"""How far time stamps of flips may be off: drivers without a precise one use that of the interrupt."""

QUEUED = 2
"""Pictures that a library may hold back although it was told to wait for the refresh (double and triple buffering)."""


@dataclass(frozen=True, slots=True)
class Presented:
    """A picture's scan-out began between these instants, CLOCK_MONOTONIC, ns."""

    from_ns: int
    until_ns: int


def flipped(stamp_ns: int) -> Presented:
    """A picture that was flipped to at this instant."""
    return Presented(stamp_ns, stamp_ns)


def copied(stamp_ns: int, refresh_s: float) -> Presented:
    """A picture that was copied into the frame buffer at the refresh of this instant."""
    return Presented(stamp_ns, stamp_ns + round(refresh_s * 1e9))


def queued(asked_ns: int, returned_ns: int, refresh_s: float) -> Presented:
    """A picture that was asked for, where all that is known is when the call returned."""
    return Presented(asked_ns, returned_ns + round(QUEUED * refresh_s * 1e9))


def whole_light(presented: Presented, *, refresh_s: float, latency_s: float, latency_error_s: float) -> tuple[int, int]:
    """Return since when a picture lights the whole scene, ± what: (t_visible_ns, t_err_ns).

    >>> whole_light(flipped(10**9), refresh_s=0.02, latency_s=0.03, latency_error_s=0.001)
    (1050000000, 1500000)
    """
    middle_ns = (presented.from_ns + presented.until_ns) // 2
    half_ns = -(-(presented.until_ns - presented.from_ns) // 2)
    return (
        middle_ns + round((refresh_s + latency_s) * 1e9),
        half_ns + STAMP_ERROR_NS + round(latency_error_s * 1e9),
    )

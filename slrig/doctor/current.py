"""Does light rise with the number that stands for the LEDs' current?"""

from __future__ import annotations

import math

import numpy as np

from slrig.devices import UnknownPolarityProjector
from slrig.doctor.findings import Finding, fault, note
from slrig.doctor.light import Seen
from slrig.doctor.viewing import Viewer
from slrig.model import PatternSequence, White

_SHARES = (0.4, 0.6)
_FRAMES = 8
_CLEAR = 1.2
"""Half of what 0.6 over 0.4 makes: more than pulses that an exposure cuts."""


def sense_of_current(viewer: Viewer, sequence: PatternSequence, seen: Seen) -> Finding:
    """Show white at two currents, a little above and below the half, and tell which one is brighter.

    seen : the camera's look at white and black; `sequence` has white. The projector is an `UnknownPolarityProjector`.
    """
    projector = viewer.projector
    if not isinstance(projector, UnknownPolarityProjector):
        message = f"expected a projector that does not know the sense of its current, found {projector.info.model}"
        raise TypeError(message)
    period_s = projector.light_period_s
    exposure_s = viewer.within(math.ceil(seen.exposure_s / period_s) * period_s)
    low, high = (_light(viewer, projector, sequence, seen, exposure_s, share) for share in _SHARES)
    ratio = high / low if low > 0 else math.nan
    told = f"white is {ratio:.2f} times as bright with its current's number at {_SHARES[1]:.0%} as at {_SHARES[0]:.0%}"
    if not (ratio > _CLEAR or 0 < ratio < 1 / _CLEAR):
        remedy = "shade the room's light, see that nothing moves and nothing is saturated, and run the doctor again"
        return fault("light.current", "projector", f"{told}: which way its current goes is not told", remedy)
    remedy = (
        f"write {projector.polarity_option(rises=ratio > 1)} into the [projector] table of the rig file, choose "
        "led_current there, and run the doctor again: all else is measured then, for until now light is dim and pulses"
    )
    return note("light.current", "projector", told, remedy)


def _light(
    viewer: Viewer,
    projector: UnknownPolarityProjector,
    sequence: PatternSequence,
    seen: Seen,
    exposure_s: float,
    share: float,
) -> float:
    """What the projector adds to black where it lights the image, DN, at one current."""
    with viewer.armed(sequence, exposure_s, 2 * _FRAMES):
        projector.set_trial_current(share)
        frames = viewer.frames(sequence.patterns.index(White()), _FRAMES)
        projector.blank()
        dark = [viewer.next(viewer.rig.clock.now_ns() + round(1e9 * exposure_s)) for _ in range(2)]
    lit = seen.levels.lit
    return float(np.mean([f.image[lit].mean() for f in frames]) - np.mean([f.image[lit].mean() for f in dark]))

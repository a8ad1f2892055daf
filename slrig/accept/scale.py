"""Whether a rig measures everything too long or too short, by a bar whose length is certified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.accept.evaluation import Reading, errors_by_step
from slrig.accept.plan import Artefacts, Quantity
from slrig.accept.uncertainty import error_uncertainty
from slrig.calibration.judgement import MIN_SCALE_ERROR, SCALE_SIGMAS
from slrig.errors import setting

_FEWEST_PLACES = 3
"""Chosen: in fewer, a volume that is bent cannot be told from one that is too large."""


@dataclass(frozen=True, slots=True)
class Scale:
    """share : by how much a bar measures longer than its certificate says, over its length, the mean of all places.

    sigma : of that, from how places differ and what is known of the bar; places : where it was measured. words : what
    is wrong, and what to do; None where nothing is.
    """

    share: float
    sigma: float
    places: int
    words: str | None


def scale_by_bar(readings: Sequence[Reading], artefacts: Artefacts) -> Scale | None:
    """The scale that the bar's readings show; None where the bar was measured in fewer than three places.

    It is told from 0.1 % and from five of its standard deviations on, as the scale of a calibration is.
    """
    by_place = errors_by_step(readings, Quantity.SPACING)
    if len(by_place) < _FEWEST_PLACES:
        return None
    length_mm = artefacts.expanded_mm(artefacts.distance)
    shares = np.array([np.mean(errors) for errors in by_place.values()]) / length_mm
    share = float(shares.mean())
    known = error_uncertainty(Quantity.SPACING, artefacts).expanded_mm / 2 / length_mm
    sigma = float(np.hypot(shares.std(ddof=1) / np.sqrt(len(shares)), known))
    if abs(share) <= max(MIN_SCALE_ERROR, SCALE_SIGMAS * sigma):
        return Scale(share, sigma, len(shares), None)
    longer, smaller = ("longer", "smaller") if share > 0 else ("shorter", "larger")
    words = (
        f"the bar measures {abs(share):.2%} ± {100 * sigma:.1g}% {longer} than its certificate says, in all of "
        f"{len(shares)} places: everything does. The squares of the board that the rig was calibrated with are so much "
        f"{smaller} than they were said to be, or a device was moved since; measure both rulers of the board, give "
        f"{setting('measured_mm')}, and calibrate again"
    )
    return Scale(share, sigma, len(shares), words)

"""Directions in which views slide on one another without a residual: a vase turns about its axis, a plane has three.

Noise of the normals hides them, as it makes every motion seem to matter. The information that the normals of both
surfaces agree on does not: along an eigenvector v of it with eigenvalue λ the share λ / vᵀ A v of the information A is
1 where the shape tells of the motion, and about 0 where noise alone does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np

from slrig.model import FloatArray
from slrig.views.matching import Terms

_LEAST_SHARE = 0.5
"""Of the information along a direction, what both surfaces have to agree on."""
_ROUNDING = 1e-9
"""Of all information: less than this is rounding."""
_LEAST_PART = 0.5
"""Of a free motion of all views, what one view has to have in it to be named."""
_TELLING = 0.2
"""Residuals whose squares grow by this share say that the view is elsewhere; matches anew change them by a tenth."""
_HALVINGS = 9
_NO_TURN = 0.1
"""The part of a motion that is a turn, below which it is a shift."""


class Motion(StrEnum):
    """What kind of motion is free."""

    TURN = "turn"
    SHIFT = "shift"


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """A motion of one view against the others that its surface does not tell of; it is held as the start has it.

    direction : (3,) float64, unit, of the axis or of the shift, and point_mm : (3,), on the axis, in the model's frame.
    free_mm : how far it may go, at the object's radius from the middle, before the residuals tell; infinite where they
    do not at any place of the object.
    """

    view: int
    motion: Motion
    direction: FloatArray
    point_mm: FloatArray
    free_mm: float

    def __str__(self) -> str:
        x, y, z = self.direction
        along = f"along ({x:.2f}, {y:.2f}, {z:.2f})"
        if self.motion is Motion.SHIFT:
            return f"shift {along}"
        x, y, z = self.point_mm
        return f"turn about an axis {along} through ({x:.1f}, {y:.1f}, {z:.1f}) mm"


def directions(terms: Terms) -> tuple[FloatArray, FloatArray]:
    """Orthonormal columns (p, p - f) that the surfaces determine, and (p, f) that they leave free."""
    value, vectors = np.linalg.eigh(terms.agreed)
    apparent = np.einsum("ik,ij,jk->k", vectors, terms.information, vectors)
    free = value <= np.maximum(_LEAST_SHARE * apparent, _ROUNDING * np.trace(terms.information))
    return vectors[:, ~free], vectors[:, free]


def free_motions(
    free: FloatArray, middle_mm: FloatArray, radius_mm: float, misfit: Callable[[int, FloatArray], float]
) -> list[FreeMotion]:
    """What each view may do, in the words of turns and shifts.

    free : (6 (N - 1), f), see `directions`. misfit : mean square of residuals over their deviations of a view after a
    motion (6,) of it.
    """
    found = []
    for view, mine in enumerate(np.split(free, len(free) // 6), start=1):
        left, size, _ = np.linalg.svd(mine, full_matrices=False)
        span = left[:, size > _LEAST_PART]
        # Shifts are what is left of the free motions when all turns among them are taken out.
        _, turning, right = np.linalg.svd(span[:3])
        turning = np.append(turning, np.zeros(span.shape[1]))[: span.shape[1]]
        for each, turned in zip((span @ right.T).T, turning, strict=True):
            kind = Motion.TURN if turned > _NO_TURN else Motion.SHIFT
            vector = each[:3] if kind is Motion.TURN else each[3:]
            length = np.linalg.norm(vector)
            # An axis has two directions: the one whose largest part is positive.
            direction = vector / length * np.sign(vector[np.abs(vector).argmax()])
            # x moves by ω × (x - middle) + t, not at all at middle + ω × t / ω².
            aside = radius_mm * np.cross(each[:3], each[3:]) / length**2 if kind is Motion.TURN else np.zeros(3)
            reach = _extent_mm(partial(misfit, view), each, radius_mm)
            found.append(FreeMotion(view, kind, direction, middle_mm + aside, reach))
    return found


def _extent_mm(misfit: Callable[[FloatArray], float], motion: FloatArray, radius_mm: float) -> float:
    """How far a motion goes, both ways, until the squared residuals have grown by `_TELLING`."""
    least = (1 + _TELLING) * misfit(np.zeros(6))
    for doublings in range(_HALVINGS + 1):
        step_mm = radius_mm * 2.0 ** (doublings - _HALVINGS)
        if min(misfit(step_mm * motion), misfit(-step_mm * motion)) > least:
            return step_mm
    return float("inf")

"""Which device changed since the calibration, by how much, and which others the geometry cannot tell from it.

A hypothesis is a change δ of one device: it turned about its own centre (3), moved (3), did both (6), or its focal
length changed (1). Each is fitted to the equations of one verification by the board
(`slrig.calibration.health.equations`) by generalised least squares, everything else held by the calibration's
covariance. With the columns J of the change and what is left r, both made orthogonal to all that is not a change, and S
the size that such a change may have,

    2 ln(evidence / evidence of no change) = rᵀ J' (J'ᵀJ' + 1)⁻¹ J'ᵀ r - ln det(J'ᵀJ' + 1),    J' = J S

(the marginal likelihood of a linear model with normal prior, whose large-sample form is Schwarz's BIC of 1978).

What can be told apart: a turn of a camera moves the projector's epipole in its image, a turn of the projector does not.
A camera that moved and a projector that moved the other way are one and the same to a rig of these two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from slrig.calibration.health.devices import EACH, devices_of
from slrig.calibration.health.equations import Equations, design, padded
from slrig.calibration.solution import PARAMETERS
from slrig.model import Calibration, FloatArray

ALIKE = 9.0
"""Hypotheses whose evidence differs by less (2 ln) cannot be told apart: 3 σ."""

_TURN = slice(PARAMETERS.index("turn_x"), PARAMETERS.index("turn_z") + 1)
_SHIFT = slice(PARAMETERS.index("x_mm"), PARAMETERS.index("z_mm") + 1)
_MOST_TURN_RAD = float(np.radians(0.1))
_MOST_SHIFT_MM = 0.5
_MOST_FOCAL = 0.001
_MOST_GROWTH = 0.001


class Change(StrEnum):
    """What may have happened to a device."""

    NONE = "none"
    TURNED = "turned"
    MOVED = "moved"
    FOCAL = "focal"
    BUMPED = "turned and moved"


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One explanation of what is seen.

    evidence : 2 ln of its evidence over that of no change. weight : its probability among all, which were equally
    likely before. significance : √(drop of χ²) of its best fit, in σ of one parameter.
    turn_deg, shift_mm, focal_share : the change, (3,) about and along the device's own x, y and z axis, and of the
    focal length; each with its standard deviation; NaN where the hypothesis has none.
    mean : (15 d,) float64, the most likely deviation of all parameters from the calibration, its own error included;
    modes : (15 d, k), how sure that is; change : (15 d,) that of the change alone.
    """

    device: str
    kind: Change
    evidence: float
    weight: float
    significance: float
    turn_deg: FloatArray
    turn_sigma_deg: FloatArray
    shift_mm: FloatArray
    shift_sigma_mm: FloatArray
    focal_share: float
    focal_sigma: float
    mean: FloatArray
    modes: FloatArray
    change: FloatArray


def hypotheses(found: Equations, calibration: Calibration, /) -> tuple[Hypothesis, ...]:
    """Every explanation, the most likely first; that nothing changed is among them."""
    base = design(found)
    basis, _ = np.linalg.qr(base)
    left = padded(found, found.left)
    rest = left - basis @ (basis.T @ left)
    tried = [
        _fitted(found, base, left, "", Change.NONE, np.zeros((EACH * len(devices_of(calibration)), 0)), rest, basis)
    ]
    for index, (name, device) in enumerate(devices_of(calibration).items()):
        for kind in (Change.TURNED, Change.MOVED, Change.FOCAL, Change.BUMPED):
            columns = _columns(kind, index, len(devices_of(calibration)), device.translation_mm, device.matrix)
            tried.append(_fitted(found, base, left, name, kind, columns, rest, basis))
    tried.sort(key=lambda each: -each.evidence)
    odds = np.exp((np.array([each.evidence for each in tried]) - tried[0].evidence) / 2)
    weights = odds / odds.sum()
    return tuple(_weighted(each, float(weight)) for each, weight in zip(tried, weights, strict=True))


def rivals(ranked: Sequence[Hypothesis], /) -> tuple[Hypothesis, ...]:
    """The other hypotheses that explain what is seen about as well as the first, with as few numbers or fewer."""
    best = ranked[0]
    if best.kind is Change.NONE:
        return ()
    close = [each for each in ranked[1:] if best.evidence - each.evidence < ALIKE and each.kind is not Change.NONE]
    # A device that turned is also one that turned and moved a little: that adds nothing.
    return tuple(each for each in close if each.kind is not Change.BUMPED or best.kind is Change.BUMPED)


def _columns(kind: Change, index: int, devices: int, shift_mm: FloatArray, matrix: FloatArray) -> FloatArray:
    """(15 d, k): the change per unit of its prior size."""
    own = np.zeros((EACH, 0))
    if kind in (Change.TURNED, Change.BUMPED):
        turn = np.zeros((EACH, 3))
        turn[_TURN] = np.eye(3)
        # A turn about the device's own centre turns its translation along.
        turn[_SHIFT] = np.cross(np.eye(3), shift_mm).T
        own = np.hstack([own, turn * _MOST_TURN_RAD])
    if kind in (Change.MOVED, Change.BUMPED):
        moved = np.zeros((EACH, 3))
        moved[_SHIFT] = np.eye(3) * _MOST_SHIFT_MM
        own = np.hstack([own, moved])
    if kind is Change.FOCAL:
        focal = np.zeros((EACH, 1))
        focal[:2, 0] = np.array([matrix[0, 0], matrix[1, 1]]) * _MOST_FOCAL
        own = np.hstack([own, focal])
    columns = np.zeros((EACH * devices, own.shape[1]))
    columns[EACH * index : EACH * (index + 1)] = own
    return columns


def _fitted(
    found: Equations, base: FloatArray, left: FloatArray, device: str, kind: Change, columns: FloatArray,
    rest: FloatArray, basis: FloatArray,
) -> Hypothesis:  # fmt: skip
    count = columns.shape[1]
    by_change = padded(found, found.by_device @ columns)
    free = by_change - basis @ (basis.T @ by_change)
    normal = free.T @ free
    against = free.T @ rest
    regular = normal + np.eye(count)
    size: FloatArray = np.asarray(np.linalg.solve(regular, against), dtype=np.float64)
    drop = float(against @ np.linalg.pinv(normal) @ against) if count else 0.0
    evidence = float(against @ size) - float(np.linalg.slogdet(regular)[1]) if count else 0.0
    spread = np.linalg.inv(regular)
    mean, modes = _posterior(found, base, left, columns, by_change)
    deviation: FloatArray = np.sqrt(np.diagonal(spread)).astype(np.float64)
    nothing: FloatArray = np.full(3, np.nan)
    turned, moved = kind in (Change.TURNED, Change.BUMPED), kind in (Change.MOVED, Change.BUMPED)
    degrees = np.degrees(_MOST_TURN_RAD)
    return Hypothesis(
        device=device, kind=kind, evidence=evidence, weight=0.0, significance=float(np.sqrt(max(drop, 0.0))),
        turn_deg=degrees * size[:3] if turned else nothing,
        turn_sigma_deg=degrees * deviation[:3] if turned else nothing,
        shift_mm=_MOST_SHIFT_MM * size[-3:] if moved else nothing,
        shift_sigma_mm=_MOST_SHIFT_MM * deviation[-3:] if moved else nothing,
        focal_share=_MOST_FOCAL * float(size[0]) if kind is Change.FOCAL else float("nan"),
        focal_sigma=_MOST_FOCAL * float(deviation[0]) if kind is Change.FOCAL else float("nan"),
        mean=mean, modes=modes, change=columns @ size,
    )  # fmt: skip


def _posterior(
    found: Equations, base: FloatArray, left: FloatArray, columns: FloatArray, by_change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (15 d,) and modes (15 d, k) of the parameters' deviation, after the verification."""
    count, poses = columns.shape[1], found.by_pose.shape[1]
    prior = np.hstack([np.zeros((count, base.shape[1])), np.eye(count)])
    full = np.vstack([np.hstack([base, by_change]), prior])
    right = np.concatenate([left, np.zeros(count)])
    orthogonal, upper = np.linalg.qr(full)
    solved = np.linalg.solve(upper, orthogonal.T @ right)
    own = found.modes.shape[1]
    spread = np.linalg.inv(upper)
    chosen = np.r_[poses : poses + own, base.shape[1] : base.shape[1] + count]
    carry = np.hstack([found.modes, columns])
    return carry @ solved[chosen], carry @ spread[chosen]


def _weighted(each: Hypothesis, weight: float) -> Hypothesis:
    return replace(each, weight=weight)


def board_growth(found: Equations, calibration: Calibration, /) -> tuple[float, float]:
    """The share by which a larger board alone would explain what is seen, and its evidence.

    A board that grew looks like a rig that shrank: all devices drew nearer to one another.
    """
    devices = devices_of(calibration)
    origin = next(iter(devices.values())).centre_mm
    columns = np.zeros((EACH * len(devices), 1))
    for index, device in enumerate(devices.values()):
        columns[EACH * index : EACH * (index + 1)][_SHIFT, 0] = device.rotation @ (device.centre_mm - origin)
    columns *= _MOST_GROWTH
    base = design(found)
    basis, _ = np.linalg.qr(base)
    left = padded(found, found.left)
    fitted = _fitted(found, base, left, "", Change.NONE, columns, left - basis @ (basis.T @ left), basis)
    first = int(np.argmax(np.abs(columns)))
    return float(fitted.change[first] / columns[first, 0] * _MOST_GROWTH), fitted.evidence

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

from slrig.calibration.health.equations import Equations, design, padded
from slrig.calibration.solution import PARAMETERS, PROJECTOR, device_title, devices_of
from slrig.calibration.solving.projection import DEVICE
from slrig.model import Calibration, FloatArray, Pinhole

ALIKE = 9.0
"""Hypotheses whose evidence differs by less (2 ln) cannot be told apart: 3 σ."""

_TURN = slice(PARAMETERS.index("turn_x"), PARAMETERS.index("turn_z") + 1)
_SHIFT = slice(PARAMETERS.index("x_mm"), PARAMETERS.index("z_mm") + 1)
_MOST_TURN_RAD = float(np.radians(0.1))
_MOST_SHIFT_MM = 0.5
_MOST_FOCAL = 0.001
_MOST_GROWTH = 0.001
_AXES = ("about its horizontal axis", "about its vertical axis", "about its viewing axis")
_WAYS = ("to its side", "up or down", "along its viewing axis")
_ALL_BUT = 0.9


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

    @property
    def turned(self) -> bool:
        """Whether the device has another orientation."""
        return self.kind in (Change.TURNED, Change.BUMPED)

    @property
    def moved(self) -> bool:
        """Whether the device stands elsewhere."""
        return self.kind in (Change.MOVED, Change.BUMPED)


def hypotheses(found: Equations, calibration: Calibration, /) -> tuple[Hypothesis, ...]:
    """Every explanation, the most likely first; that nothing changed is among them."""
    devices = devices_of(calibration)
    tried = [_fitted(found, "", Change.NONE, np.zeros((DEVICE * len(devices), 0)))]
    for index, (name, device) in enumerate(devices.items()):
        for kind in (Change.TURNED, Change.MOVED, Change.FOCAL, Change.BUMPED):
            own = _columns(kind, device)
            columns = np.zeros((len(devices), *own.shape))
            columns[index] = own
            tried.append(_fitted(found, name, kind, columns.reshape(-1, own.shape[1])))
    tried.sort(key=lambda each: -each.evidence)
    odds = np.exp((np.array([each.evidence for each in tried]) - tried[0].evidence) / 2)
    return tuple(replace(each, weight=float(weight)) for each, weight in zip(tried, odds / odds.sum(), strict=True))


def rivals(ranked: Sequence[Hypothesis], /) -> tuple[Hypothesis, ...]:
    """The other hypotheses that explain what is seen about as well as the first, with as few numbers or fewer."""
    best = ranked[0]
    if best.kind is Change.NONE:
        return ()
    close = [each for each in ranked[1:] if best.evidence - each.evidence < ALIKE and each.kind is not Change.NONE]
    # A device that turned is also one that turned and moved a little: that adds nothing.
    return tuple(each for each in close if each.kind is not Change.BUMPED or best.kind is Change.BUMPED)


def board_growth(found: Equations, calibration: Calibration, /) -> tuple[float, float]:
    """The share by which a larger board alone would explain what is seen, and its evidence.

    A board that grew looks like a rig that shrank: all devices drew nearer to one another.
    """
    devices = list(devices_of(calibration).values())
    columns = np.zeros((len(devices), DEVICE))
    for index, device in enumerate(devices):
        columns[index, _SHIFT] = device.rotation @ (device.centre_mm - devices[0].centre_mm)
    columns = columns.reshape(-1, 1) * _MOST_GROWTH
    fitted = _fitted(found, "", Change.NONE, columns)
    first = int(np.argmax(np.abs(columns)))
    return float(fitted.change[first] / columns[first, 0] * _MOST_GROWTH), fitted.evidence


def _columns(kind: Change, device: Pinhole) -> FloatArray:
    """(15, k): the change of one device per unit of its prior size."""
    turn, moved, focal = np.zeros((DEVICE, 3)), np.zeros((DEVICE, 3)), np.zeros((DEVICE, 1))
    turn[_TURN] = np.eye(3)
    # A turn about the device's own centre turns its translation along.
    turn[_SHIFT] = np.cross(np.eye(3), device.translation_mm).T
    turn *= _MOST_TURN_RAD
    moved[_SHIFT] = np.eye(3) * _MOST_SHIFT_MM
    focal[:2, 0] = np.diagonal(device.matrix)[:2] * _MOST_FOCAL
    both = np.hstack([turn, moved])
    return {Change.TURNED: turn, Change.MOVED: moved, Change.FOCAL: focal, Change.BUMPED: both}[kind]


def _fitted(found: Equations, device: str, kind: Change, columns: FloatArray) -> Hypothesis:
    count = columns.shape[1]
    base, left = design(found), padded(found, found.left)
    basis, _ = np.linalg.qr(base)
    by_change = padded(found, found.by_device @ columns)
    free = by_change - basis @ (basis.T @ by_change)
    normal = free.T @ free
    against = free.T @ (left - basis @ (basis.T @ left))
    regular = normal + np.eye(count)
    size: FloatArray = np.asarray(np.linalg.solve(regular, against), dtype=np.float64)
    drop = float(against @ np.linalg.pinv(normal) @ against) if count else 0.0
    deviation: FloatArray = np.sqrt(np.diagonal(np.linalg.inv(regular))).astype(np.float64)
    mean, modes = _posterior(found, base, left, columns, by_change)
    nothing: FloatArray = np.full(3, np.nan)
    degrees = np.degrees(_MOST_TURN_RAD)
    made = Hypothesis(
        device=device, kind=kind, weight=0.0, significance=float(np.sqrt(max(drop, 0.0))),
        evidence=float(against @ size) - float(np.linalg.slogdet(regular)[1]) if count else 0.0,
        turn_deg=nothing, turn_sigma_deg=nothing, shift_mm=nothing, shift_sigma_mm=nothing,
        focal_share=np.nan, focal_sigma=np.nan, mean=mean, modes=modes, change=columns @ size,
    )  # fmt: skip
    if made.turned:
        made = replace(made, turn_deg=degrees * size[:3], turn_sigma_deg=degrees * deviation[:3])
    if made.moved:
        made = replace(made, shift_mm=_MOST_SHIFT_MM * size[-3:], shift_sigma_mm=_MOST_SHIFT_MM * deviation[-3:])
    if kind is Change.FOCAL:
        share, sigma = _MOST_FOCAL * float(size[0]), _MOST_FOCAL * float(deviation[0])
        made = replace(made, focal_share=share, focal_sigma=sigma)
    return made


def _posterior(
    found: Equations, base: FloatArray, left: FloatArray, columns: FloatArray, by_change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (15 d,) and modes (15 d, k) of the parameters' deviation, after the verification."""
    count, poses = columns.shape[1], found.by_pose.shape[1]
    prior = np.hstack([np.zeros((count, base.shape[1])), np.eye(count)])
    orthogonal, upper = np.linalg.qr(np.vstack([np.hstack([base, by_change]), prior]))
    solved = np.linalg.solve(upper, orthogonal.T @ np.concatenate([left, np.zeros(count)]))
    chosen = np.r_[poses : poses + found.modes.shape[1], base.shape[1] : base.shape[1] + count]
    carry = np.hstack([found.modes, columns])
    return carry @ solved[chosen], carry @ np.linalg.inv(upper)[chosen]


def change_words(each: Hypothesis, /) -> str:
    """One sentence without an end: which device changed, and by how much, with its standard deviation."""
    if each.kind is Change.NONE:
        return "no device changed"
    name = device_title(each.device)
    if each.kind is Change.FOCAL:
        return (
            f"{name}: its focal length changed by {100 * each.focal_share:+.3f} ± {100 * each.focal_sigma:.3f} % "
            "(its lens was turned, or it warmed up)"
        )
    told = [f"turned by {_sized(each.turn_deg, each.turn_sigma_deg, '°', _AXES)}"] if each.turned else []
    told += [f"moved by {_sized(each.shift_mm, each.shift_sigma_mm, ' mm', _WAYS)}"] if each.moved else []
    return f"{name} {' and '.join(told)}"


def rival_words(
    best: Hypothesis, others: Sequence[Hypothesis], calibration: Calibration, growth: float, /
) -> str | None:
    """What else it may be, and why the geometry cannot tell; None where nothing is left open.

    growth : the share by which the board would have grown for it to look so, 0 where that explains it less well.
    """
    parts = []
    verbs = {Change.FOCAL: "zoomed"}
    if others:
        names = sorted({f"{device_title(each.device)} {verbs.get(each.kind, each.kind)}" for each in others})
        parts.append(f"as well explained by: {', '.join(names)}")
    if others and len(devices_of(calibration)) == 2:
        if best.moved:
            pair = "one camera and one projector" if calibration.projector is not None else "two cameras"
            parts.append(f"{pair} cannot tell a device that moved from the other one that moved the opposite way")
        elif best.turned and {best.device} != {each.device for each in others}:
            parts.append("a turn about the line between both devices looks the same from either, and others nearly so")
    if growth:
        parts.append(
            f"or the board is {abs(growth):.2%} {'larger' if growth > 0 else 'smaller'} than was said: its size alone "
            "tells the distance of the devices; measure its ruler"
        )
    return "; ".join(parts) or None


def remedy_words(best: Hypothesis, /) -> str:
    """What to do about it."""
    if best.kind is Change.FOCAL:
        return "lock its lens, let the rig warm up, and calibrate again"
    mount = "the projector's mount" if best.device == PROJECTOR else f"the mount of {device_title(best.device)}"
    return f"check {mount}, and calibrate again"


def _sized(value: FloatArray, sigma: FloatArray, unit: str, ways: Sequence[str]) -> str:
    size = float(np.linalg.norm(value))
    along = value / max(size, 1e-300)
    spread = float(np.sqrt(((along * sigma) ** 2).sum()))
    main = int(np.argmax(np.abs(along)))
    return f"{size:.3f} ± {spread:.3f}{unit} {'' if abs(along[main]) > _ALL_BUT else 'mostly '}{ways[main]}"

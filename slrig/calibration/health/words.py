"""What changed of a rig, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slrig.calibration.health.devices import device_words
from slrig.calibration.health.drift import Change, Hypothesis
from slrig.calibration.solution import PROJECTOR
from slrig.model import Calibration, FloatArray

_AXES = ("its horizontal axis", "its vertical axis", "its viewing axis")
_WAYS = ("to its side", "up or down", "along its viewing axis")
_ALL_BUT = 0.9


def change_words(each: Hypothesis, /) -> str:
    """One sentence without an end: which device changed, and by how much, with its standard deviation."""
    name = device_words(each.device)
    if each.kind is Change.NONE:
        return "no device changed"
    if each.kind is Change.FOCAL:
        return (
            f"{name}: its focal length changed by {100 * each.focal_share:+.3f} ± {100 * each.focal_sigma:.3f} % "
            "(its lens was turned, or it warmed up)"
        )
    told = []
    if each.kind in (Change.TURNED, Change.BUMPED):
        told.append(_sized(each.turn_deg, each.turn_sigma_deg, "turned by", "°", "about", _AXES))
    if each.kind in (Change.MOVED, Change.BUMPED):
        told.append(_sized(each.shift_mm, each.shift_sigma_mm, "moved by", " mm", "", _WAYS))
    return f"{name} {' and '.join(told)}"


def rival_words(
    best: Hypothesis, others: Sequence[Hypothesis], calibration: Calibration, growth: float, /
) -> str | None:
    """What else it may be, and why the geometry cannot tell; None where nothing is left open.

    growth : the share by which the board would have grown for it to look so, 0 where that explains it less well.
    """
    parts = []
    if others:
        names = sorted({f"{device_words(each.device)} {_verb(each.kind)}" for each in others})
        parts.append(f"as well explained by: {', '.join(names)}")
    devices = len(calibration.cameras) + (calibration.projector is not None)
    if others and best.kind in (Change.MOVED, Change.BUMPED) and devices == 2:
        pair = "one camera and one projector" if calibration.projector is not None else "two cameras"
        parts.append(f"{pair} cannot tell a device that moved from the other one that moved the opposite way")
    elif others and best.kind is Change.TURNED and {best.device} != {each.device for each in others} and devices == 2:
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
    mount = "the projector's mount" if best.device == PROJECTOR else f"the mount of {device_words(best.device)}"
    return f"check {mount}, and calibrate again"


def _verb(kind: Change) -> str:
    return {Change.TURNED: "turned", Change.MOVED: "moved", Change.FOCAL: "zoomed"}.get(kind, "turned and moved")


def _sized(value: FloatArray, sigma: FloatArray, verb: str, unit: str, before: str, axes: Sequence[str]) -> str:
    size = float(np.linalg.norm(value))
    along = value / max(size, 1e-300)
    spread = float(np.sqrt(((along * sigma) ** 2).sum()))
    main = int(np.argmax(np.abs(along)))
    way = f"{before} {axes[main]}".strip()
    way = way if abs(along[main]) > _ALL_BUT else f"mostly {way}"
    return f"{verb} {size:.3f} ± {spread:.3f}{unit} {way}"

"""Are projector and camera in focus, and if not, which of them is not?"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.doctor.advice import line_advice
from slrig.doctor.findings import Finding, camera_named, fault, note, ok
from slrig.doctor.geometry import Picture
from slrig.doctor.light import Seen
from slrig.doctor.measures.pictures import BarContrast, EdgeBlur, bar_blur_px, bar_contrast, edge_blur
from slrig.model import Axis, PatternSequence
from slrig.patterns import edge_indices

_WHOLE_PERIODS = 4
_FEWEST_PIXELS = 200
_NOTE, _FAULT = 0.5, 0.25
_CAMERA_SHARE, _PROJECTOR_SHARE = 0.6, 0.35
_NEAR_PX = 12


def focus(
    name: str, sequence: PatternSequence, seen: Seen, shown: Picture, *, period_px: int
) -> tuple[float, list[Finding]]:
    """The blur of the bars, standard deviation, projector pixels, and what it leaves of lines `period_px` apart.

    The blur is that of projector, camera and pixels together, along the axis where it is greater; 0 where it is finer
    than the finest bars tell, infinite where no bars are left, NaN where no code is read.
    """
    subject = camera_named(name)
    lies = shown.orientation
    if lies is None:
        untold = "the focus cannot be judged where codes of both axes are not read"
        return math.nan, [ok("focus.untold", subject, untold)]
    blurs: list[tuple[float, float]] = []
    for axis in Axis:
        blur_px = bar_blur_px(_bars(axis, sequence, seen, shown))
        # How many camera pixels a step of one projector pixel is, across the bars.
        camera_px = float(1 / np.linalg.norm(lies.jacobian[0 if axis is Axis.COLUMN else 1]))
        # Finer than the finest bars can tell: that is sharp.
        blurs.append((0.0 if blur_px is None else blur_px, camera_px))
    worst_px, camera_px = max(blurs, key=lambda each: each[0])
    left = math.exp(-2 * (math.pi * worst_px / period_px) ** 2)
    blurred = (
        f"bars are blurred by {worst_px:.2f} projector pixels ({worst_px * camera_px:.2f} camera pixels, standard "
        "deviation)"
        if math.isfinite(worst_px)
        else "even wide bars are blurred beyond recognition"
    )
    words = f"{blurred}: {left:.0%} is left of the contrast of lines {period_px} px apart"
    if left >= _NOTE:
        return worst_px, [ok("focus.sharp", subject, words)]
    kind = fault if left < _FAULT else note
    edges = _edges(sequence, seen, shown)
    which, why, remedy = _blame(edges, worst_px * camera_px)
    advice = line_advice(worst_px, period_px, period_px)
    if advice is not None:
        remedy += (
            f"; until then line_shift_period_px = {advice.period_px} and line_steps = {advice.steps} in [scan]: "
            f"{advice.less_noise} is expected"
        )
    about = "projector" if which == "projector" else subject
    return worst_px, [kind(f"focus.{which}", about, f"{words}. {why}", remedy)]


def _bars(axis: Axis, sequence: PatternSequence, seen: Seen, shown: Picture) -> list[BarContrast]:
    """What the bars of one axis show, of each period that repeats within the part of the projector that is seen."""
    asked = seen.levels.usable
    if np.count_nonzero(asked) < _FEWEST_PIXELS:
        return []
    extent_px = float(sequence.projector.along(axis))
    if shown.known.any():
        extent_px = float(np.ptp(np.percentile(shown.position_px[axis][shown.known], (2, 98)))) + shown.cell_px[axis]
    found = []
    for each in shown.bars:
        bit = each.pattern
        period_px = float(2 * bit.cell_px * edge_indices(bit.bit, bit.bits)[1])
        if bit.axis is axis and (period_px * _WHOLE_PERIODS <= extent_px or bit.bit == bit.bits - 1):
            signal, white = each.difference[asked].astype(np.float64), seen.levels.contrast[asked]
            found.append(bar_contrast(signal, white, noise_dn=seen.levels.noise_dn, period_px=period_px))
    return found


def _edges(sequence: PatternSequence, seen: Seen, shown: Picture) -> EdgeBlur | None:
    """The blur of edges that are the surface's own: not the border of the projector's picture, and not saturated."""
    levels = seen.levels
    banned = levels.lit & ~levels.usable
    for axis, position_px in shown.position_px.items():
        cell_px = shown.cell_px[axis]
        border = (position_px < 2 * cell_px) | (position_px > sequence.projector.along(axis) - 1 - 2 * cell_px)
        banned |= border & shown.known
    asked = _grown(levels.lit, 3) & ~_grown(banned, _NEAR_PX)
    # The mean of the four white frames has half the noise of one.
    return edge_blur(levels.white, asked, noise_dn=levels.noise_dn / 2)


def _grown(mask: NDArray[np.bool_], reach_px: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0, np.bool_)


def _blame(edges: EdgeBlur | None, total_px: float) -> tuple[str, str, str]:
    """Which device is out of focus, why that is known, and what to do. total_px : of the bars, camera pixels."""
    if edges is None:
        why = "Which lens is out of focus cannot be told: the camera sees no sharp edge but those of the patterns"
        remedy = (
            "turn the projector's focus until the patterns look sharp on the object; then turn the camera's focus. Put "
            "a printed page into view and run the doctor again to have it told"
        )
        return "unknown", why, remedy
    share = (edges.sigma_px / total_px) ** 2 if math.isfinite(total_px) else 0.0
    seen = f"the sharpest edges on the object itself are blurred by {edges.sigma_px:.2f} camera pixels"
    if share >= _CAMERA_SHARE:
        remedy = (
            "focus the camera on the object, or close its aperture; if nothing in view has sharp edges, put a printed "
            "page there and run the doctor again"
        )
        return "camera", f"It is the camera's lens: {seen}, as much as the bars are", remedy
    if share <= _PROJECTOR_SHARE:
        remedy = "focus the projector on the object; set its input to the native resolution, unscaled, with sharpness"
        return "projector", f"It is the projector's lens: {seen}, far less than the bars are", f"{remedy} neutral"
    remedy = "focus the projector until the patterns are sharp on the object, then the camera, or close its aperture"
    return "both", f"Both lenses have their part in it: {seen}", remedy

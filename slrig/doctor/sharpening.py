"""Does the camera sharpen its pictures, and what does that cost?"""

from __future__ import annotations

import math

import numpy as np

from slrig.doctor.findings import Finding, camera_named, fault, note, ok
from slrig.doctor.geometry import Picture
from slrig.doctor.light import Seen
from slrig.doctor.measures.halos import Halo, halo
from slrig.doctor.measures.pictures import depth_mm_per_px
from slrig.model import Calibration

_NOTE, _FAULT = 0.01, 0.04
_SURE = 4.0


def sharpening(name: str, seen: Seen, shown: Picture, calibration: Calibration | None) -> list[Finding]:
    """Look for halos beside the edges of the bars."""
    subject, levels = camera_named(name), seen.levels
    contrast = np.where(levels.usable, levels.contrast, np.inf)
    found = halo((each.difference / contrast for each in shown.bars), levels.usable)
    if found is None:
        return [ok("sharpening.untold", subject, "it sees too few edges of wide bars to tell whether it sharpens")]
    words = f"beside edges its pictures exceed white and black by {found.overshoot:.1%} of the step"
    if found.overshoot <= max(_NOTE, _SURE * found.error):
        return [ok("sharpening.none", subject, f"{words}: it does not sharpen")]
    kind = fault if found.overshoot > _FAULT else note
    told = (
        f"the camera sharpens: {words}, most of it {found.reach_px:.1f} px from them. {_cost(found, name, calibration)}"
    )
    remedy = (
        "set its sharpness to the least, by the control sharpness (the drivers v4l2 and opencv do so where there is "
        "one; v4l2-ctl --list-ctrls lists what there is) or in the camera's own menu; switch off edge enhancement, "
        "detail and super resolution; choose a size that the sensor has, not one that the camera enlarges. Where "
        "nothing switches it off, coat printed objects matt white, or use another camera"
    )
    return [kind("sharpening.halo", subject, told, remedy)]


def _cost(found: Halo, name: str, calibration: Calibration | None) -> str:
    px = f"{found.shift_px:.2g} px"
    beside = "On even surfaces that costs little; beside print that changes the brightness threefold it moves a stripe"
    mm = float("nan")
    if calibration is not None and calibration.projector is not None and name in calibration.cameras:
        mm = found.shift_px * depth_mm_per_px(calibration.cameras[name], calibration.projector)
    if not math.isfinite(mm):
        return f"{beside} by {px} or more"
    return f"{beside} by {px} or more, which is {mm:.2g} mm of depth where the optical axes meet"

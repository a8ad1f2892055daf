"""How grey values become light: gamma, crushed blacks, clipped whites, and whether the camera is linear."""

from __future__ import annotations

import numpy as np

from slrig.doctor.findings import Finding, camera_named, note, ok
from slrig.doctor.light import Seen
from slrig.doctor.measures.levels import ResponseCurve, camera_exponent, response_curve
from slrig.doctor.viewing import Viewer
from slrig.errors import DeviceError, DeviceGoneError
from slrig.model import Black, FloatArray, Pattern, PatternSequence, Size, White

LEVELS = 33

_FRAMES = 2
_STRAIGHT = 0.1
_LINEAR = 0.1
_KNEE = 10.0
_REVERSAL = 0.03
_ALL_WHITE = 0.9
_DIMMED = (1.0, 0.5, 0.25)


def grey_fields(size: Size) -> tuple[FloatArray, PatternSequence]:
    """(33,) float64, grey values from 0 to 255, and the sequence of even fields that shows them."""
    values = np.rint(np.linspace(0, 255, LEVELS))
    patterns: list[Pattern] = [Black(), *[White()] * (LEVELS - 1)]
    profiles = tuple(np.full((1, 1), round(value), np.uint8) for value in values)
    return values, PatternSequence(size, tuple(patterns), profiles)


def response(viewer: Viewer, seen: Seen) -> tuple[ResponseCurve | None, list[Finding]]:
    """Show even greys: the curve, None where the projector cannot show any, and the findings."""
    values, sequence = grey_fields(viewer.projector.info.size)
    try:
        viewer.projector.load(sequence)
    except DeviceGoneError:
        raise
    except DeviceError as error:
        found = f"it shows no greys, so nothing can bend its black and white: {error}"
        return None, [ok("response.binary", "projector", found)]
    light = _light(viewer, seen, sequence)
    if light[1] > _ALL_WHITE:
        return None, [ok("response.binary", "projector", "it shows every grey as white: nothing bends black and white")]
    curve = response_curve([float(value) for value in values], [float(share) for share in light])
    return curve, [*_projector(curve), *_camera(viewer, seen, sequence)]


def _light(viewer: Viewer, seen: Seen, sequence: PatternSequence) -> FloatArray:
    """(33,) float64: light of each grey, 0 for black and 1 for white of this very sequence."""
    with viewer.armed(sequence, seen.exposure_s, _FRAMES * len(sequence)):
        shares = [
            float(np.mean([seen.levels.level(frame.image) for frame in viewer.frames(index, _FRAMES)]))
            for index in range(len(sequence))
        ]
    levels = np.array(shares)
    return np.asarray((levels - levels[0]) / (levels[-1] - levels[0]), np.float64)


def _projector(curve: ResponseCurve) -> list[Finding]:
    law = f"(rms {curve.residual:.1%} off that law)"
    full_range = "set the output's range to full (0 to 255, not video levels), and the projector's"
    faults = [
        (
            curve.reversal > _REVERSAL,
            "reversed",
            f"a higher grey value gives less light, by up to {curve.reversal:.0%} of white",
            "switch off dynamic contrast, automatic iris, eco and image enhancement in the projector's menu",
        ),
        (
            curve.black_knee > _KNEE,
            "crushed",
            f"grey values up to {curve.black_knee:.0f} of 255 are as dark as black",
            f"{full_range} brightness higher",
        ),
        (
            curve.white_knee < 255 - _KNEE,
            "clipped",
            f"grey values from {curve.white_knee:.0f} of 255 on are as bright as white",
            f"{full_range} contrast lower",
        ),
        (
            abs(curve.gamma - 1) > _STRAIGHT,
            "gamma",
            f"light grows with the grey value to the power of {curve.gamma:.2f}, not in proportion {law}",
            "black and white patterns do not mind, unless something on their way makes greys of them: keep the "
            "output at the projector's native resolution, unscaled, sharpness neutral. If the menu offers a gamma "
            "of 1 (linear, DICOM off, no presentation mode), choose it",
        ),
    ]
    straight = f"light grows in proportion to the grey value (power {curve.gamma:.2f}, rms {curve.residual:.1%} off)"
    return [note(f"response.{name}", "projector", found, remedy) for wrong, name, found, remedy in faults if wrong] or [
        ok("response.straight", "projector", straight)
    ]


def _camera(viewer: Viewer, seen: Seen, sequence: PatternSequence) -> list[Finding]:
    """Whether values grow with the exposure in proportion; said of the camera alone, whatever the projector does."""
    exposures_s: list[float] = []
    contrast_dn: list[float] = []
    usable = seen.levels.usable
    for share in _DIMMED:
        with viewer.armed(sequence, share * seen.exposure_s, 2 * _FRAMES):
            dark, bright = (
                np.mean([frame.image[usable].mean() for frame in viewer.frames(index, _FRAMES)])
                for index in (0, len(sequence) - 1)
            )
        exposures_s.append(viewer.exposure_s)
        contrast_dn.append(float(bright - dark))
    if min(contrast_dn) <= 0 or exposures_s[-1] > 0.75 * exposures_s[0]:
        return []
    exponent = camera_exponent(exposures_s, contrast_dn)
    subject = camera_named(viewer.name)
    if abs(exponent - 1) <= _LINEAR:
        found = f"its values grow in proportion to the exposure (power {exponent:.2f})"
        return [ok("response.camera", subject, found)]
    found = (
        f"its values grow with the exposure to the power of {exponent:.2f}, not in proportion: that moves stripes "
        "little, since white and black frames are bent alike, but the errors that scans state are those of a straight "
        "camera"
    )
    remedy = (
        "set gamma to 1 (the control gamma, 100 of a USB camera, which the drivers v4l2 and opencv set where there is "
        "one), and switch off automatic gain, wide dynamic range and tone curves; many cameras bend their pictures "
        "whatever is set, raw formats (GREY, Y10, Bayer) are straight. If it is linear, the projector's light "
        "flickers: see that finding"
    )
    return [note("response.camera", subject, found, remedy)]

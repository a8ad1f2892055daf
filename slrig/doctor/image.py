"""Focus of both lenses, sharpening by the camera, and response of projector and camera to grey values."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.doctor.advice import advise_lines
from slrig.doctor.light import (
    MIN_CODE_SHARE,
    MIN_CODE_SNR,
    CameraSession,
    Finding,
    LightMeasurement,
    LocatedPicture,
    camera_label,
    fault,
    format_ms,
    note,
    ok,
)
from slrig.doctor.measures import (
    BarContrast,
    EdgeBlur,
    Halo,
    ResponseCurve,
    bar_blur_px,
    bar_contrast,
    depth_mm_per_px,
    edge_blur,
    fit_camera_exponent,
    fit_response_curve,
    measure_halo,
)
from slrig.errors import DeviceError, DeviceGoneError
from slrig.model import Axis, Black, Calibration, FloatArray, Gray, Pattern, PatternSequence, Size, White, gray_index
from slrig.patterns import cell_centre_px, edge_indices

_WHOLE_PERIODS = 4
_MIN_BAR_PIXELS = 200
_NOTE_CONTRAST, _FAULT_CONTRAST = 0.5, 0.25
_CAMERA_SHARE, _PROJECTOR_SHARE = 0.6, 0.35
_BORDER_PX = 12
_RESOLVED = 0.3  # square wave of bars over white less black
_MAX_CHANGE = 0.15  # of bars that are shown again, over their contrast
_ELSEWHERE = 0.7  # of that change, what another contrast leaves; bars that moved leave more

_MIN_CERTAIN = 0.5  # share of the pixels by which a bit can be read
_MAX_PAIRS = 20_000
_NOTE_DISAGREEMENT_PX = 1.0

_NOTE_OVERSHOOT, _FAULT_OVERSHOOT = 0.01, 0.04
_MIN_OVERSHOOT_SNR = 4.0

GREY_LEVELS = 33
_GREY_FRAMES = 2
_GAMMA_TOLERANCE = 0.1
_EXPONENT_TOLERANCE = 0.1
_CAMERA_EXPONENTS = (0.3, 3.0)  # of a camera that has a tone curve
_MAX_KNEE = 10.0
_MAX_REVERSAL = 0.03
_ALL_WHITE = 0.9
_EXPOSURE_SHARES, _USUAL_SHARES = (1.0, 0.5, 0.25, 1 / 16, 1 / 64, 1 / 256), 3
_PLATEAU_POWER, _NO_POWER = 0.7, 0.15  # of the values' growth with the exposure, over the greatest, and at least
_DARKER, _PLATEAU_SHARE = 0.8, 0.97  # of the brightness at the longest exposure
_MIN_PLATEAU = 1.25  # a curve that bends most still grows by more than a plateau within such a factor
_BISECTIONS = 5


# ---- Focus


def check_focus(
    name: str,
    sequence: PatternSequence,
    light: LightMeasurement,
    picture: LocatedPicture,
    *,
    period_px: int,
    steps: int,
    sines: bool = False,
) -> tuple[float, list[Finding]]:
    """Return the blur of the bars, standard deviation in projector pixels, and whether lines or `sines` of `period_px`
    survive.

    The blur is that of projector, camera and pixels together, along the axis where it is greater: 0 if even the finest
    bars are sharp, infinite if no bars are visible, NaN if no code can be read.
    """
    subject = camera_label(name)
    orientation = picture.orientation
    if orientation is None:
        message = "the focus is unknown, because codes of both axes cannot be read"
        return math.nan, [ok("focus.unmeasured", subject, message)]
    blurs: list[tuple[float, float]] = []
    for axis in Axis:
        blur_px = bar_blur_px(_bar_contrasts(axis, sequence, light, picture))
        # Length of one projector pixel across the bars, camera pixels.
        camera_px = float(1 / np.linalg.norm(orientation.jacobian[0 if axis is Axis.COLUMN else 1]))
        blurs.append((0.0 if blur_px is None else blur_px, camera_px))
    worst_px, camera_px = max(blurs, key=lambda each: each[0])
    contrast = math.exp(-2 * (math.pi * worst_px / period_px) ** 2)
    blurred = (
        f"bars are blurred by {worst_px:.2f} projector pixels ({worst_px * camera_px:.2f} camera pixels, standard "
        "deviation)"
        if math.isfinite(worst_px)
        else "even wide bars are blurred beyond recognition"
    )
    patterns = f"sinusoids of {period_px} px" if sines else f"lines {period_px} px apart"
    message = f"{blurred}: {patterns} keep {contrast:.0%} of their contrast"
    if contrast >= _NOTE_CONTRAST:
        return worst_px, [ok("focus.sharp", subject, message)]
    kind = fault if contrast < _FAULT_CONTRAST else note
    device, reason, remedy = _defocused_device(_object_edge_blur(sequence, light, picture), worst_px * camera_px)
    advice = advise_lines(worst_px, period_px, steps if sines else period_px, sines=sines)
    if advice is not None:
        options = " and ".join(f"{key} = {value}" for key, value in advice.options.items())
        remedy += f"; until then {options} in [scan]: {advice.gain_text} is expected"
    subject = "projector" if device == "projector" else subject
    return worst_px, [kind(f"focus.{device}", subject, f"{message}. {reason}", remedy)]


def _bar_contrasts(
    axis: Axis, sequence: PatternSequence, light: LightMeasurement, picture: LocatedPicture
) -> list[BarContrast]:
    """Return the contrast of each period of bars that repeats within the visible part of the projector."""
    usable = light.levels.usable
    if np.count_nonzero(usable) < _MIN_BAR_PIXELS:
        return []
    extent_px = float(sequence.projector.along(axis))
    if picture.known.any():
        low, high = np.percentile(picture.position_px[axis][picture.known], (2, 98))
        extent_px = float(high - low) + picture.cell_px[axis]
    contrasts = []
    for each in picture.bars:
        bit, period_px = each.pattern, _period_px(each.pattern)
        if bit.axis is axis and (period_px * _WHOLE_PERIODS <= extent_px or bit.bit == bit.bits - 1):
            signal, white = each.difference[usable].astype(np.float64), light.levels.contrast[usable]
            contrasts.append(bar_contrast(signal, white, noise_dn=light.levels.noise_dn, period_px=period_px))
    return contrasts


def _period_px(bit: Gray) -> float:
    return float(2 * bit.cell_px * edge_indices(bit.bit, bit.bits)[1])


def check_steady(
    session: CameraSession, sequence: PatternSequence, light: LightMeasurement, picture: LocatedPicture
) -> list[Finding]:
    """Show the finest bars that the camera resolves once more: a lens that moves shows, whatever its driver answers."""
    levels, usable = light.levels, light.levels.usable
    noise = 4 * levels.noise_dn**2
    floor = _RESOLVED * float(np.mean(levels.contrast[usable] ** 2))
    bars = sorted(picture.bars, key=lambda each: _period_px(each.pattern))
    resolved = [k for k, each in enumerate(bars) if float(np.mean(each.difference[usable] ** 2)) - noise / 2 > floor]
    if not resolved or np.count_nonzero(usable) < _MIN_BAR_PIXELS:
        return []
    subject = camera_label(session.name)
    # Of a picture that was blurred, finer bars appear as it gets sharp.
    for finest in bars[max(resolved[0] - 1, 0) : resolved[0] + 1]:
        was = finest.difference[usable]
        power = max(float(np.mean(was**2)), floor)
        for _ in range(2):
            with session.arm(sequence, light.exposure_s, 2):
                lit, dark = (
                    session.capture_frames(sequence.patterns.index(each))[0].image[usable].astype(np.float32)
                    for each in (finest.pattern, finest.pattern.inverse)
                )
            again = lit - dark
            change = math.sqrt(max(float(np.mean((again - was) ** 2)) - noise, 0) / power)
            shown = f"bars of {_period_px(finest.pattern):g} px"
            message = f"{shown} differ by {change:.0%} of their contrast from the same bars before"
            # A picture that missed its refresh is shown again.
            if change < _MAX_CHANGE:
                break
        else:
            break
    else:
        return [ok("picture.steady", subject, message)]
    share = float(np.mean(again * was)) / power
    elsewhere = math.sqrt(max(float(np.mean((again - share * was) ** 2)) - noise, 0) / power)
    if share > 0 and elsewhere < change * _ELSEWHERE:
        message += f", earlier in this examination: they stand where they stood, with {share:.0%} of their contrast"
        remedy = (
            "its focus moves by itself, though autofocus is switched off or its focus is set: use another camera, or "
            "fix the lens"
        )
        return [fault("picture.steady", subject, message, remedy)]
    remedy = (
        "see that camera, projector and object stand still; switch image stabilisation off; if it is neither, the lens "
        "moves by itself: use another camera, or fix the lens"
    )
    return [fault("picture.steady", subject, f"{message}, earlier in this examination", remedy)]


def _object_edge_blur(sequence: PatternSequence, light: LightMeasurement, picture: LocatedPicture) -> EdgeBlur | None:
    """Return the blur of edges on the object: without the border of the projector's picture and saturated areas."""
    levels = light.levels
    excluded = levels.lit & ~levels.usable
    for axis, position_px in picture.position_px.items():
        cell_px = picture.cell_px[axis]
        border = (position_px < 2 * cell_px) | (position_px > sequence.projector.along(axis) - 1 - 2 * cell_px)
        excluded |= border & picture.known
    region = _dilate(levels.lit, 3) & ~_dilate(excluded, _BORDER_PX)
    # The mean of the four white frames has half the noise of one.
    return edge_blur(levels.white, region, noise_dn=levels.noise_dn / 2)


def _dilate(mask: NDArray[np.bool_], reach_px: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0, np.bool_)


def _defocused_device(edges: EdgeBlur | None, total_px: float) -> tuple[str, str, str]:
    """Return which device is out of focus, the reason, and the remedy. total_px : blur of the bars, camera pixels."""
    if edges is None:
        reason = "Which lens is out of focus is unknown: the camera sees no sharp edges except those of the patterns"
        remedy = (
            "turn the projector's focus until the patterns look sharp on the object; then turn the camera's focus. Put "
            "a printed page into view and run the doctor again to find out which lens it is"
        )
        return "unknown", reason, remedy
    share = (edges.sigma_px / total_px) ** 2 if math.isfinite(total_px) else 0.0
    measured = f"the sharpest edges on the object itself are blurred by {edges.sigma_px:.2f} camera pixels"
    if share >= _CAMERA_SHARE:
        remedy = (
            "focus the camera on the object, or close its aperture; if nothing in view has sharp edges, put a printed "
            "page there and run the doctor again"
        )
        return "camera", f"It is the camera's lens: {measured}, as much as the bars are", remedy
    if share <= _PROJECTOR_SHARE:
        remedy = (
            "focus the projector on the object; set its input to the native resolution, unscaled, with sharpness "
            "neutral"
        )
        return "projector", f"It is the projector's lens: {measured}, far less than the bars are", remedy
    remedy = "focus the projector until the patterns are sharp on the object, then the camera, or close its aperture"
    return "both", f"Both lenses contribute: {measured}", remedy


# ---- Calibration


def check_calibrated(
    name: str, light: LightMeasurement, picture: LocatedPicture, calibration: Calibration | None
) -> list[Finding]:
    """Look whether columns and rows agree by the calibration: a zoom, overscan or keystone correction that was changed
    since, and a device that was moved, show; one that was there when it was made is part of it.
    """
    # Takes two seconds to import, and is needed here only.
    from slrig.reconstruction import PixelPairs, check_calibration

    pinholes = None if calibration is None else (calibration.cameras.get(name), calibration.projector)
    if pinholes is None or pinholes[0] is None or pinholes[1] is None:
        return []
    code, camera_px, projector_px = _decoded_pixels(light, picture)
    # A point is anywhere within its cells.
    sigma_px = np.full(len(camera_px), math.hypot(*(each.cell_px for each in code)) / math.sqrt(12))
    pairs = PixelPairs(camera_px, projector_px, sigma_px, Axis.COLUMN).thinned(_MAX_PAIRS)
    check = check_calibration(pinholes[0], pinholes[1], pairs, code)
    if check is None:
        return []
    message = (
        f"by the calibration of {camera_label(name)}, columns and rows disagree by {check.median_px:.1f} projector "
        f"pixels (median of {check.pairs} points)"
    )
    if not check.is_refuted and check.systematic_px <= _NOTE_DISAGREEMENT_PX:
        return [ok("picture.calibrated", "projector", message)]
    remedy = (
        "switch keystone correction, digital zoom and overscan off, or set them as they were when it was calibrated; "
        "if nothing of that was changed, a device was moved or its lens turned: slrig verify, or calibrate again"
    )
    kind = fault if check.is_refuted else note
    return [kind("picture.calibrated", "projector", f"{message}{check.cause and f': {check.cause}'}", remedy)]


def _decoded_pixels(
    light: LightMeasurement, picture: LocatedPicture
) -> tuple[tuple[Gray, ...], FloatArray, FloatArray]:
    """The codes of both axes as far as their bits can be read, and (n, 2) pixels of camera and projector."""
    levels, mask = light.levels, picture.known
    threshold = np.maximum(MIN_CODE_SHARE * levels.contrast, MIN_CODE_SNR * levels.noise_dn)
    codes: list[Gray] = []
    positions: list[FloatArray] = []
    for axis in Axis:
        read: list[NDArray[np.bool_]] = []
        bars = sorted((each for each in picture.bars if each.pattern.axis is axis), key=lambda each: each.pattern.bit)
        for each in bars:
            certain = mask & (np.abs(each.difference) > threshold)
            if np.count_nonzero(certain) < _MIN_CERTAIN * np.count_nonzero(mask):
                break
            mask = certain
            read.append(each.difference > 0)
        if not read:
            return (), np.zeros((0, 2)), np.zeros((0, 2))
        first = bars[0].pattern
        code = replace(first, bit=0, bits=len(read), cell_px=first.cell_px * 2 ** (first.bits - len(read)))
        codes.append(code)
        positions.append(cell_centre_px(gray_index(np.stack(read)), cell_px=code.cell_px, offset_px=code.offset_px))
    camera_px = np.argwhere(mask)[:, ::-1].astype(np.float64)
    return tuple(codes), camera_px, np.column_stack([each[mask] for each in positions])


# ---- Sharpening


def check_sharpening(
    name: str, light: LightMeasurement, picture: LocatedPicture, calibration: Calibration | None
) -> list[Finding]:
    """Look for halos at the edges of the bars."""
    subject, levels = camera_label(name), light.levels
    contrast = np.where(levels.usable, levels.contrast, np.inf)
    halo = measure_halo((each.difference / contrast for each in picture.bars), levels.usable)
    if halo is None:
        message = "whether it sharpens is unknown: it sees too few edges of wide bars"
        return [ok("sharpening.unmeasured", subject, message)]
    measured = f"next to edges its pictures exceed white and black by {halo.overshoot:.1%} of the step"
    if halo.overshoot <= max(_NOTE_OVERSHOOT, _MIN_OVERSHOOT_SNR * halo.error):
        return [ok("sharpening.none", subject, f"{measured}: it does not sharpen")]
    kind = fault if halo.overshoot > _FAULT_OVERSHOOT else note
    effect = _sharpening_effect(halo, name, calibration)
    message = f"the camera sharpens: {measured}, most of it {halo.reach_px:.1f} px from them. {effect}"
    remedy = (
        "set its sharpness to the minimum, by the control sharpness (the drivers v4l2 and opencv do so if there is "
        "one; v4l2-ctl --list-ctrls lists all controls) or in the camera's own menu; switch off edge enhancement, "
        "detail and super resolution; choose a size that the sensor has, not one that the camera enlarges. If "
        "nothing switches it off, coat printed objects matt white, or use another camera"
    )
    return [kind("sharpening.halo", subject, message, remedy)]


def _sharpening_effect(halo: Halo, name: str, calibration: Calibration | None) -> str:
    effect = (
        "On even surfaces that costs little; next to print that changes the brightness threefold it moves a stripe by "
        f"{halo.shift_px:.2g} px or more"
    )
    depth_mm = float("nan")
    if calibration is not None and calibration.projector is not None and name in calibration.cameras:
        depth_mm = halo.shift_px * depth_mm_per_px(calibration.cameras[name], calibration.projector)
    if not math.isfinite(depth_mm):
        return effect
    return f"{effect}, which is {depth_mm:.2g} mm of depth where the optical axes meet"


# ---- Response to grey values


def grey_fields(size: Size) -> tuple[FloatArray, PatternSequence]:
    """(33,) float64, grey values from 0 to 255, and the sequence of even fields that shows them."""
    values = np.rint(np.linspace(0, 255, GREY_LEVELS))
    patterns: list[Pattern] = [Black(), *[White()] * (GREY_LEVELS - 1)]
    profiles = tuple(np.full((1, 1), round(value), np.uint8) for value in values)
    return values, PatternSequence(size, tuple(patterns), profiles)


def measure_response(
    session: CameraSession, light: LightMeasurement, exponent: float | None
) -> tuple[ResponseCurve | None, list[Finding]]:
    """Show even greys, and return their curve, None if the projector cannot show greys, and the findings.

    exponent : by which the camera's values grow with the exposure; None if unknown.
    """
    values, sequence = grey_fields(session.projector.info.size)
    try:
        session.projector.load(sequence)
    except DeviceGoneError:
        raise
    except DeviceError as error:
        message = f"it shows no greys, so nothing can bend its black and white: {error}"
        return None, [ok("response.binary", "projector", message)]
    # What the camera makes of light is not the projector's fault: bent darks look like a limited range. One whose
    # values do not follow the exposure has no curve that could be undone.
    least, most = _CAMERA_EXPONENTS
    is_curve = exponent is not None and least < exponent < most and abs(exponent - 1) > _EXPONENT_TOLERANCE
    shares = _measure_greys(session, light, sequence, exponent if exponent is not None and is_curve else 1.0)
    if shares[1] > _ALL_WHITE:
        message = "it shows every grey as white: nothing bends black and white"
        return None, [ok("response.binary", "projector", message)]
    curve = fit_response_curve([float(value) for value in values], [float(share) for share in shares])
    return curve, _check_projector_response(curve)


def _measure_greys(
    session: CameraSession, light: LightMeasurement, sequence: PatternSequence, exponent: float
) -> FloatArray:
    """(33,) float64: light of each grey, 0 for black and 1 for white of this sequence. exponent : of the camera."""
    with session.arm(sequence, light.exposure_s, _GREY_FRAMES * len(sequence)):
        shares = [
            float(np.mean([light.levels.relative_level(frame.image, exponent) for frame in frames]))
            for frames in (session.capture_frames(index, _GREY_FRAMES) for index in range(len(sequence)))
        ]
    levels = np.array(shares)
    return np.asarray((levels - levels[0]) / (levels[-1] - levels[0]), np.float64)


def _check_projector_response(curve: ResponseCurve) -> list[Finding]:
    full_range = "set the output's range to full (0 to 255, not video levels), and the projector's"
    faults = [
        (
            curve.reversal > _MAX_REVERSAL,
            "reversed",
            f"a higher grey value gives less light, by up to {curve.reversal:.0%} of white",
            "switch off dynamic contrast, automatic iris, eco and image enhancement in the projector's menu",
        ),
        (
            curve.black_knee > _MAX_KNEE,
            "crushed",
            f"grey values up to {curve.black_knee:.0f} of 255 are as dark as black",
            f"{full_range} brightness higher",
        ),
        (
            curve.white_knee < 255 - _MAX_KNEE,
            "clipped",
            f"grey values from {curve.white_knee:.0f} of 255 on are as bright as white",
            f"{full_range} contrast lower",
        ),
        (
            abs(curve.gamma - 1) > _GAMMA_TOLERANCE,
            "gamma",
            f"light grows with the grey value to the power of {curve.gamma:.2f}, not in proportion (rms "
            f"{curve.residual:.1%} from that law)",
            "black and white patterns do not suffer, and sinusoids of four steps little, unless something on their way "
            "makes greys of them: keep the "
            "output at the projector's native resolution, unscaled, sharpness neutral. If the menu offers a gamma "
            "of 1 (linear, DICOM off, no presentation mode), choose it",
        ),
    ]
    findings = [
        note(f"response.{name}", "projector", message, remedy) for is_wrong, name, message, remedy in faults if is_wrong
    ]
    proportional = f"light grows in proportion to the grey value (power {curve.gamma:.2f}, rms {curve.residual:.1%})"
    return findings or [ok("response.straight", "projector", proportional)]


# ---- Exposures of the camera


def check_exposures(
    session: CameraSession, sequence: PatternSequence, light: LightMeasurement
) -> tuple[LightMeasurement, float | None, list[Finding]]:
    """Compare a camera's values at several exposures: its driver may answer for an exposure that it never took.

    Return the light at the exposures that the camera really takes, the power by which its values grow with them, None
    if unknown, and the findings. sequence : with white and black.
    """

    def contrast_dn(wanted_s: float) -> float:
        with session.arm(sequence, wanted_s, 2 * _GREY_FRAMES):
            dark, bright = (
                np.mean(
                    [each.image[light.levels.usable].mean() for each in session.capture_frames(index, _GREY_FRAMES)]
                )
                for index in map(sequence.patterns.index, (Black(), White()))
            )
        return float(bright - dark)

    measured: dict[float, float] = {}
    for number, share in enumerate(_EXPOSURE_SHARES):
        level_dn = contrast_dn(share * light.exposure_s)
        measured[session.exposure_s] = level_dn
        if number >= _USUAL_SHARES - 1 and level_dn < _DARKER * next(iter(measured.values())):
            break
    exposures_s, levels_dn = list(measured), np.array(list(measured.values()))
    if levels_dn.min() <= 0 or exposures_s[-1] > 0.75 * exposures_s[0]:
        return light, None, []
    subject, taken_s = camera_label(session.name), exposures_s[0]
    powers = np.diff(np.log(levels_dn)) / np.diff(np.log(exposures_s))
    if powers.max() < _NO_POWER:
        message = f"its picture is as bright at {format_ms(exposures_s[-1])} as at {format_ms(taken_s)}"
        remedy = (
            "its exposure is its own, whatever its driver answers: switch automatic exposure and gain off with the "
            "maker's program, or use another camera; frames that its automatic changes contradict one another"
        )
        return light, None, [note("exposure.ignored", subject, message, remedy)]
    if powers[0] < _PLATEAU_POWER * powers.max():
        plateau_dn = _PLATEAU_SHARE * levels_dn[0]
        followed_s = max(each for each, level_dn in measured.items() if level_dn < plateau_dn)
        for _ in range(_BISECTIONS):
            is_taken = contrast_dn(math.sqrt(followed_s * taken_s)) >= plateau_dn
            followed_s, taken_s = (followed_s, session.exposure_s) if is_taken else (session.exposure_s, taken_s)
    if exposures_s[0] < _MIN_PLATEAU * taken_s:
        exponent = fit_camera_exponent(exposures_s, levels_dn.tolist())
        return light, exponent, [_check_camera_linearity(subject, exponent)]
    message = (
        f"at {format_ms(exposures_s[0])} its picture is as bright as at {format_ms(taken_s)}: it exposes no longer, "
        "whatever its driver answers"
    )
    remedy = (
        f"write an exposure_s of {float(f'{taken_s:.2g}'):g} or less; for more light open the lens's aperture, bring "
        "the projector nearer, or raise the gain"
    )
    return light.limited(taken_s), None, [note("exposure.clamped", subject, message, remedy)]


def _check_camera_linearity(subject: str, exponent: float) -> Finding:
    if abs(exponent - 1) <= _EXPONENT_TOLERANCE:
        message = f"its values grow in proportion to the exposure (power {exponent:.2f})"
        return ok("response.camera", subject, message)
    message = (
        f"its values grow with the exposure to the power of {exponent:.2f}, not in proportion: that moves stripes "
        "little, since white and black frames are bent alike, but scans state errors as for a linear camera"
    )
    remedy = (
        "set gamma to 1 (the control gamma, 100 of a USB camera, which the drivers v4l2 and opencv set if there is "
        "one), and switch off automatic gain, wide dynamic range and tone curves; many cameras bend their pictures "
        "in every mode except raw formats (GREY, Y10, Bayer). If the camera is linear, the projector's light "
        "flickers: see that finding"
    )
    return note("response.camera", subject, message, remedy)

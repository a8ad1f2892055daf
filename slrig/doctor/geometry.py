"""Do the frames show our patterns, and how does the projector's picture lie in the camera's?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.capture import Evidence
from slrig.doctor.findings import Finding, camera_named, fault, note, ok
from slrig.doctor.light import Seen
from slrig.doctor.measures.pictures import Orientation, apart_deg, expected_orientation, orientation
from slrig.doctor.viewing import Viewer
from slrig.model import Axis, Calibration, FloatArray, Gray, PatternSequence, Shot, gray_index
from slrig.patterns import cell_centre_px

_COARSE_BITS = 6
_SURE_SHARE = 0.25
_SURE_NOISES = 5.0
_TURNED_DEG = 60.0
_COARSE_CAMERA = 0.5
_SMALL_PART = 0.1


@dataclass(frozen=True, slots=True)
class Bars:
    """One Gray bit less its inverse, (H, W) float32, DN."""

    pattern: Gray
    difference: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Picture:
    """Where a camera sees the projector's picture.

    bars : every Gray bit with its inverse. position_px : of each axis that the patterns encode, (H, W) float64, the
    middle of a coarse cell; cell_px : how wide such cells are. known : (H, W) bool, where all of them are sure.
    """

    bars: tuple[Bars, ...]
    position_px: Mapping[Axis, FloatArray]
    cell_px: Mapping[Axis, int]
    known: NDArray[np.bool_]
    orientation: Orientation | None


def picture(
    viewer: Viewer, sequence: PatternSequence, seen: Seen, calibration: Calibration | None
) -> tuple[Picture, list[Finding]]:
    """Show every pattern once: what the camera makes of them, and the findings."""
    bars, sound = _played(viewer, sequence, seen)
    position_px: dict[Axis, FloatArray] = {}
    cell_px: dict[Axis, int] = {}
    known = seen.levels.usable.copy()
    for axis in Axis:
        coarse = sorted((each for each in bars if each.pattern.axis is axis), key=lambda each: each.pattern.bit)
        coarse = coarse[:_COARSE_BITS]
        if not coarse:
            continue
        first = coarse[0].pattern
        cell_px[axis] = first.cell_px * 2 ** (first.bits - len(coarse))
        index = gray_index(np.stack([each.difference > 0 for each in coarse]))
        position_px[axis] = cell_centre_px(index, cell_px=cell_px[axis], offset_px=first.offset_px)
        least = np.maximum(_SURE_SHARE * seen.levels.contrast, _SURE_NOISES * seen.levels.noise_dn)
        for each in coarse:
            known &= np.abs(each.difference) > least
    lies = None
    if len(position_px) == len(Axis):
        lies = orientation(position_px[Axis.COLUMN], position_px[Axis.ROW], known)
    shown = Picture(bars, position_px, cell_px, known, lies)
    return shown, [sound, *_lies(viewer, sequence, shown, calibration)]


def _played(viewer: Viewer, sequence: PatternSequence, seen: Seen) -> tuple[tuple[Bars, ...], Finding]:
    """Every Gray bit with its inverse, and whether the frames are what they claim."""
    patterns = sequence.patterns
    evidence = Evidence(patterns, {viewer.name: viewer.camera.info.format})
    causes: list[str] = []
    waiting: dict[Gray, NDArray[np.float32]] = {}
    bars: list[Bars] = []
    with viewer.armed(sequence, seen.exposure_s, len(sequence)):
        for index, pattern in enumerate(patterns):
            image = viewer.frames(index)[0].image
            causes += [str(each) for each in evidence.add_shot(Shot(index, viewer.name, image))]
            if not isinstance(pattern, Gray):
                continue
            positive = Gray(pattern.axis, pattern.bit, pattern.bits, pattern.cell_px, pattern.offset_px)
            other = waiting.pop(positive, None)
            if other is None:
                waiting[positive] = image.astype(np.float32)
            else:
                difference = image.astype(np.float32) - other
                bars.append(Bars(positive, -difference if pattern.inverted else difference))
    subject = camera_named(viewer.name)
    if not causes:
        return tuple(bars), ok(
            "patterns.verified", subject, f"{evidence.summary()}: it sees our patterns, each in its turn"
        )
    found = f"{len(causes)} of {len(patterns)} frames contradict the others, the first of them: {causes[0]}"
    remedy = "put right what the other findings name, and run the doctor again; slrig conform tells faults of drivers"
    return tuple(bars), fault("patterns.contradicted", subject, found, remedy)


def _lies(
    viewer: Viewer, sequence: PatternSequence, shown: Picture, calibration: Calibration | None
) -> Iterator[Finding]:
    subject, lies = camera_named(viewer.name), shown.orientation
    if lies is None:
        missing = "its patterns have one axis" if len(shown.position_px) < len(Axis) else "too few codes can be read"
        yield ok("picture.untold", subject, f"how the picture lies in the image cannot be told: {missing}")
        return
    expected = None
    if calibration is not None and calibration.projector is not None and viewer.name in calibration.cameras:
        expected = expected_orientation(calibration.cameras[viewer.name], calibration.projector)
    apart = 0.0 if expected is None else apart_deg(lies, expected)
    if lies.mirrored:
        # Against a picture that lies as the calibration says, or upright where there is none.
        relative = lies.jacobian if expected is None else lies.jacobian @ np.linalg.inv(expected.jacobian)
        way = "left and right" if relative[0, 0] < relative[1, 1] else "top and bottom"
        found = f"{subject} sees its picture mirrored, {way} exchanged: no calibration can describe that"
        remedy = (
            "set the projector's menu to front projection (rear projection and ceiling mount each mirror the picture). "
            "If light does pass through a screen or over one mirror, set it to what undoes that. If the camera's "
            "driver flips its image, switch that off"
        )
        yield fault("picture.mirrored", "projector", found, remedy)
        return
    if apart > _TURNED_DEG:
        found = f"{subject} sees its picture turned by {apart:.0f}° against the calibration"
        remedy = (
            "set the projector's menu to the projection that it was calibrated with (upright, not ceiling mount; "
            "on a computer's output: rotation normal), or turn the camera's image back in its driver's options, "
            "or calibrate again"
        )
        yield fault("picture.turned", "projector", found, remedy)
        return
    against = "" if expected is None else f", {apart:.0f}° from what the calibration foresees"
    found = (
        f"the projector's picture is not mirrored, and turned by {lies.turn_deg:.0f}° in the image{against}; one of "
        f"its pixels is {lies.camera_px:.2f} camera pixels long"
    )
    yield ok("picture.upright", subject, found)
    yield _coverage(subject, sequence, shown)
    if lies.camera_px < _COARSE_CAMERA:
        length = f"one projector pixel is only {lies.camera_px:.2f} camera pixels long"
        remedy = (
            "bring the camera nearer or give it a longer lens, or choose line_shift_period_px = "
            f"{int(np.ceil(4 / lies.camera_px))} or more in [scan]"
        )
        yield note("picture.resolution", subject, f"{length}: fine patterns are lost between them", remedy)


def _coverage(subject: str, sequence: PatternSequence, shown: Picture) -> Finding:
    parts, share = [], 1.0
    for axis, position_px in shown.position_px.items():
        half_px, last_px = shown.cell_px[axis] / 2, sequence.projector.along(axis) - 1
        low, high = np.percentile(position_px[shown.known], (0.5, 99.5))
        first_px, final_px = max(low - half_px, 0.0), min(high + half_px, last_px)
        parts.append(f"{axis}s {first_px:.0f} to {final_px:.0f} of {last_px + 1}")
        share *= (final_px - first_px) / last_px
    found = f"it sees the projector's {' and '.join(parts)}, about"
    if share >= _SMALL_PART:
        return ok("picture.part", subject, found)
    remedy = "use more of the projector: bring it nearer, zoom it, or turn it to what the camera sees"
    return note("picture.part", subject, f"{found}: {share:.0%} of its pixels are used", remedy)

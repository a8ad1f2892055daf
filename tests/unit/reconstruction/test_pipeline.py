"""Pipeline of one camera from frames to linked curves, on a scene with known projector coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    CameraFormat,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    Pattern,
    Refusal,
    Shot,
    Size,
)
from slrig.patterns.codes import cell_positions, edge_positions, index_of_word, line_positions
from slrig.patterns.sequence import scan_patterns
from slrig.reconstruction.decoded_image import CodeTables, ReconstructionLimits
from slrig.reconstruction.frames import FrameStacks, axis_frames, axis_patterns, reference_repeats, used_shots
from slrig.reconstruction.pipeline import CameraCurves, CameraStream, camera_curves
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import grid, rms, seen_by_camera

CAMERA = Size(210, 100)
PROJECTOR, WIDE = Size(128, 96), Size(160, 128)
Scene = Callable[[FloatArray, FloatArray], FloatArray]


def slope(x: FloatArray, y: FloatArray) -> FloatArray:
    """A slanted plate: 0.52 projector columns per camera pixel."""
    return np.asarray(8.0 + 0.52 * x + 0.03 * y)


def cliff(x: FloatArray, y: FloatArray) -> FloatArray:
    """The same with a step of twelve columns, and a shadow beside it (NaN)."""
    stepped = slope(x, y) + np.where(x > 110, 12.0, 0.0)
    return np.asarray(np.where((x > 98) & (x <= 110), np.nan, stepped))


def rendered(scene: Scene, patterns: tuple[Pattern, ...]) -> Capture:
    """Every column pattern as a blurred, noisy 8-bit camera sees it."""
    return seen_by_camera(scene(*grid(CAMERA.shape)), patterns, PROJECTOR, blur_px=0.3, smear_px=0.9)


def patterns(
    *, line_shift: bool = True, cell_px: int | None = None, projector: Size = PROJECTOR, axis: Axis = Axis.COLUMN
) -> tuple[Pattern, ...]:
    shown = scan_patterns(
        projector, line_shift=line_shift, period_px=8, line_width_px=1, gray_cell_px=cell_px, gray_offset_px=0,
        rows=axis is Axis.ROW,
    )  # fmt: skip
    return tuple(each for each in shown if getattr(each, "axis", axis) is axis)


def walk(
    capture: Capture, *, limits: ReconstructionLimits | None = None, edges: bool = False, axis: Axis = Axis.COLUMN
) -> tuple[CameraCurves, list[str]]:
    frames, projector = axis_frames(capture, "eye", axis), capture.projector
    lines = frames.line_patterns
    tables = CodeTables(
        index_of_word(frames.gray),
        cell_positions(frames.gray, projector),
        line_positions(lines, frames.gray, projector) if lines else edge_positions(frames.gray, projector),
        edge_positions(frames.gray, projector) if edges else None,
    )
    stages: list[str] = []
    return camera_curves(frames, tables, limits or ReconstructionLimits(), report_step=stages.append), stages


def errors_px(curves: CameraCurves, scene: Scene) -> FloatArray:
    """Projector columns by which points miss the column of their curve."""
    ensemble = curves.ensemble
    column = np.repeat(ensemble.position_px, np.diff(ensemble.offsets))
    return scene(ensemble.points_px[:, 0], ensemble.points_px[:, 1]) - column


def test_a_slanted_plate_gives_every_column_once_to_a_fraction_of_a_pixel() -> None:
    curves, stages = walk(rendered(slope, patterns()))
    assert list(dict.fromkeys(stages)) == [
        "measure noise", "decode", "locate stripes", "refine stripes", "identify stripes", "link stripes"
    ]  # fmt: skip
    position = curves.ensemble.position_px
    # 8 … 121 columns are in view; those whose stripe leaves by a corner are there in part.
    assert set(range(14, 114)) <= set(position.tolist())
    assert (np.diff(position) > 0).all()
    errors = errors_px(curves, slope)
    assert len(errors) > 8000
    assert np.abs(errors).max() < 0.25
    assert rms(errors) < 0.03
    assert not curves.ensemble.bridge_after.any()
    assert curves.stripe_points >= len(errors)
    assert curves.stripe_count == len(position)
    assert 1.0 <= curves.scale_px <= 2.5


def test_code_edges_stand_for_lines_where_those_are_not_resolved() -> None:
    capture = rendered(slope, patterns())
    shots = []
    for shot in capture.shots:
        image = shot.image.copy()
        if isinstance(capture.patterns[shot.pattern], LineShift):
            image[:, 105:] = cv2.GaussianBlur(image, (0, 0), sigmaX=15)[:, 105:]
        shots.append(replace(shot, image=image))
    blurred = replace(capture, shots=tuple(shots))
    alone, _ = walk(blurred)
    assert alone.unresolved_lines is None
    assert (alone.ensemble.points_px[:, 0] > 130).sum() < 200
    curves, stages = walk(blurred, edges=True)
    code = next(pattern for pattern in capture.patterns if isinstance(pattern, Gray))
    assert curves.unresolved_lines is not None
    assert not curves.unresolved_lines[:, :64].any()
    assert curves.unresolved_lines[:, 160:].all()
    column = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
    x, y = np.rint(curves.ensemble.points_px).astype(int).T
    lost = curves.unresolved_lines[y, x]
    # Edges lie between columns, four of them apart, and lines at them. A point may lie in the next pixel.
    assert set(np.unique(column[lost])) <= set(edge_positions(code, PROJECTOR).ravel())
    assert (column[~lost] % 1 == 0).mean() > 0.99
    assert lost.sum() > 0.8 * curves.unresolved_lines.sum() * 0.52 / 4
    errors = errors_px(curves, slope)
    assert rms(errors[lost]) < 0.05
    assert rms(errors[~lost]) < 0.03
    assert stages[-3:] == ["locate stripes", "identify stripes", "link stripes"]
    sharp, _ = walk(capture, edges=True)
    plain, _ = walk(capture)
    assert sharp.unresolved_lines is None
    assert sharp.ensemble.points_px.tobytes() == plain.ensemble.points_px.tobytes()


def without(capture: Capture, *left_out: Pattern) -> Capture:
    """A capture in which some patterns were not shown."""
    kept = [index for index, pattern in enumerate(capture.patterns) if pattern not in left_out]
    shots = tuple(replace(s, pattern=kept.index(s.pattern)) for s in capture.shots if s.pattern in kept)
    return replace(capture, patterns=tuple(capture.patterns[index] for index in kept), shots=shots)


@pytest.mark.parametrize(("paired", "most_px"), [(True, 0.05), (False, 0.06)], ids=["inverses", "threshold"])
def test_without_line_frames_code_edges_stand_in(*, paired: bool, most_px: float) -> None:
    capture = rendered(slope, patterns(line_shift=False, cell_px=2))
    if not paired:
        capture = without(capture, *(each for each in capture.patterns if getattr(each, "inverted", False)))
    curves, _ = walk(capture)
    assert set(np.arange(15.5, 112, 2).tolist()) <= set(curves.ensemble.position_px.tolist())
    errors = errors_px(curves, slope)
    assert len(errors) > 3000
    assert rms(errors) < most_px
    assert np.abs(errors).max() < 0.4


def test_points_near_shadows_and_steps_are_refused_with_their_cause() -> None:
    curves, _ = walk(rendered(cliff, patterns()))
    x = curves.ensemble.points_px[:, 0]
    # The shadow runs from 98.5 to 110.5. Blur lights two pixels of it, and from there two more are refused.
    assert not ((x > 98.5) & (x < 110.5)).any()
    errors = np.abs(errors_px(curves, cliff))
    assert np.nanmax(errors) < 0.5
    assert rms(errors[(x < 94) | (x > 115)]) < 0.03
    assert (curves.refusal[20:80, 103:107] == Refusal.NOT_LIT).all()
    assert curves.refined
    rows, columns = np.nonzero(curves.refusal == Refusal.SHADOW_EDGE)
    assert len(rows) > 20
    # Within two pixels of where light has faded out, some two pixels inside the shadow's own borders; or where the
    # projector's light ends.
    at_shadow = (np.abs(columns - 98.5) < 3) | (np.abs(columns - 110.5) < 3)
    assert (at_shadow | (columns > 200)).all()
    assert at_shadow.sum() > 300
    stepped, _ = walk(rendered(lambda x, y: slope(x, y) + np.where(x > 100, 9.0, 0.0), patterns()))
    rows, columns = np.nonzero(stepped.refusal == Refusal.DEPTH_EDGE)
    assert len(rows) > 20
    assert (np.abs(columns - 100.5) < 4).all()


def test_points_whose_light_is_clipped_are_refused_as_saturated() -> None:
    capture = rendered(slope, patterns())
    glint = np.zeros(CAMERA.shape, dtype=bool)
    glint[60:75, 80:110] = True
    shots = tuple(
        replace(shot, image=np.where(glint, 255, shot.image).astype(np.uint8))
        if isinstance(capture.patterns[shot.pattern], LineShift)
        else shot
        for shot in capture.shots
    )
    curves, _ = walk(replace(capture, shots=shots))
    columns, rows = np.rint(curves.ensemble.points_px).astype(int).T
    assert not glint[rows, columns].any()
    beside = (rows >= 60) & (rows < 75) & ((columns < 76) | (columns > 114))
    assert beside.sum() > 500
    lit_lines = replace(capture, shots=tuple(_brightened(shot, capture, glint) for shot in capture.shots))
    bright, _ = walk(lit_lines)
    assert (bright.refusal[glint] == Refusal.SATURATED).sum() > 150
    assert not (bright.refusal[~glint] == Refusal.SATURATED).any()
    columns, rows = np.rint(bright.ensemble.points_px).astype(int).T
    assert glint[rows, columns].sum() < 0.1 * glint.sum()


def _brightened(shot: Shot, capture: Capture, glint: NDArray[np.bool_]) -> Shot:
    """A line frame whose stripes within the glint are clipped at their tops."""
    if not isinstance(capture.patterns[shot.pattern], LineShift):
        return shot
    brighter = np.clip(12 + (shot.image.astype(float) - 12) * 8, 0, 255)
    return replace(shot, image=np.where(glint, brighter, shot.image).astype(np.uint8))


def test_a_dark_room_gives_no_curves() -> None:
    def nowhere(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.full((x + y).shape, np.nan)

    curves, _ = walk(rendered(nowhere, patterns()))
    assert curves.decoded_pixels == curves.stripe_count == curves.stripe_points == 0
    assert len(curves.ensemble.position_px) == 0
    assert (curves.refusal == Refusal.NOT_LIT).all()


def streamed(capture: Capture, order: Sequence[int], entered: Callable[[str], None] = lambda _: None) -> CameraCurves:
    """The curves by the frames that tell, as they come in this order."""
    shots = used_shots(capture, "eye")
    shown = [capture.patterns[shot.pattern] for shot in shots]
    patterns = axis_patterns(shown, "eye", Axis.COLUMN)
    stacks = FrameStacks(
        patterns, CAMERA.shape, full_scale=255.0, reference_repeats=reference_repeats(shown, Axis.COLUMN)
    )
    lines = patterns.lines
    tables = CodeTables(
        index_of_word(patterns.gray),
        cell_positions(patterns.gray, PROJECTOR),
        line_positions(lines, patterns.gray, PROJECTOR) if lines else edge_positions(patterns.gray, PROJECTOR),
    )
    stream = CameraStream(stacks, tables, ReconstructionLimits(), report_step=entered)
    for index in order:
        entered(f"frame {index}")
        stream.take(shown[index], shots[index].image)
    entered("finish")
    return stream.finish()[0]


def require_equal(one: CameraCurves, other: CameraCurves) -> None:
    """To the last bit."""
    for name in ("offsets", "position_px", "points_px", "normals", "sigma_px", "stripe", "bridge_after"):
        assert getattr(one.ensemble, name).tobytes() == getattr(other.ensemble, name).tobytes(), name
    assert one.refusal.tobytes() == other.refusal.tobytes()


@pytest.mark.parametrize("line_shift", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_frames_that_come_one_by_one_in_any_order_give_the_same_bits(line_shift: bool) -> None:
    capture = rendered(cliff, patterns(line_shift=line_shift, cell_px=None if line_shift else 2))
    wanted = walk(capture)[0]
    count = len(used_shots(capture, "eye"))
    for order in (range(count - 1, -1, -1), np.random.default_rng(4).permutation(count).tolist()):
        got = streamed(capture, order)
        require_equal(got, wanted)
        assert (got.scale_px, got.stripe_count) == (wanted.scale_px, wanted.stripe_count)


def bent(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """As a camera made for displays gives it."""
    return np.rint(255 * (image / 255) ** (1 / 2.2)).astype(np.uint8)


def compressed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], 0), dtype=np.uint8)


@pytest.mark.parametrize("seen", [bent, pytest.param(compressed, marks=pytest.mark.slow)])
def test_stripes_are_located_before_the_bits_come_that_only_number_them(
    seen: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
) -> None:
    capture = rendered(slope, patterns(cell_px=1))
    capture = replace(capture, shots=tuple(replace(shot, image=seen(shot.image)) for shot in capture.shots))
    bits = [pattern.bit for pattern in capture.patterns if isinstance(pattern, Gray)]
    assert bits == [0, 0, 1, 1, 2, 2, 5, 5, 6, 6, 3, 3, 4, 4]
    count = len(used_shots(capture, "eye"))
    steps: list[str] = []
    got, wanted = streamed(capture, range(count), steps.append), walk(capture)[0]
    stages = ["measure noise", *["locate stripes"] * 8, "decode", "refine stripes", "identify stripes", "link stripes"]
    assert [each for each in steps if not each.startswith("frame")] == [*stages, "finish"]
    first_number = capture.patterns.index(Gray(Axis.COLUMN, 3, 7, cell_px=1))
    assert steps.index(f"frame {first_number}") > len(steps) - 1 - steps[::-1].index("locate stripes")
    for order in ([*range(12), *range(20, 24), *range(12, 20)], range(count - 1, -1, -1)):
        other = streamed(capture, order)
        for each in (other, wanted):
            assert each.ensemble.points_px.tobytes() == got.ensemble.points_px.tobytes()
            assert each.ensemble.sigma_px.tobytes() == got.ensemble.sigma_px.tobytes()
            assert (each.gamma, each.compression_dn, each.noise_correlation) == (
                got.gamma, got.compression_dn, got.noise_correlation
            )  # fmt: skip
    assert (got.gamma > 2) == (seen is bent)
    assert (got.compression_dn > 1) == (seen is compressed)
    assert (got.noise_correlation > 2) == (seen is compressed)


def test_missing_frames_are_listed() -> None:
    capture = rendered(slope, patterns())
    count = len(used_shots(capture, "eye"))
    with pytest.raises(PatternError, match=r"1 of the frames announced are missing: LineShift\(.*shift=7"):
        streamed(capture, range(count - 1))


def tilted(slope: float, angle_rad: float) -> Scene:
    """A plate whose projector position rises by `slope` per camera pixel in a direction."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return lambda x, y: np.asarray(64 + slope * (cosine * (x - 60) + sine * (y - 50)))


def seen_tilted(slope: float, angle_rad: float, *, axis: Axis = Axis.COLUMN, **light: Any) -> Capture:
    position = tilted(slope, angle_rad)(*grid((100, 120)))
    return seen_by_camera(position, patterns(projector=WIDE, axis=axis), WIDE, axis=axis, **light)


def misses_px(curves: CameraCurves, slope: float, angle_rad: float) -> FloatArray:
    """Distance of points from their lines, camera pixels."""
    return errors_px(curves, tilted(slope, angle_rad)) / slope


@pytest.mark.parametrize(
    ("angle_rad", "axis"),
    [
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.0, Axis.COLUMN), (math.pi / 2, Axis.ROW))),
        (math.pi / 6, Axis.ROW),
        (-2.5, Axis.COLUMN),
    ],
)
def test_stripes_of_any_direction_and_axis_are_refined(angle_rad: float, axis: Axis) -> None:
    curves, _ = walk(seen_tilted(0.9, angle_rad, axis=axis, blur_px=0.8), axis=axis)
    assert curves.refined
    errors = misses_px(curves, 0.9, angle_rad)
    assert len(errors) > 8000
    # Beside the projector's border the light of the lines that it has no room for is missing.
    line = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
    within = (line >= 3) & (line <= (WIDE.along(axis) - 4))
    assert rms(errors) < 0.02
    assert abs(errors.mean()) < 0.002
    assert np.abs(errors[within]).max() < 0.09
    assert np.abs(errors).max() < 0.25
    assert rms(errors / curves.ensemble.sigma_px) == pytest.approx(1.0, abs=0.15)


@parametrize_core("slope", [0.5, 1.6])
def test_refined_points_are_no_worse_than_those_of_their_own_frame(slope: float) -> None:
    capture = seen_tilted(slope, 0.2, blur_px=0.9 * slope, noise=1.5)
    found = []
    # This camera has no blur that would mix the albedo of neighbouring pixels.
    for limits in (ReconstructionLimits(camera_blur_px=0.0), ReconstructionLimits(max_disagreement_px=-1.0)):
        curves, _ = walk(capture, limits=limits)
        # Where the filter's window is whole; beside the image's border only a fit gives points.
        at = curves.ensemble.points_px
        inside = ((at > 12) & (at < [107, 87])).all(axis=1)
        assert inside.sum() > 3000
        found.append(rms(misses_px(curves, slope, 0.2)[inside]))
    assert found[0] < 1.1 * found[1]


@pytest.mark.parametrize(
    ("slope", "light", "seed"),
    [
        pytest.param(0.6, {"noise": 0.8, "blur_px": 0.7}, 1, marks=pytest.mark.slow),
        (0.9, {"noise": 4.0, "blur_px": 0.7}, 4),
        pytest.param(1.4, {"noise": 2.0, "blur_px": 0.7}, 2, marks=pytest.mark.slow),
        # Ten grey levels of contrast.
        (0.9, {"noise": 0.8, "blur_px": 0.6, "white": 12.0}, 3),
    ],
    ids=["quiet", "loud", "steep", "dark"],
)
def test_steady_light_is_never_called_unsteady(slope: float, light: dict[str, Any], seed: int) -> None:
    curves, _ = walk(seen_tilted(slope, 0.3 * seed, seed=seed, **light))
    assert curves.refined
    assert len(curves.ensemble.points_px) > 500
    if "white" not in light:
        assert np.nanmax(np.abs(curves.disagreement_px)) < 0.03


def test_a_small_thing_in_steady_light_is_refined_as_a_large_one() -> None:
    x, y = grid((100, 120))
    position = np.where(np.hypot(x - 60, y - 50) < 12, tilted(0.6, 0.2)(x, y), np.nan)
    shown = patterns(projector=WIDE)
    curves, _ = walk(seen_by_camera(position, shown, WIDE, noise=1.0, seed=0, blur_px=0.5, smear_px=0.8, white=90.0))
    assert len(curves.ensemble.points_px) > 150
    assert curves.refined


@pytest.mark.parametrize(
    ("shift", "offset", "gain"),
    [
        pytest.param(0, 4.0, 1.0, marks=pytest.mark.slow),
        pytest.param(3, 0.0, 0.7, marks=pytest.mark.slow),
        (7, 3.0, 1.2),
    ],
)
def test_light_that_changes_in_one_frame_leaves_each_stripe_as_its_own_frame_shows_it(
    shift: int, offset: float, gain: float
) -> None:
    steady = seen_tilted(0.7, 0.3, blur_px=0.7)
    changed = LineShift(Axis.COLUMN, shift, 8)
    capture = replace(steady, shots=tuple(
        replace(shot, image=np.clip(np.rint(shot.image * gain + offset), 0, 255).astype(np.uint8))
        if steady.patterns[shot.pattern] == changed else shot
        for shot in steady.shots
    ))  # fmt: skip
    curves, _ = walk(capture)
    assert not curves.refined
    assert np.nanmax(np.abs(curves.disagreement_px)) > 0.03
    unrefined, _ = walk(capture, limits=ReconstructionLimits(max_disagreement_px=-1.0))
    require_equal(curves, unrefined)
    # What stays of the change is what it does to its own frame's stripes.
    assert rms(misses_px(curves, 0.7, 0.3)) < 0.03
    trusting, _ = walk(capture, limits=ReconstructionLimits(max_disagreement_px=math.inf))
    assert trusting.refined
    assert rms(misses_px(trusting, 0.7, 0.3)) > 0.03


@pytest.fixture(scope="module")
def halves() -> Capture:
    """Lines of half their period on an image so large that a filter looks for points in bands of rows only."""
    surface = tilted(0.9, 0.1)(*grid((420, 520)))
    size = Size(512, 384)
    shown = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=4, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return seen_by_camera(surface + 10.0 - surface.min(), shown, size, blur_px=0.7)


def test_of_half_period_lines_every_pixel_that_one_crosses_has_a_point(halves: Capture) -> None:
    curves, _ = walk(halves)
    assert curves.refined
    assert (np.abs(curves.disagreement_px) < 0.01).all()
    rows = curves.ensemble.points_px[:, 1]
    # One point for each line and row, as far as the fit reaches: to within two pixels of the border.
    counts = np.bincount(np.rint(rows).astype(int), minlength=420)
    assert np.ptp(counts[2:-2]) < 8
    assert counts[[0, 1, -2, -1]].sum() == 0


@pytest.mark.slow
def test_half_period_lines_in_changing_light_are_not_refined(halves: Capture) -> None:
    changed = LineShift(Axis.COLUMN, 3, 8, 4)
    capture = replace(halves, shots=tuple(
        replace(shot, image=np.clip(np.roll(shot.image, 1, axis=1), 0, 255))
        if halves.patterns[shot.pattern] == changed else shot
        for shot in halves.shots
    ))  # fmt: skip
    curves, _ = walk(capture)
    assert not curves.refined
    rows = np.rint(curves.ensemble.points_px[:, 1]).astype(int)
    # In every row, though a few of them were enough to see it.
    assert np.ptp(np.bincount(rows)[8:-8]) < 12


def test_a_camera_of_deep_samples_sees_the_same() -> None:
    shallow = seen_tilted(0.9, 0.3, blur_px=0.8, noise=1.0)
    deep = tuple(replace(shot, image=shot.image.astype(np.uint16) * np.uint16(64)) for shot in shallow.shots)
    camera = replace(shallow.cameras["eye"], bit_depth=14)
    ours, other = walk(shallow)[0], walk(replace(shallow, cameras={"eye": camera}, shots=deep))[0]
    assert ours.refined
    assert other.refined
    assert len(other.ensemble.points_px) == pytest.approx(len(ours.ensemble.points_px), rel=0.01)
    assert rms(misses_px(other, 0.9, 0.3)) < 0.02


def test_without_one_shift_stripes_stand_as_their_frames_show_them() -> None:
    curves, _ = walk(without(seen_tilted(0.9, 0.3, blur_px=0.8), LineShift(Axis.COLUMN, 5, 8)))
    assert not curves.refined
    assert len(curves.disagreement_px) == 0
    assert {int(p) % 8 for p in curves.ensemble.position_px} == {0, 1, 2, 3, 4, 6, 7}
    assert rms(misses_px(curves, 0.9, 0.3)) < 0.03


def sigma_ratio(curves: CameraCurves, misses: FloatArray) -> float:
    """68.27 % of the points are at most this many of their standard deviations off."""
    return float(np.percentile(np.abs(misses) / curves.ensemble.sigma_px, 68.27))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("width_px", "most_px"),
    [
        pytest.param(1, 0.3, id="narrow"),
        pytest.param(4, 0.3, id="half"),
        pytest.param(4, 0.02, id="half, little", marks=pytest.mark.slow),
    ],
)
def test_lines_of_single_frames_beside_the_others_are_in_sigma(width_px: int, most_px: float, seed: int) -> None:
    size, pitch = Size(512, 384), 0.9
    surface = tilted(pitch, 0.1)(*grid((240, 320)))
    position = surface + 10.0 - surface.min()
    shown = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=width_px, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    moved = dict(zip(range(8), most_px * np.random.default_rng(seed).permutation(np.linspace(-1, 1, 8)), strict=True))
    shots = []
    for index, pattern in enumerate(shown):
        by_px = moved[pattern.shift] if isinstance(pattern, LineShift) else 0.0
        frame = seen_by_camera(position + by_px, (pattern,), size, blur_px=0.7, seed=index).shots[0]
        shots.append(replace(frame, pattern=index))
    capture = Capture(size, shown, {"eye": CameraFormat(Size(320, 240), 8)}, tuple(shots))
    curves, _ = walk(capture)
    assert curves.refined == (most_px < 0.1)
    x, y = curves.ensemble.points_px.T
    column = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
    misses = (tilted(pitch, 0.1)(x, y) + 10.0 - surface.min() - column) / pitch
    assert 0.7 <= sigma_ratio(curves, misses) <= 1.4


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_edges_whose_white_is_clipped_are_within_sigma_and_counted(seed: int) -> None:
    surface = tilted(0.9, 0.2)
    shown = patterns(line_shift=False, cell_px=2, projector=WIDE)
    capture = seen_by_camera(
        surface(*grid((200, 240))), shown, WIDE, blur_px=0.7, smear_px=0.5, white=320.0, noise=1.0, seed=seed
    )
    curves, _ = walk(capture)
    assert 0.5 < curves.clipped_white / curves.decoded_pixels < 1.0
    assert curves.clipped_code >= 0.9 * curves.clipped_white
    assert 0.7 <= sigma_ratio(curves, misses_px(curves, 0.9, 0.2)) <= 1.4

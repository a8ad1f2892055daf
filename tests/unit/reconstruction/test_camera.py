"""One camera's walk from frames to linked curves, on a scene whose projector coordinate is known everywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

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
from slrig.patterns.positions import cell_positions, edge_positions, index_of_word, line_positions
from slrig.patterns.sequence import encode, scan_patterns
from slrig.reconstruction.camera import CameraCurves, CameraStream, camera_curves
from slrig.reconstruction.frames import FrameStacks, axis_frames, axis_patterns, ends_repeats, telling_shots
from slrig.reconstruction.limits import CodeTables, Limits
from tests.unit.reconstruction.builders import grid

CAMERA = Size(210, 150)
PROJECTOR = Size(128, 96)
SUBPIXELS = 6
BLUR_PX = 0.9
Scene = Callable[[FloatArray, FloatArray], FloatArray]


def slope(x: FloatArray, y: FloatArray) -> FloatArray:
    """A slanted plate: 0.52 projector columns per camera pixel."""
    return np.asarray(8.0 + 0.52 * x + 0.03 * y)


def cliff(x: FloatArray, y: FloatArray) -> FloatArray:
    """The same with a step of twelve columns, and a shadow beside it (NaN)."""
    stepped = slope(x, y) + np.where(x > 110, 12.0, 0.0)
    return np.asarray(np.where((x > 98) & (x <= 110), np.nan, stepped))


def rendered(scene: Scene, patterns: tuple[Pattern, ...], *, noise: float = 0.8) -> Capture:
    """Every column pattern as a blurred, noisy 8-bit camera sees it."""
    x, y = grid((CAMERA.height_px, CAMERA.width_px * SUBPIXELS))
    x = (x + 0.5) / SUBPIXELS - 0.5
    lit = np.isfinite(scene(x, y))
    # The light of a sub-pixel is the mean of the profile over the stretch of the projector that it sees.
    ends = [np.nan_to_num(scene(x + side * 0.5 / SUBPIXELS, y), nan=-9.0) for side in (-1, 1)]
    borders = np.arange(PROJECTOR.width_px + 1) - 0.5
    albedo = 120 + 70 * np.cos(grid(CAMERA.shape)[1] / 20)
    rng = np.random.default_rng(7)
    sequence = encode(patterns, PROJECTOR)
    shots = []
    for index in range(len(sequence)):
        summed = np.concatenate([[0.0], np.cumsum(sequence.image(index)[0] / 255.0)])
        first, last = (np.interp(each, borders, summed) for each in ends)
        light = np.where(lit & (ends[1] > ends[0]), (last - first) / np.maximum(ends[1] - ends[0], 1e-9), 0.0)
        # The lens blurs before the pixels sample.
        sharp = cv2.GaussianBlur(light, (0, 0), sigmaX=BLUR_PX * SUBPIXELS, sigmaY=BLUR_PX)
        seen = 12 + albedo * sharp.reshape(CAMERA.height_px, CAMERA.width_px, SUBPIXELS).mean(axis=2)
        seen = seen + rng.normal(0, noise, seen.shape)
        shots.append(Shot(index, "eye", np.clip(np.rint(seen), 0, 255).astype(np.uint8)))
    return Capture(PROJECTOR, patterns, {"eye": CameraFormat(CAMERA, 8)}, tuple(shots))


def patterns(*, line_shift: bool = True, cell_px: int | None = None) -> tuple[Pattern, ...]:
    return scan_patterns(
        PROJECTOR, line_shift=line_shift, period_px=8, line_width_px=1, gray_cell_px=cell_px, gray_offset_px=0,
        rows=False,
    )  # fmt: skip


def walk(capture: Capture, *, limits: Limits | None = None, edges: bool = False) -> tuple[CameraCurves, list[str]]:
    frames = axis_frames(capture, "eye", Axis.COLUMN)
    lines = frames.line_patterns
    tables = CodeTables(
        index_of_word(frames.gray),
        cell_positions(frames.gray, PROJECTOR),
        line_positions(lines, frames.gray, PROJECTOR) if lines else edge_positions(frames.gray, PROJECTOR),
        edge_positions(frames.gray, PROJECTOR) if edges else None,
    )
    stages: list[str] = []
    return camera_curves(frames, tables, limits or Limits(), entered=stages.append), stages


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
    assert len(errors) > 12_000
    assert np.abs(errors).max() < 0.25
    assert np.sqrt(np.mean(errors**2)) < 0.03
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
    without, _ = walk(blurred)
    assert without.lost_lines is None
    assert (without.ensemble.points_px[:, 0] > 130).sum() < 300
    curves, stages = walk(blurred, edges=True)
    code = next(pattern for pattern in capture.patterns if isinstance(pattern, Gray))
    assert curves.lost_lines is not None
    assert not curves.lost_lines[:, :64].any()
    assert curves.lost_lines[:, 160:].all()
    column = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
    x, y = np.rint(curves.ensemble.points_px).astype(int).T
    lost = curves.lost_lines[y, x]
    # Edges lie between columns, four of them apart, and lines at them. A point may lie in the next pixel.
    assert set(np.unique(column[lost])) <= set(edge_positions(code, PROJECTOR).ravel())
    assert (column[~lost] % 1 == 0).mean() > 0.99
    assert lost.sum() > 0.8 * curves.lost_lines.sum() * 0.52 / 4
    errors = errors_px(curves, slope)
    assert np.sqrt(np.mean(errors[lost] ** 2)) < 0.05
    assert np.sqrt(np.mean(errors[~lost] ** 2)) < 0.03
    assert stages[-3:] == ["locate stripes", "identify stripes", "link stripes"]
    sharp, _ = walk(capture, edges=True)
    plain, _ = walk(capture)
    assert sharp.lost_lines is None
    assert sharp.ensemble.points_px.tobytes() == plain.ensemble.points_px.tobytes()


def test_without_line_frames_code_edges_stand_in() -> None:
    curves, _ = walk(rendered(slope, patterns(line_shift=False, cell_px=2)))
    position = curves.ensemble.position_px
    assert set(np.arange(15.5, 112, 2).tolist()) <= set(position.tolist())
    errors = errors_px(curves, slope)
    assert len(errors) > 5000
    assert np.sqrt(np.mean(errors**2)) < 0.05
    assert np.abs(errors).max() < 0.4


def test_code_edges_are_found_without_inverses_too() -> None:
    pairs = rendered(slope, patterns(line_shift=False, cell_px=2))
    kept = [i for i, pattern in enumerate(pairs.patterns) if not getattr(pattern, "inverted", False)]
    shots = tuple(
        Shot(kept.index(shot.pattern), shot.camera, shot.image) for shot in pairs.shots if shot.pattern in kept
    )
    curves, _ = walk(Capture(PROJECTOR, tuple(pairs.patterns[i] for i in kept), pairs.cameras, shots))
    errors = errors_px(curves, slope)
    assert len(errors) > 4500
    assert np.sqrt(np.mean(errors**2)) < 0.06


def test_shadows_and_steps_are_kept_clear_of() -> None:
    curves, _ = walk(rendered(cliff, patterns()))
    x = curves.ensemble.points_px[:, 0]
    # The shadow runs from 98.5 to 110.5. Blur lights two pixels of it, and from there two more are refused.
    assert not ((x > 98.5) & (x < 110.5)).any()
    errors = np.abs(errors_px(curves, cliff))
    assert errors.max() < 0.5
    assert np.sqrt(np.mean(errors[(x < 94) | (x > 115)] ** 2)) < 0.03
    refused = {Refusal(int(value)) for value in np.unique(curves.refusal)}
    assert Refusal.NOT_LIT in refused
    assert (curves.refusal[20:130, 103:107] == Refusal.NOT_LIT).all()


def test_points_that_the_refinement_leaves_out_keep_their_cause() -> None:
    curves, _ = walk(rendered(cliff, patterns()))
    assert curves.refined
    rows, columns = np.nonzero(curves.refusal == Refusal.SHADOW_EDGE)
    assert len(rows) > 20
    # Within two pixels of where light has faded out, some two pixels inside the shadow's own borders.
    at_shadow = (np.abs(columns - 98.5) < 3) | (np.abs(columns - 110.5) < 3)
    assert at_shadow.mean() > 0.95
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


def test_pixels_that_see_past_the_projector_are_counted_as_such() -> None:
    def beyond(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(slope(x, y) + 45.0)

    curves, _ = walk(rendered(beyond, patterns()))
    assert curves.ensemble.position_px.max() <= 127
    assert (curves.refusal == Refusal.NOT_LIT).mean() > 0.2
    assert curves.decoded_pixels == pytest.approx(int(((beyond(*grid(CAMERA.shape))) < 127.5).sum()), rel=0.05)


def test_a_dark_room_gives_no_curves() -> None:
    def nowhere(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.full((x + y).shape, np.nan)

    curves, _ = walk(rendered(nowhere, patterns()))
    assert curves.decoded_pixels == curves.stripe_count == curves.stripe_points == 0
    assert len(curves.ensemble.position_px) == 0
    assert (curves.refusal == Refusal.NOT_LIT).all()


def streamed(capture: Capture, order: Sequence[int], entered: Callable[[str], None] = lambda _: None) -> CameraCurves:
    """The curves by the frames that tell, as they come in this order."""
    shots = telling_shots(capture, "eye")
    shown = [capture.patterns[shot.pattern] for shot in shots]
    patterns = axis_patterns(shown, "eye", Axis.COLUMN)
    stacks = FrameStacks(patterns, CAMERA.shape, full_scale=255.0, ends_repeats=ends_repeats(shown, Axis.COLUMN))
    lines = patterns.lines
    tables = CodeTables(
        index_of_word(patterns.gray),
        cell_positions(patterns.gray, PROJECTOR),
        line_positions(lines, patterns.gray, PROJECTOR) if lines else edge_positions(patterns.gray, PROJECTOR),
    )
    stream = CameraStream(stacks, tables, Limits(), entered=entered)
    for index in order:
        entered(f"frame {index}")
        stream.take(shown[index], shots[index].image)
    entered("finish")
    return stream.finish()[0]


@pytest.mark.parametrize("line_shift", [True, False])
def test_frames_that_come_one_by_one_in_any_order_give_the_same_bits(line_shift: bool) -> None:
    capture = rendered(cliff, patterns(line_shift=line_shift, cell_px=None if line_shift else 2))
    wanted = walk(capture)[0]
    count = len(telling_shots(capture, "eye"))
    for order in (range(count), range(count - 1, -1, -1), np.random.default_rng(4).permutation(count).tolist()):
        got = streamed(capture, order)
        for name in ("offsets", "position_px", "points_px", "normals", "sigma_px", "stripe", "bridge_after"):
            assert getattr(got.ensemble, name).tobytes() == getattr(wanted.ensemble, name).tobytes()
        assert got.refusal.tobytes() == wanted.refusal.tobytes()
        assert (got.scale_px, got.stripe_count) == (wanted.scale_px, wanted.stripe_count)


def bent(image: NDArray[np.uint8], _: np.random.Generator) -> NDArray[np.uint8]:
    """As a camera made for displays gives it."""
    return np.rint(255 * (image / 255) ** (1 / 2.2)).astype(np.uint8)


def compressed(image: NDArray[np.uint8], _: np.random.Generator) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], 0), dtype=np.uint8)


def with_noise_of_rows(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.clip(np.rint(image + rng.normal(0, 2, (len(image), 1))), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seen", [lambda image, _: image, bent, compressed, with_noise_of_rows])
def test_stripes_are_located_before_the_bits_come_that_only_number_them(
    seen: Callable[[NDArray[np.uint8], np.random.Generator], NDArray[np.uint8]],
) -> None:
    capture, rng = rendered(slope, patterns(cell_px=1)), np.random.default_rng(1)
    capture = replace(capture, shots=tuple(replace(shot, image=seen(shot.image, rng)) for shot in capture.shots))
    bits = [pattern.bit for pattern in capture.patterns if isinstance(pattern, Gray)]
    assert bits == [0, 0, 1, 1, 2, 2, 5, 5, 6, 6, 3, 3, 4, 4]
    count = len(telling_shots(capture, "eye"))
    told: list[str] = []
    got, wanted = streamed(capture, range(count), told.append), walk(capture)[0]
    stages = ["measure noise", *["locate stripes"] * 8, "decode", "refine stripes", "identify stripes", "link stripes"]
    assert [each for each in told if not each.startswith("frame")] == [*stages, "finish"]
    first_number = capture.patterns.index(Gray(Axis.COLUMN, 3, 7, cell_px=1))
    assert told.index(f"frame {first_number}") > len(told) - 1 - told[::-1].index("locate stripes")
    for order in ([*range(12), *range(20, 24), *range(12, 20)], range(count - 1, -1, -1)):
        other = streamed(capture, order)
        for each in (other, wanted):
            assert each.ensemble.points_px.tobytes() == got.ensemble.points_px.tobytes()
            assert each.ensemble.sigma_px.tobytes() == got.ensemble.sigma_px.tobytes()
            assert (each.gamma, each.compression_dn, each.shared_noise) == (
                got.gamma, got.compression_dn, got.shared_noise
            )  # fmt: skip
    assert (got.gamma > 2) == (seen is bent)
    assert (got.compression_dn > 1) == (seen is compressed)
    assert (got.shared_noise > 2) == (seen in {compressed, with_noise_of_rows})


def test_a_stream_that_lacks_a_frame_says_which() -> None:
    capture = rendered(slope, patterns())
    count = len(telling_shots(capture, "eye"))
    with pytest.raises(PatternError, match=r"1 of the frames announced did not come: LineShift\(.*shift=7"):
        streamed(capture, range(count - 1))

"""Curves of two cameras merged along the light sheet: fused, filled, never doubled; the kernels against plain numpy."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, Pinhole, Source
from slrig.reconstruction.merging import (
    MergedCurves,
    _fuse_kernel,
    _unmatched_kernel,
    merge_curves,
)
from slrig.reconstruction.triangulation import SheetCurves, triangulate_camera_projector
from tests.unit.reconstruction.builders import BALL, CAMERA, OTHER_CAMERA, PROJECTOR, seen_on_ball

COLUMNS = [120.0, 140.0, 160.0, 180.0]
ROWS = np.arange(60.0, 180.0, 0.9)
GAP_PX = 4.0


def seen(
    camera: Pinhole,
    rows: FloatArray,
    *,
    columns: list[float] | None = None,
    noise_px: float = 0.0,
    seed: int = 0,
    sigma_px: float = 0.02,
) -> SheetCurves:
    """What one camera triangulates of the ball."""
    columns = COLUMNS if columns is None else columns
    stripes = seen_on_ball(camera, columns, rows, sigma_px=sigma_px, noise_px=noise_px, seed=seed)
    return triangulate_camera_projector(stripes, camera, PROJECTOR, Axis.COLUMN)[0]


def both(first: SheetCurves, second: SheetCurves) -> MergedCurves:
    return merge_curves([first, second], PROJECTOR.centre_mm, widest_gap_px=GAP_PX)


def require_one_sheet(result: SheetCurves) -> None:
    """Along each curve rows rise; no second point stands where one is already."""
    within = np.diff(result.curve_of_point()) == 0
    assert (np.diff(result.along_px)[within] > 0).all()
    assert len(result.along_px) == result.offsets[-1]


def along_ray_mm(points: FloatArray) -> FloatArray:
    """Depth error of points along the projector's rays."""
    rays = points - PROJECTOR.centre_mm
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    truth = BALL.seen_along(PROJECTOR.centre_mm, rays)
    return np.asarray(((points - truth) * rays).sum(axis=1))


def test_one_camera_is_passed_through() -> None:
    only = seen(CAMERA, ROWS)
    result = merge_curves([only], PROJECTOR.centre_mm, widest_gap_px=GAP_PX)
    assert result.curves is only
    assert (result.camera == 0).all()
    assert len(result.residual_sigma) == len(result.residual_mm) == 0


@pytest.mark.slow
def test_the_fused_point_has_the_weighted_mean_depth_and_its_deviation() -> None:
    # The second camera is four times as sure, so it decides.
    first = seen(CAMERA, ROWS, noise_px=0.08, sigma_px=0.08, seed=1)
    second = seen(OTHER_CAMERA, ROWS, noise_px=0.02, sigma_px=0.02, seed=2)
    result = both(first, second)
    fused = result.curves.source == Source.ALL
    assert fused.mean() > 0.9
    errors = [along_ray_mm(each) for each in (first.points_mm, second.points_mm, result.curves.points_mm[fused])]
    single, other, together = (float(np.sqrt(np.mean(each**2))) for each in errors)
    # Points between two of the second camera's average their noise: at most half of its variance less.
    predicted = 1 / np.sqrt(1 / single**2 + 1 / other**2)
    assert 0.65 * predicted < together < 1.1 * predicted
    stated = np.sqrt(np.mean((result.curves.deviation_mm[fused] ** 2).sum(axis=1)))
    assert stated == pytest.approx(predicted, rel=0.15)
    # What displaces a fused point displaces it along the projector's ray.
    rays = result.curves.points_mm[fused] - PROJECTOR.centre_mm
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    spread = result.curves.deviation_mm[fused]
    np.testing.assert_allclose(np.abs((spread * rays).sum(axis=1)), np.linalg.norm(spread, axis=1), rtol=1e-9)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_hole_of_one_camera_is_filled_by_the_other_without_a_bridge(*, swapped: bool) -> None:
    holed, whole = ROWS[(ROWS < 100) | (ROWS > 130)], ROWS + 0.3
    first, second = (whole, holed) if swapped else (holed, whole)
    parts = seen(CAMERA, first), seen(OTHER_CAMERA, second)
    assert sum(part.bridge_after.sum() for part in parts) == len(COLUMNS)
    result = both(*parts)
    require_one_sheet(result.curves)
    assert not result.curves.bridge_after.any()
    within = np.diff(result.curves.curve_of_point()) == 0
    assert np.diff(result.curves.along_px)[within].max() < 2
    filled = (result.curves.along_px > 102) & (result.curves.along_px < 128)
    assert (result.curves.source[filled] == Source.CAMERA_PROJECTOR).all()
    assert (result.camera[filled] == (0 if swapped else 1)).all()
    assert np.abs(BALL.distance_mm(result.curves.points_mm)).max() < 2e-4


def test_stretches_of_single_cameras_are_joined_by_a_bridge() -> None:
    result = both(seen(CAMERA, ROWS[ROWS < 100]), seen(OTHER_CAMERA, ROWS[ROWS > 130]))
    require_one_sheet(result.curves)
    assert not (result.curves.source == Source.ALL).any()
    at = np.flatnonzero(result.curves.bridge_after)
    assert len(at) == len(COLUMNS)
    assert (np.diff(result.curves.along_px)[at] > 29).all()


def test_three_cameras_are_merged_one_after_the_other() -> None:
    third = replace(CAMERA, translation_mm=CAMERA.translation_mm + np.array([15.0, 0.0, 0.0]))
    parts = [seen(CAMERA, ROWS[ROWS < 90]), seen(OTHER_CAMERA, ROWS[ROWS < 140] + 0.2), seen(third, ROWS + 0.5)]
    result = merge_curves(parts, PROJECTOR.centre_mm, widest_gap_px=GAP_PX)
    require_one_sheet(result.curves)
    assert set(result.camera.tolist()) == {0, 1, 2}
    assert np.abs(BALL.distance_mm(result.curves.points_mm)).max() < 2e-4
    assert result.curves.along_px.min() < 61
    assert result.curves.along_px.max() > 179
    # Stripes of different cameras stay different stripes.
    stripes = {int(stripe): set() for stripe in result.curves.stripe}  # type: dict[int, set[int]]
    for stripe, camera in zip(result.curves.stripe.tolist(), result.camera.tolist(), strict=True):
        stripes[stripe].add(camera)
    assert all(len(cameras) == 1 for cameras in stripes.values())


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_the_finest_camera_is_merged_first_and_each_point_names_those_that_measured_it(
    order: tuple[int, int, int],
) -> None:
    third = replace(CAMERA, translation_mm=CAMERA.translation_mm + np.array([15.0, 0.0, 0.0]))
    coarse = np.arange(60.0, 140.0, 3.1)
    every = [seen(CAMERA, coarse), seen(OTHER_CAMERA, ROWS), seen(third, np.arange(60.3, 120.0))]
    result = merge_curves([every[index] for index in order], PROJECTOR.centre_mm, widest_gap_px=GAP_PX)
    require_one_sheet(result.curves)
    assert len(result.camera) == len(every[1].points_mm)
    assert (result.camera == order.index(1)).all()
    cameras = np.array([result.seen_by >> order.index(index) & 1 for index in range(3)])
    along = result.curves.along_px
    assert cameras[1].all()
    assert cameras[0][along < 136].mean() > 0.98
    assert cameras[2][along < 119].mean() > 0.98
    assert not cameras[0][along > 141].any()
    assert not cameras[2][along > 121].any()
    assert ((cameras.sum(axis=0) > 1) == (result.curves.source == Source.ALL)).all()


CENTRE = np.array([0.0, 0.0, -600.0])


class Sheet(NamedTuple):
    """Curves of one camera: offsets, points, deviations, rows, bridges."""

    offsets: NDArray[np.int32]
    points: FloatArray
    deviation: FloatArray
    along: FloatArray
    bridge: NDArray[np.bool_]


def sheet(rng: np.random.Generator, lengths: list[int]) -> Sheet:
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    along = np.concatenate([np.zeros(0), *(np.cumsum(rng.uniform(0.3, 3.0, n)) for n in lengths)])
    points = np.stack([0.1 * along, 0.3 * along, 10 * np.sin(along / 9)], axis=1) + rng.normal(0, 0.02, (len(along), 3))
    deviation = rng.normal((0.0, 0.0, 0.02), 0.01, (len(along), 3))
    bridge = rng.random(len(along)) < 0.1
    bridge[offsets[1:][np.diff(offsets) > 0] - 1] = False
    return Sheet(offsets, points, deviation, along, bridge)


@pytest.fixture(params=range(4))
def pair(request: pytest.FixtureRequest) -> tuple[Sheet, Sheet]:
    rng = np.random.default_rng(request.param)
    return sheet(rng, [30, 0, 1, 12, 25]), sheet(rng, [28, 7, 9, 0, 2])


def along_ray(of: Sheet, i: int, first: int, end: int, ray: FloatArray) -> float:
    """|depth| in the least-squares solution of deviation = depth · ray + slide · tangent; 0 where there is none."""
    tangent = of.points[min(end - 1, i + 2)] - of.points[max(first, i - 2)]
    if not tangent.any():
        return 0.0
    return abs(float(np.linalg.lstsq(np.stack([ray, tangent], axis=1), of.deviation[i], rcond=None)[0][0]))


def test_points_of_one_ray_are_averaged_by_their_variances(pair: tuple[Sheet, Sheet]) -> None:
    first, second = pair
    source = np.zeros(len(first.along), dtype=np.uint8)
    fused, spread, kind, sigma, distance = _fuse_kernel(
        first.offsets, first.points, first.deviation, first.along, source,
        second.offsets, second.points, second.deviation, second.along, second.bridge, CENTRE, GAP_PX,
    )  # fmt: skip
    together = 0
    for curve in range(len(first.offsets) - 1):
        a, b = first.offsets[curve], first.offsets[curve + 1]
        c, d = second.offsets[curve], second.offsets[curve + 1]
        for i in range(a, b):
            k = c + int(np.searchsorted(second.along[c:d], first.along[i])) - 1
            seen = c <= k < d - 1 and second.along[k + 1] - second.along[k] <= GAP_PX and not second.bridge[k]
            wanted = first.points[i], first.deviation[i], Source.CAMERA_PROJECTOR
            if seen:
                ray = (first.points[i] - CENTRE) / np.linalg.norm(first.points[i] - CENTRE)
                share = (first.along[i] - second.along[k]) / (second.along[k + 1] - second.along[k])
                gap = float(((1 - share) * second.points[k] + share * second.points[k + 1] - first.points[i]) @ ray)
                e1, e2 = along_ray(first, i, a, b, ray), along_ray(second, k, c, d, ray)
                if e1 > 0 and e2 > 0:
                    assert distance[i] == pytest.approx(gap)
                    assert sigma[i] == pytest.approx(gap / np.hypot(e1, e2))
                if e1 > 0 and e2 > 0 and abs(sigma[i]) <= 12:
                    together += 1
                    mean = first.points[i] + e1**2 / (e1**2 + e2**2) * gap * ray
                    wanted = mean, ray * e1 * e2 / np.hypot(e1, e2), Source.ALL
            np.testing.assert_allclose(fused[i], wanted[0], rtol=0, atol=1e-9)
            np.testing.assert_allclose(spread[i], wanted[1], rtol=1e-6, atol=1e-12)
            assert kind[i] == wanted[2]
    assert together > 10


def test_points_are_unmatched_where_the_first_camera_has_no_stretch(pair: tuple[Sheet, Sheet]) -> None:
    first, second = pair
    alone = _unmatched_kernel(first.offsets, first.along, first.bridge, second.offsets, second.along, GAP_PX)
    for curve in range(len(first.offsets) - 1):
        rows = first.along[first.offsets[curve] : first.offsets[curve + 1]]
        bridge = first.bridge[first.offsets[curve] : first.offsets[curve + 1]]
        for i in range(second.offsets[curve], second.offsets[curve + 1]):
            row = second.along[i]
            stretch = (rows[:-1] <= row) & (row <= rows[1:]) & (np.diff(rows) <= GAP_PX) & ~bridge[:-1]
            assert alone[i] == (not stretch.any() and not (np.abs(rows - row) < 0.5).any())
    assert 0 < alone.sum() < len(alone)

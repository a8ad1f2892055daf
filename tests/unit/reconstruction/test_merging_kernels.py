"""The merging kernels against plain numpy, point by point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import FloatArray, Source
from slrig.reconstruction.merging import _alone_kernel, _fuse_kernel

CENTRE = np.array([0.0, 0.0, -600.0])
WIDEST_PX = 4.0


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


@pytest.fixture(params=range(6))
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
        second.offsets, second.points, second.deviation, second.along, second.bridge, CENTRE, WIDEST_PX,
    )  # fmt: skip
    together = 0
    for curve in range(len(first.offsets) - 1):
        a, b = first.offsets[curve], first.offsets[curve + 1]
        c, d = second.offsets[curve], second.offsets[curve + 1]
        for i in range(a, b):
            k = c + int(np.searchsorted(second.along[c:d], first.along[i])) - 1
            seen = c <= k < d - 1 and second.along[k + 1] - second.along[k] <= WIDEST_PX and not second.bridge[k]
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


def test_points_are_alone_where_the_first_camera_has_no_stretch(pair: tuple[Sheet, Sheet]) -> None:
    first, second = pair
    alone = _alone_kernel(first.offsets, first.along, first.bridge, second.offsets, second.along, WIDEST_PX)
    for curve in range(len(first.offsets) - 1):
        rows = first.along[first.offsets[curve] : first.offsets[curve + 1]]
        bridge = first.bridge[first.offsets[curve] : first.offsets[curve + 1]]
        for i in range(second.offsets[curve], second.offsets[curve + 1]):
            row = second.along[i]
            stretch = (rows[:-1] <= row) & (row <= rows[1:]) & (np.diff(rows) <= WIDEST_PX) & ~bridge[:-1]
            assert alone[i] == (not stretch.any() and not (np.abs(rows - row) < 0.5).any())
    assert 0 < alone.sum() < len(alone)

"""The second axis on frames of a plane whose row positions are known: pixels, code edges on stripes, stray light."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, Gray, NoiseModel, Pinhole, Size, Source
from slrig.patterns import cell_positions, edge_positions, index_of_word
from slrig.reconstruction import AxisPositions, CodeTables, DecodingLimits, SheetCurves, axis_residuals
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.second_axis import SecondAxis, decode_second_axis
from slrig.reconstruction.stripes import sample_image

PROJECTOR = Size(64, 48)
IMAGE = (90, 60)
CODE = Gray(Axis.ROW, 0, 6)
NOISE = NoiseModel(read_variance=1.0, slope=0.0)


def row_of(y: FloatArray | NDArray[np.intp], x: FloatArray | NDArray[np.intp]) -> FloatArray:
    """Projector row that lights a camera pixel."""
    return np.asarray(2.0 + 0.47 * y + 0.02 * x, dtype=np.float64)


def blurred_bit(bit: int, *, inverted: bool) -> NDArray[np.float32]:
    """Light of a bit on the plane, blurred by 0.6 px."""
    fine = 11
    y = (np.arange(IMAGE[0] * fine) + 0.5) / fine - 0.5
    row = row_of(y[:, None], np.arange(IMAGE[1])[None, :])
    cell = np.floor(row + 0.5).astype(int)
    lit = (((cell ^ (cell >> 1)) >> (CODE.bits - 1 - bit)) & 1) ^ inverted
    kernel = np.exp(-0.5 * (np.arange(-3 * fine, 3 * fine + 1) / (0.6 * fine)) ** 2)
    kernel /= kernel.sum()
    smooth = np.apply_along_axis(lambda each: np.convolve(np.pad(each, 3 * fine, "edge"), kernel, "valid"), 0, lit)
    light = smooth.reshape(IMAGE[0], fine, IMAGE[1]).mean(axis=1)
    return np.asarray(20 + 180 * light, dtype=np.float32)


@pytest.fixture(scope="module")
def second() -> SecondAxis:
    bits, inverses = ([blurred_bit(bit, inverted=each) for bit in range(CODE.bits)] for each in (False, True))
    frames = AxisFrames(
        Axis.ROW, np.full(IMAGE, 200, np.float32), np.full(IMAGE, 20, np.float32), bits, inverses, CODE, (), (), 255.0
    )
    tables = CodeTables(index_of_word(CODE), cell_positions(CODE, PROJECTOR), edge_positions(CODE, PROJECTOR))
    return decode_second_axis(frames, NOISE, tables, DecodingLimits())


def test_positions_are_within_half_a_cell(second: SecondAxis) -> None:
    y, x = np.nonzero(np.isfinite(second.positions.position_px))

    error = second.positions.position_px[y, x] - row_of(y, x)

    assert len(y) > 0.95 * IMAGE[0] * IMAGE[1]
    assert np.abs(error).max() <= 0.75
    assert second.positions.sigma_px[y, x].min() == pytest.approx(12**-0.5, rel=1e-5)


def test_edges_on_stripes_are_exact(second: SecondAxis) -> None:
    y = np.arange(1.0, 88.0)
    points = np.concatenate([np.column_stack([np.full_like(y, x), y]) for x in (10.3, 25.7, 44.0)])
    ends = np.zeros(len(points), dtype=np.bool_)
    ends[len(y) - 1 :: len(y)] = True

    at, fraction, position = second.edges(points, ends)

    crossing = points[at] + fraction[:, None] * (points[at + 1] - points[at])
    assert len(at) > 100
    assert np.abs(row_of(crossing[:, 1], crossing[:, 0]) - position).max() < 0.05
    assert not ends[at].any()


def test_image_is_sampled_between_its_pixels() -> None:
    y, x = np.mgrid[:7, :9]
    points = np.array([[0.0, 0.0], [3.25, 2.5], [8.0, 6.0], [-3.0, 2.0]])

    assert sample_image(2 * x + 5 * y, points) == pytest.approx([0, 19, 46, 10])


def test_steps_are_not_interpolated() -> None:
    position = np.full((4, 6), 10, np.float32)
    position[:, 3:] = 90
    positions = AxisPositions(position, np.full_like(position, 12**-0.5))

    found, _ = positions.sample(np.array([[2.4, 1.0], [2.6, 1.0]]))

    assert found == pytest.approx([10, 90])


def test_points_lit_from_elsewhere_are_contradicted() -> None:
    projector = Pinhole(
        PROJECTOR, np.array([[80.0, 0, 31.5], [0, 80.0, 23.5], [0, 0, 1]]), np.zeros(5), np.eye(3), np.zeros(3)
    )
    row = np.linspace(5, 40, 30)
    points = np.column_stack([np.zeros(30), (row - 23.5) / 80 * 500, np.full(30, 500.0)])
    curves = SheetCurves(
        np.array([0, 30], np.int32), np.array([31.5]), points, np.zeros((30, 3)), row,
        np.column_stack([np.full(30, 5.0), np.arange(30.0)]), np.zeros(30, np.int32), np.zeros(30, np.bool_),
        np.full(30, Source.CAMERA_PROJECTOR, np.uint8),
    )  # fmt: skip
    seen = np.repeat(row[:, None], 10, axis=1).astype(np.float32)
    seen[20:] += 6
    seen[3] = np.nan

    residuals = axis_residuals(curves, AxisPositions(seen, np.full_like(seen, 12**-0.5)), projector, along=1)

    assert residuals.contradicted().nonzero()[0].tolist() == list(range(20, 30))
    assert not residuals.contradicted(systematic_px=6).any()

"""The frozen values refuse what cannot be, on construction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.errors import BundleError, CalibrationError, PatternError
from slrig.model import (
    Axis,
    CameraFormat,
    CameraTruth,
    Capture,
    FloatArray,
    Frame,
    Gray,
    LineShift,
    Mesh,
    PatternSequence,
    PointCurves,
    Shot,
    Size,
    Surface,
    White,
    lens,
    lens_kernels,
)
from slrig.model.surface import linear_to_srgb, srgb_to_linear
from tests.samples import pinhole

FORMAT = CameraFormat(Size(4, 3), 8)
SHEARED = np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]])


def test_derived_values() -> None:
    size = Size(1280, 800)
    assert (size.shape, size.along(Axis.COLUMN), size.along(Axis.ROW)) == ((800, 1280), 1280, 800)
    assert str(size) == "1280 x 800"
    with pytest.raises(FrozenInstanceError):
        size.width_px = 3  # type: ignore[misc]
    # The centre of a wide line lies between its columns.
    assert LineShift(Axis.COLUMN, 3, 8, 2).centre_px == 3.5
    assert CameraFormat(Size(4, 3), 12).full_scale == 4095
    device = pinhole(turn_rad=0.7)
    np.testing.assert_allclose(device.rotation @ device.centre_mm + device.translation_mm, 0, atol=1e-12)
    assert len(curves([0, 2, 5]).column_px) == 2
    profile = np.arange(4, dtype=np.uint8)[None, :]
    sequence = PatternSequence(Size(4, 3), (White(),), (profile,))
    assert (len(sequence), sequence.image(0).shape) == (1, (3, 4))
    np.testing.assert_array_equal(sequence.image(0)[2], profile[0])


@pytest.mark.parametrize("name", ["matrix", "distortion", "rotation", "translation_mm"])
def test_pinhole_refuses_numbers_that_are_not_finite_and_other_shapes(name: str) -> None:
    good = pinhole()
    for value in (np.nan, np.inf):
        array = getattr(good, name).copy()
        array.flat[0] = value
        with pytest.raises(CalibrationError, match=f"^{name}: every number must be finite"):
            replace(good, **{name: array})
    with pytest.raises(CalibrationError, match=f"^{name}: expected shape"):
        replace(good, **{name: np.ones(4)})  # type: ignore[arg-type]


def curves(offsets: list[int]) -> PointCurves:
    return PointCurves(
        np.array(offsets, np.int32), np.zeros(len(offsets) - 1), np.zeros((5, 3)), np.zeros(5), np.zeros(5, bool),
        np.zeros(5, np.uint8), np.zeros((5, 3), np.uint8), np.zeros(5, np.uint8),
    )  # fmt: skip


def mesh_of_one_triangle(*, deviations: int) -> Mesh:
    coordinates, bytes_of = np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8)
    faces, deviation = np.array([[0, 1, 2]], np.int32), np.zeros(deviations, np.float32)
    return Mesh(coordinates, faces, coordinates, bytes_of, bytes_of[0], deviation, faces[0])


def capture_of(pattern: int, camera: str, shape: tuple[int, int] = (3, 4)) -> Capture:
    return Capture(Size(4, 4), (White(),), {"left": FORMAT}, (Shot(pattern, camera, np.zeros(shape, np.uint8)),))


@pytest.mark.parametrize(
    ("make", "cases", "error", "words"),
    [
        (Size, [(0, 1), (1, 0), (-3, 4)], ValueError, "at least 1 x 1"),
        (
            lambda rotation: replace(pinhole(), rotation=rotation),
            [(np.diag([1.0, 1.0, -1.0]),), (2 * np.eye(3),), (SHEARED,)],
            CalibrationError,
            "orthonormal right-handed",
        ),
        (
            lambda focal: replace(pinhole(), matrix=np.diag([focal, 51.0, 1.0])),
            [(-50.0,)],
            CalibrationError,
            "positive fx and fy",
        ),
        (
            lambda *given: Gray(Axis.COLUMN, *given),
            [(5, 5, 1, 0), (-1, 5, 1, 0), (0, 0, 1, 0), (0, 5, 0, 0), (0, 5, 1, -1)],
            PatternError,
            "gray pattern",
        ),
        (
            lambda *given: LineShift(Axis.COLUMN, *given),
            [(0, 3, 1), (8, 8, 1), (-1, 8, 1), (0, 8, 0), (0, 8, 8)],
            PatternError,
            "line shift",
        ),
        (
            lambda *profiles: PatternSequence(Size(4, 3), (White(),), profiles),
            [(np.zeros((1, 5), np.uint8),)],
            ValueError,
            "broadcast",
        ),
        (lambda: PatternSequence(Size(4, 3), (White(),), ()), [()], ValueError, "one profile per pattern"),
        (lambda bits: CameraFormat(Size(4, 3), bits), [(0,), (17,)], BundleError, "bit_depth"),
        (capture_of, [(1, "left"), (-1, "left"), (0, "right")], BundleError, "which is not in the list"),
        (capture_of, [(0, "left", (4, 3))], BundleError, "3 x 4, the camera is 4 x 3"),
        (lambda: Shot(0, "left", np.zeros((3, 4, 3), np.uint8)), [()], ValueError, r"Shot\.image"),
        (
            lambda image: Frame("left", image, 0, 1, 0, 0, 0, 0.01, 1.0),
            [(np.zeros((3, 4)),)],
            ValueError,
            r"Frame\.image",
        ),
        (
            lambda: CameraTruth(np.zeros((3, 4)), np.zeros((3, 5, 2)), np.zeros((0, 3))),
            [()],
            ValueError,
            "projector_px",
        ),
        (lambda: Surface(np.zeros((4, 3)), np.zeros((1, 4), np.int32)), [()], ValueError, r"Surface\.faces"),
        (curves, [([0, 4],), ([1, 5],), ([0, 4, 3, 5],)], ValueError, "must rise from 0"),
        (lambda: mesh_of_one_triangle(deviations=2), [()], ValueError, r"Mesh\.sigma_mm"),
    ],
)
def test_invalid_values_are_rejected(
    make: Callable[..., Any], cases: list[tuple[Any, ...]], error: type[Exception], words: str
) -> None:
    for case in cases:
        with pytest.raises(error, match=words):
            make(*case)


# ---- The lens: against OpenCV, and against its own slopes by numbers; compiled and in plain numpy


STRONG = np.array([-0.31, 0.17, 3e-3, -2e-3, 0.05])
POINTS = np.random.default_rng(7).uniform(-0.4, 0.4, (60, 2))
WAYS = pytest.mark.parametrize("way", [lens, lens_kernels], ids=["plain", "compiled"])


def sent(terms: FloatArray, points: FloatArray) -> FloatArray:
    """Where OpenCV's lens sends normalised points (n, 2)."""
    ahead = np.column_stack([points, np.ones(len(points))])[:, None]
    return np.asarray(cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), np.eye(3), terms)[0]).reshape(-1, 2)


@WAYS
def test_the_lens_is_that_of_opencv(way: Any) -> None:
    found = [way.distort(STRONG, x, y)[:2] for x, y in POINTS]
    np.testing.assert_allclose(found, sent(STRONG, POINTS), rtol=0, atol=1e-15)
    assert way.distort(np.zeros(5), 0.31, -0.22) == (0.31, -0.22, 1.0, 0.0, 1.0)


@WAYS
def test_slopes_are_those_of_the_lens(way: Any) -> None:
    h = 1e-6
    for x, y in POINTS:
        _, _, xx, xy, yy = way.distort(STRONG, x, y)
        across, along = (
            (sent(STRONG, np.array([[x, y]]) + step) - sent(STRONG, np.array([[x, y]]) - step))[0] / (2 * h)
            for step in ((h, 0.0), (0.0, h))
        )
        np.testing.assert_allclose([xx, xy], across, rtol=0, atol=1e-9)
        np.testing.assert_allclose([xy, yy], along, rtol=0, atol=1e-9)


@WAYS
@pytest.mark.parametrize(("a", "b"), [(1.0, 0.0), (0.0, 1.0), (-3.0, 0.7)])
def test_derivatives_by_the_terms_are_what_each_term_moves(way: Any, a: float, b: float) -> None:
    # The lens is linear in its terms: without one of them it moves a point by as much less, whatever its size.
    for x, y in POINTS:
        moved = [(sent(term, np.array([[x, y]])) - [x, y])[0] @ [a, b] for term in np.eye(5)]
        np.testing.assert_allclose(way.distortion_by_terms(a, b, x, y), moved, rtol=0, atol=1e-15)


def test_arrays_are_sent_as_their_points_are_to_the_bit() -> None:
    x, y = POINTS.reshape(6, 10, 2).transpose(2, 0, 1)
    one_by_one = np.array([lens_kernels.distort(STRONG, *point) for point in POINTS])
    np.testing.assert_array_equal(np.stack(lens.distort(STRONG, x, y), axis=-1).reshape(-1, 5), one_by_one)


def test_undistort_inverts_distort_and_is_nan_beyond_its_range() -> None:
    for x, y in POINTS:
        xd, yd, *_ = lens.distort(STRONG, float(x), float(y))
        found = lens_kernels.undistort(STRONG, xd, yd, xd, yd, 1e-7)
        np.testing.assert_allclose(found, (x, y), rtol=0, atol=1e-13)
    # x (1 - 0.3 x²) never exceeds 0.7027.
    barrel = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])
    assert np.isfinite(lens_kernels.undistort(barrel, 0.70, 0.0, 0.70, 0.0, 1e-7)).all()
    assert np.isnan(lens_kernels.undistort(barrel, 0.71, 0.0, 0.71, 0.0, 1e-7)).all()


# ---- The sRGB curve against the formula of IEC 61966-2-1, written out once more


def formula(share: float) -> float:
    return 12.92 * share if share <= 0.0031308 else 1.055 * share ** (1 / 2.4) - 0.055


def test_values_are_those_of_the_formula() -> None:
    light = np.random.default_rng(0).random(20_000) ** 3
    exact = np.array([255 * formula(share) for share in light.tolist()])
    assert np.abs(linear_to_srgb(light) - exact).max() < 0.53
    assert linear_to_srgb(np.array([[0.0, 1.0], [0.18, 0.5]])).tolist() == [[0, 255], [118, 188]]


def test_light_beyond_white_is_white_and_none_is_black() -> None:
    assert linear_to_srgb(np.array([-1.0, 7.0, np.inf, -np.inf, np.nan], dtype=np.float32)).tolist() == [
        0,
        255,
        255,
        0,
        0,
    ]


def test_srgb_round_trip_keeps_all_values() -> None:
    values = np.arange(256, dtype=np.uint8)
    light = srgb_to_linear(values)
    assert light.dtype == np.uint16
    assert light[[0, 128, 255]].tolist() == [0, 14146, 65535]
    assert (np.diff(light.astype(int)) >= 19).all()
    assert np.array_equal(linear_to_srgb(light / 65535), values)

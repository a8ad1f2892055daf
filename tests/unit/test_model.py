"""The frozen values refuse what cannot be, on construction."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from slrig.errors import BundleError, CalibrationError, PatternError
from slrig.model import (
    Axis,
    CameraFormat,
    CameraTruth,
    Capture,
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
)
from tests.samples import pinhole


def test_a_size_gives_its_shape_rows_first() -> None:
    size = Size(1280, 800)
    assert size.shape == (800, 1280)
    assert size.along(Axis.COLUMN) == 1280
    assert size.along(Axis.ROW) == 800
    assert str(size) == "1280 x 800"


@pytest.mark.parametrize(("width", "height"), [(0, 1), (1, 0), (-3, 4)])
def test_a_size_is_at_least_one_pixel(width: int, height: int) -> None:
    with pytest.raises(ValueError, match="at least 1 x 1"):
        Size(width, height)


def test_values_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        Size(2, 2).width_px = 3  # type: ignore[misc]


@pytest.mark.parametrize("name", ["matrix", "distortion", "rotation", "translation_mm"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pinhole_refuses_numbers_that_are_not_finite(name: str, value: float) -> None:
    good = pinhole()
    array = getattr(good, name).copy()
    array.flat[0] = value
    with pytest.raises(CalibrationError, match=f"^{name}: every number must be finite"):
        replace(good, **{name: array})


@pytest.mark.parametrize("name", ["matrix", "distortion", "rotation", "translation_mm"])
def test_a_pinhole_refuses_another_shape(name: str) -> None:
    with pytest.raises(CalibrationError, match=f"^{name}: expected shape"):
        replace(pinhole(), **{name: np.ones(4)})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "rotation",
    [np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3), np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]])],
    ids=["mirrored", "scaled", "sheared"],
)
def test_a_pinhole_refuses_what_is_no_rotation(rotation: np.ndarray) -> None:
    with pytest.raises(CalibrationError, match="orthonormal right-handed"):
        replace(pinhole(), rotation=rotation)


def test_a_pinhole_refuses_a_negative_focal_length() -> None:
    with pytest.raises(CalibrationError, match="positive fx and fy"):
        replace(pinhole(), matrix=np.diag([-50.0, 51.0, 1.0]))


def test_the_centre_of_projection_maps_to_the_origin_of_the_device() -> None:
    device = pinhole(turn_rad=0.7)
    np.testing.assert_allclose(device.rotation @ device.centre_mm + device.translation_mm, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("bit", "bits", "cell_px", "offset_px"), [(5, 5, 1, 0), (-1, 5, 1, 0), (0, 0, 1, 0), (0, 5, 0, 0), (0, 5, 1, -1)]
)
def test_a_gray_pattern_must_be_possible(bit: int, bits: int, cell_px: int, offset_px: int) -> None:
    with pytest.raises(PatternError, match="gray pattern"):
        Gray(Axis.COLUMN, bit, bits, cell_px, offset_px)


@pytest.mark.parametrize(("shift", "period_px", "width_px"), [(0, 3, 1), (8, 8, 1), (-1, 8, 1), (0, 8, 0), (0, 8, 8)])
def test_a_line_shift_must_be_possible(shift: int, period_px: int, width_px: int) -> None:
    with pytest.raises(PatternError, match="line shift"):
        LineShift(Axis.COLUMN, shift, period_px, width_px)


def test_the_centre_of_a_wide_line_lies_between_its_columns() -> None:
    assert LineShift(Axis.COLUMN, 3, 8, 2).centre_px == 3.5


def test_a_sequence_spreads_its_profiles() -> None:
    profile = np.arange(4, dtype=np.uint8)[None, :]
    sequence = PatternSequence(Size(4, 3), (White(),), (profile,))
    assert len(sequence) == 1
    assert sequence.image(0).shape == (3, 4)
    np.testing.assert_array_equal(sequence.image(0)[2], profile[0])


def test_a_sequence_refuses_profiles_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="broadcast"):
        PatternSequence(Size(4, 3), (White(),), (np.zeros((1, 5), np.uint8),))
    with pytest.raises(ValueError, match="one profile per pattern"):
        PatternSequence(Size(4, 3), (White(),), ())


@pytest.mark.parametrize("bit_depth", [0, 17])
def test_a_camera_has_one_to_sixteen_bits(bit_depth: int) -> None:
    with pytest.raises(BundleError, match="bit_depth"):
        CameraFormat(Size(4, 3), bit_depth)


def test_full_scale_is_the_saturated_sample() -> None:
    assert CameraFormat(Size(4, 3), 12).full_scale == 4095


@pytest.mark.parametrize(("pattern", "camera"), [(1, "left"), (-1, "left"), (0, "right")])
def test_a_capture_refuses_frames_of_nothing(pattern: int, camera: str) -> None:
    shot = Shot(pattern, camera, np.zeros((3, 4), np.uint8))
    with pytest.raises(BundleError, match="which is not in the list"):
        Capture(Size(4, 4), (White(),), {"left": CameraFormat(Size(4, 3), 8)}, (shot,))


def test_a_capture_refuses_frames_of_another_size() -> None:
    shot = Shot(0, "left", np.zeros((4, 3), np.uint8))
    with pytest.raises(BundleError, match="3 x 4, the camera is 4 x 3"):
        Capture(Size(4, 4), (White(),), {"left": CameraFormat(Size(4, 3), 8)}, (shot,))


def test_images_are_grey_and_unsigned() -> None:
    with pytest.raises(ValueError, match=r"Shot\.image"):
        Shot(0, "left", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(ValueError, match=r"Frame\.image"):
        Frame("left", np.zeros((3, 4)), 0, 1, 0, 0, 0, 0.01, 1.0)  # type: ignore[arg-type]


def test_truth_maps_have_one_extent() -> None:
    with pytest.raises(ValueError, match="projector_px"):
        CameraTruth(np.zeros((3, 4)), np.zeros((3, 5, 2)), np.zeros((0, 3)))


def test_a_surface_is_made_of_triangles() -> None:
    with pytest.raises(ValueError, match=r"Surface\.faces"):
        Surface(np.zeros((4, 3)), np.zeros((1, 4), np.int32))


def _curves(offsets: list[int]) -> PointCurves:
    return PointCurves(
        np.array(offsets, np.int32),
        np.zeros(len(offsets) - 1),
        np.zeros((5, 3)),
        np.zeros(5),
        np.zeros(5, bool),
        np.zeros(5, np.uint8),
        np.zeros((5, 3), np.uint8),
        np.zeros(5, np.uint8),
    )


def test_curves_share_out_their_points() -> None:
    assert len(_curves([0, 2, 5]).column_px) == 2


@pytest.mark.parametrize("offsets", [[0, 4], [1, 5], [0, 4, 3, 5]])
def test_curves_must_cover_all_points_in_order(offsets: list[int]) -> None:
    with pytest.raises(ValueError, match="must rise from 0"):
        _curves(offsets)


def test_a_mesh_has_one_value_per_vertex() -> None:
    with pytest.raises(ValueError, match=r"Mesh\.sigma_mm"):
        Mesh(
            np.zeros((3, 3), np.float32),
            np.array([[0, 1, 2]], np.int32),
            np.zeros((3, 3), np.float32),
            np.zeros((3, 3), np.uint8),
            np.zeros(3, np.uint8),
            np.zeros(2, np.float32),
            np.zeros(3, np.int32),
        )

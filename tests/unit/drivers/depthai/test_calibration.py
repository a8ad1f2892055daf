"""The factory calibration of an OAK device: poses in millimetres, lenses in five coefficients or refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.depthai import Lens, open_camera, read_calibration, read_factory_calibration
from drivers.depthai.calibration import fit_brown_lens
from slrig.devices import CameraSettings
from slrig.errors import CalibrationError
from slrig.model import Size
from tests.unit.drivers.depthai.conftest import small_stage
from tests.unit.drivers.depthai.fake_oak import DEVICE, Chip, FakeOak, dai

SIZE = Size(1280, 800)
MATRIX = np.array([[797.0, 0, 641], [0, 798, 399], [0, 0, 1]])
BROWN = [0.1, -0.2, 0.001, -0.0005, 0.05]
# A rational lens of a usual field of view: the same curve in other words, nearly.
MILD = [0.3, 0.02, 0.0004, -0.0003, 0.001, 0.2, 0.03, 0.002, 0, 0, 0, 0, 0, 0]
STRONG = [10.8, -67.8, 0.0005, 0.0003, 152.0, 10.6, -67.0, 150.5, 0, 0, 0, 0, 0, 0]

RIGHT = np.array(cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0])
RIGHT_CM = [-7.5, 0.1, -0.05]


def handler(*, distortion: list[float] = BROWN, model: Any = None, cameras: str = "BC") -> Any:
    stored = dai.CalibrationHandler()
    for letter in cameras:
        socket = getattr(dai.CameraBoardSocket, f"CAM_{letter}")
        stored.setCameraIntrinsics(socket, MATRIX.tolist(), SIZE.width_px, SIZE.height_px)
        stored.setDistortionCoefficients(socket, distortion)
        if model is not None:
            stored.setCameraType(socket, model)
    if cameras == "BC":
        left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
        stored.setCameraExtrinsics(left, right, RIGHT.tolist(), RIGHT_CM)
    return stored


def oak_with(calibration: Any, **oak: Any) -> FakeOak:
    return FakeOak(small_stage(), calibration=calibration, **oak)


SIZED = {"left": Lens("CAM_B", SIZE), "right": Lens("CAM_C", SIZE)}


def seen_px(points: NDArray[np.float64], matrix: Any, distortion: Any, rotation: Any, shift: Any) -> Any:
    pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], np.asarray(shift), matrix, np.asarray(distortion))
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("distortion", [BROWN, MILD])
def test_points_are_seen_where_the_device_sees_them(distortion: list[float]) -> None:
    oak = oak_with(handler(distortion=distortion))
    with oak.connected():
        factory = read_factory_calibration(DEVICE, SIZED)
    assert oak.opened == oak.closed == 1
    assert factory.calibration.projector is None
    points_mm = np.random.default_rng(1).uniform([-150, -100, 400], [150, 100, 600], (200, 3))
    poses = {"left": (np.eye(3), np.zeros(3)), "right": (RIGHT, np.array(RIGHT_CM) * 10)}
    for name, (rotation, shift_mm) in poses.items():
        ours = factory.calibration.cameras[name]
        assert ours.size == SIZE
        off_px = np.linalg.norm(
            seen_px(points_mm, ours.matrix, ours.distortion, ours.rotation, ours.translation_mm)
            - seen_px(points_mm, MATRIX, distortion, rotation, shift_mm),
            axis=1,
        )
        assert off_px.max() < 0.1
        assert factory.residual_px[name] < 0.1
        assert (factory.residual_px[name] > 0) == (distortion is MILD)
    assert factory.lens_position == {"left": None, "right": None}


def test_the_first_camera_is_the_world() -> None:
    with oak_with(handler()).connected():
        cameras = read_calibration(DEVICE, dict(reversed(SIZED.items()))).cameras
    assert np.allclose(cameras["right"].rotation, np.eye(3))
    assert np.allclose(cameras["left"].rotation, RIGHT.T, atol=1e-6)
    assert np.linalg.norm(cameras["left"].translation_mm) == pytest.approx(np.linalg.norm(RIGHT_CM) * 10, rel=1e-5)


def test_frames_of_another_size_have_their_own_matrix() -> None:
    half = {"left": Lens("CAM_B", Size(640, 400))}
    with oak_with(handler()).connected():
        matrix = read_calibration(DEVICE, half).cameras["left"].matrix
    assert np.allclose(matrix[:2], MATRIX[:2] / 2, atol=0.3)


def test_every_calibrated_camera_is_read_by_default() -> None:
    stored = handler(cameras="C")
    stored.setLensPosition(dai.CameraBoardSocket.CAM_C, 130)
    oak = oak_with(stored, chips=[Chip("CAM_B"), Chip("CAM_C", autofocus=True)])
    with oak.connected():
        factory = read_factory_calibration(DEVICE)
    assert set(factory.calibration.cameras) == {"CAM_C"}
    assert factory.lens_position == {"CAM_C": 130}


def test_a_device_that_is_in_use_here_is_read_and_goes_on() -> None:
    oak = oak_with(handler())
    with oak.connected():
        left = open_camera("left", {"device": DEVICE, "socket": "CAM_B"}, Path())
        assert set(read_calibration(DEVICE, SIZED).cameras) == {"left", "right"}
    assert (oak.opened, oak.closed) == (1, 0)
    assert left.configure(CameraSettings(0.005)).exposure_s == 0.005
    left.close()
    assert oak.closed == 1


@pytest.mark.parametrize(
    ("stored", "cameras", "words"),
    [
        ({"distortion": STRONG}, SIZED, r"'left': .* 14 distortion coefficients, which five follow to [0-9.]+ px only"),
        ({"distortion": [0.02, -0.01, 0.003, -0.001], "model": "Fisheye"}, SIZED, "4 distortion coefficients"),
        ({"model": "RadialDivision"}, SIZED, "stored as RadialDivision"),
        ({"cameras": "B"}, SIZED, "stores no calibration of right"),
        (None, SIZED, "stores no calibration"),
        ({"cameras": ""}, None, "stores no calibration of any of its cameras"),
    ],
)
def test_what_cannot_be_used_is_refused(
    stored: dict[str, Any] | None, cameras: dict[str, Lens] | None, words: str
) -> None:
    kept = None
    if stored is not None:
        model = getattr(dai.CameraModel, stored["model"]) if "model" in stored else None
        kept = handler(**{**stored, "model": model})
    oak = oak_with(kept)
    with oak.connected(), pytest.raises(CalibrationError, match=words):
        read_calibration(DEVICE, cameras)
    assert oak.opened == oak.closed == 1


def test_no_point_of_the_image_is_further_off_than_the_stated_residual() -> None:
    matrix, distortion, residual_px = fit_brown_lens(MATRIX, np.array(STRONG), SIZE)
    x, y = np.meshgrid(np.linspace(-0.85, 0.85, 171), np.linspace(-0.55, 0.55, 111))
    rays = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    stored = seen_px(rays, MATRIX, STRONG, np.eye(3), np.zeros(3))
    inside = (np.abs(stored - [639.5, 399.5]) <= [639.5, 399.5]).all(axis=1)
    off_px = np.linalg.norm(seen_px(rays, matrix, distortion, np.eye(3), np.zeros(3)) - stored, axis=1)[inside]
    # The grid of rays ends a few pixels short of the corners, where the two models part fastest.
    assert 0.6 * residual_px < off_px.max() < 1.01 * residual_px


def test_a_lens_that_folds_is_no_lens() -> None:
    assert fit_brown_lens(MATRIX, np.array([-3.0, 0, 0, 0, 0, 0.5, 0, 0]), SIZE)[2] == float("inf")

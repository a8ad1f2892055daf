"""A film and a series of images: frames at the times that they tell, from `arm` on."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.opencv import open_camera
from drivers.opencv.camera import OpenCvCamera
from slrig.devices import AppliedSettings, CameraSettings, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Pixels
from tests.unit.drivers.conftest import OPENED

RATE_HZ = 100.0
EXPOSURE_S = 0.008
OPTIONS: dict[str, object] = {"device": "film.avi", "source_exposure_s": EXPOSURE_S}


def write_film(path: Path, images: list[Pixels]) -> None:
    rows, columns = images[0].shape
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), RATE_HZ, (columns, rows), False)
    assert film.isOpened()
    for image in images:
        film.write(image)
    film.release()


def ramp(count: int) -> list[Pixels]:
    return [np.full((24, 32), 5 * index, np.uint8) for index in range(count)]


def opened(folder: Path, **options: object) -> OpenCvCamera:
    camera = open_camera("eye", {**OPTIONS, **options}, folder)
    assert isinstance(camera, OpenCvCamera)
    OPENED.append(camera)
    return camera


def test_frames_come_in_order_at_the_films_times(tmp_path: Path) -> None:
    write_film(tmp_path / "film.avi", ramp(10))
    camera = opened(tmp_path)
    camera.arm(10, Trigger.FREE)
    frames = []
    for _ in range(10):
        frames.append(camera.read(0, 5))
        # No sooner than a camera could have given it.
        assert frames[-1].t_end_ns <= time.monotonic_ns()
    assert [int(frame.image[0, 0]) for frame in frames] == [5 * index for index in range(10)]
    starts_ns = [frame.t_start_ns for frame in frames]
    assert np.diff(starts_ns) == pytest.approx(np.full(9, 1e9 / RATE_HZ), abs=1)
    assert {(frame.t_end_ns - frame.t_start_ns, frame.t_err_ns) for frame in frames} == {(8_000_000, 0)}
    with pytest.raises(FrameTimeoutError, match="the film is over after 10 frames; arm"):
        camera.read(0, 5)


def test_arming_begins_the_film_again(tmp_path: Path) -> None:
    write_film(tmp_path / "film.avi", ramp(10))
    camera = opened(tmp_path)
    for _ in range(2):
        camera.arm(1, Trigger.FREE)
        armed_ns = time.monotonic_ns()
        first, second = camera.read(0, 5), camera.read(0, 5)
        assert (int(first.image[0, 0]), int(second.image[0, 0])) == (0, 5)
        assert abs(first.t_start_ns - armed_ns) < 1e9
        with pytest.raises(DeviceStateError, match="runs free"):
            camera.trigger()
        camera.disarm()
    camera.close()


def test_a_series_of_deep_images_keeps_its_depth(tmp_path: Path) -> None:
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index:03d}.png"), np.full((24, 32), 1000 * index, np.uint16))
    camera = opened(tmp_path, device="%03d.png", frame_rate_hz=200.0, bit_depth=12)
    assert camera.info.format.bit_depth == 12
    camera.arm(1, Trigger.FREE)
    assert [int(camera.read(0, 5).image[0, 0]) for _ in range(3)] == [0, 1000, 2000]


def test_a_film_takes_the_exposure_it_was_made_with_and_a_rate_that_is_given(tmp_path: Path) -> None:
    write_film(tmp_path / "film.avi", ramp(20))
    camera = opened(tmp_path, frame_rate_hz=40.0)
    assert camera.configure(CameraSettings(EXPOSURE_S)) == AppliedSettings(EXPOSURE_S, 1.0, least_period_s=None)
    with pytest.raises(UnsupportedByDeviceError, match="no control"):
        camera.configure(CameraSettings(1 / 60))
    camera.arm(1, Trigger.FREE)
    first, second = camera.read(0, 5), camera.read(0, 5)
    assert second.t_start_ns - first.t_start_ns == 25_000_000
    # Those that began too early are passed over.
    assert int(camera.read(first.t_start_ns + 80_500_000, 5).image[0, 0]) == 5 * 4

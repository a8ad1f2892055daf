"""What a rig file says of a source, and films, whose frames come at the times that they tell."""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.opencv import open_camera
from drivers.opencv.camera import OpenCvCamera
from drivers.opencv.options import SourceKind, parse_source
from slrig.devices import AppliedSettings, CameraSettings, Trigger
from slrig.errors import ConfigError, DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Pixels
from tests.unit.drivers.conftest import OPENED

LIVE = {"source_exposure_s": 0.01, "delay_s": 0.1, "frame_rate_hz": 30.0}


@pytest.mark.parametrize(
    ("options", "kind", "backend"),
    [
        ({"device": 0}, SourceKind.DEVICE, cv2.CAP_V4L2),
        ({"device": "/dev/video0"}, SourceKind.DEVICE, cv2.CAP_V4L2),
        # Without its stamps, and through another back end.
        ({"device": 0, "delay_s": 0.1, "frame_rate_hz": 30}, SourceKind.DEVICE, cv2.CAP_V4L2),
        ({"device": 0, "backend": "ffmpeg", **LIVE}, SourceKind.LIVE, cv2.CAP_FFMPEG),
    ],
)
def test_a_camera_is_opened_through_the_kernels_interface(
    tmp_path: Path, options: dict[str, object], kind: SourceKind, backend: int
) -> None:
    source = parse_source("eye", options, tmp_path)
    assert (source.kind, source.backend, source.target) == (kind, backend, options["device"])
    assert source.label == "/dev/video0"


def test_an_address_is_a_live_source_and_its_password_is_not_shown(tmp_path: Path) -> None:
    url = "rtsp://admin:secret@camera.local:554/stream?key=secret"
    source = parse_source("eye", {"device": url, **LIVE}, tmp_path)
    assert (source.kind, source.backend, source.target) == (SourceKind.LIVE, cv2.CAP_FFMPEG, url)
    assert source.label == "rtsp://camera.local:554/stream"


def test_files_are_films_and_pipes_are_live(tmp_path: Path) -> None:
    (tmp_path / "film.avi").touch()
    os.mkfifo(tmp_path / "pipe.mjpeg")
    film = parse_source("eye", {"device": "film.avi", "source_exposure_s": 0.01}, tmp_path)
    assert (film.kind, film.target) == (SourceKind.FILM, str(tmp_path / "film.avi"))
    series = parse_source("eye", {"device": "f/%03d.png", "source_exposure_s": 0.01, "frame_rate_hz": 10}, tmp_path)
    assert (series.kind, series.backend) == (SourceKind.FILM, cv2.CAP_IMAGES)
    assert parse_source("eye", {"device": "pipe.mjpeg", **LIVE}, tmp_path).kind is SourceKind.LIVE


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "device: missing"),
        ({"device": -1}, "device"),
        ({"device": 0, "backand": "ffmpeg"}, r"backand: unknown key; did you mean 'backend'\?"),
        ({"device": 0, "backend": "magic"}, "backend: expected auto or one of .*v4l2.*found 'magic'"),
        (
            {"device": "http://eye/video"},
            r"(?s)frame_rate_hz: missing.*source_exposure_s: missing.*delay_s: missing.*no time stamps",
        ),
        ({"device": "http://eye/video", **LIVE, "frame_rate_hz": 0}, "frame_rate_hz: .*greater than 0"),
        ({"device": 0, "delay_s": 0.1}, r"(?s)frame_rate_hz: missing.*With delay_s, time stamps are not used"),
        ({"device": "film.avi"}, "(?s)source_exposure_s: missing.*the exposure of its frames"),
        ({"device": "film.avi", "source_exposure_s": 0.01, "delay_s": 0.1}, "delay_s"),
        ({"device": "%03d.png", "source_exposure_s": 0.01}, "frame_rate_hz: missing"),
        ({"device": "nothing.avi", "source_exposure_s": 0.01}, "nothing.avi.*No such file"),
        ({"device": ".", "source_exposure_s": 0.01}, "expected a film or a pipe"),
        ({"device": 0, "fourcc": "MJPEG"}, "fourcc"),
        ({"device": "rtsp://eye", **LIVE, "size_px": [0, 2], "delay_s": -1}, r"(?s)size_px.*delay_s: "),
    ],
)
def test_options_are_checked(tmp_path: Path, options: dict[str, object], words: str) -> None:
    (tmp_path / "film.avi").touch()
    with pytest.raises(ConfigError, match=words):
        parse_source("eye", options, tmp_path)


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
    with pytest.raises(FrameTimeoutError, match="the film has ended after 10 frames; arm"):
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
    assert camera.configure(CameraSettings(EXPOSURE_S)) == AppliedSettings(EXPOSURE_S, 1.0, min_period_s=None)
    with pytest.raises(UnsupportedByDeviceError, match="no control"):
        camera.configure(CameraSettings(1 / 60))
    camera.arm(1, Trigger.FREE)
    first, second = camera.read(0, 5), camera.read(0, 5)
    assert second.t_start_ns - first.t_start_ns == 25_000_000
    # Those that began too early are passed over.
    assert int(camera.read(first.t_start_ns + 80_500_000, 5).image[0, 0]) == 5 * 4

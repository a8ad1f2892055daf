"""What a rig file says of a source, and how the times of its frames are known because of that."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest

from drivers.opencv.options import Kind, source_of
from slrig.errors import ConfigError

LIVE = {"source_exposure_s": 0.01, "delay_s": 0.1, "frame_rate_hz": 30.0}


@pytest.mark.parametrize(
    ("options", "kind", "backend"),
    [
        ({"device": 0}, Kind.DEVICE, cv2.CAP_V4L2),
        ({"device": "/dev/video0"}, Kind.DEVICE, cv2.CAP_V4L2),
        # Without its stamps, and through another back end.
        ({"device": 0, "delay_s": 0.1, "frame_rate_hz": 30}, Kind.DEVICE, cv2.CAP_V4L2),
        ({"device": 0, "backend": "ffmpeg", **LIVE}, Kind.LIVE, cv2.CAP_FFMPEG),
    ],
)
def test_a_camera_is_opened_through_the_kernels_interface(
    tmp_path: Path, options: dict[str, object], kind: Kind, backend: int
) -> None:
    source = source_of("eye", options, tmp_path)
    assert (source.kind, source.backend, source.target) == (kind, backend, options["device"])
    assert source.label == "/dev/video0"


def test_an_address_is_a_live_source_and_its_password_is_not_shown(tmp_path: Path) -> None:
    url = "rtsp://admin:secret@camera.local:554/stream?key=secret"
    source = source_of("eye", {"device": url, **LIVE}, tmp_path)
    assert (source.kind, source.backend, source.target) == (Kind.LIVE, cv2.CAP_FFMPEG, url)
    assert source.label == "rtsp://camera.local:554/stream"


def test_files_are_films_and_pipes_are_live(tmp_path: Path) -> None:
    (tmp_path / "film.avi").touch()
    os.mkfifo(tmp_path / "pipe.mjpeg")
    film = source_of("eye", {"device": "film.avi", "source_exposure_s": 0.01}, tmp_path)
    assert (film.kind, film.target) == (Kind.FILM, str(tmp_path / "film.avi"))
    series = source_of("eye", {"device": "f/%03d.png", "source_exposure_s": 0.01, "frame_rate_hz": 10}, tmp_path)
    assert (series.kind, series.backend) == (Kind.FILM, cv2.CAP_IMAGES)
    assert source_of("eye", {"device": "pipe.mjpeg", **LIVE}, tmp_path).kind is Kind.LIVE


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "device: missing"),
        ({"device": -1}, "device"),
        ({"device": 0, "backand": "ffmpeg"}, r"backand: unknown key; did you mean 'backend'\?"),
        ({"device": 0, "backend": "magic"}, "backend: expected auto or one of .*v4l2.*found 'magic'"),
        (
            {"device": "http://eye/video"},
            r"(?s)frame_rate_hz: missing.*source_exposure_s: missing.*delay_s: missing.*No time stamps come from",
        ),
        ({"device": "http://eye/video", **LIVE, "frame_rate_hz": 0}, "frame_rate_hz: .*greater than 0"),
        ({"device": 0, "delay_s": 0.1}, r"(?s)frame_rate_hz: missing.*With delay_s, time stamps are not used"),
        ({"device": "film.avi"}, "(?s)source_exposure_s: missing.*how long each frame was exposed"),
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
        source_of("eye", options, tmp_path)

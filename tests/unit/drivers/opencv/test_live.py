"""A network camera on loopback, and a pipe. What was in a queue is never taken for new: test_feeds."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.opencv import open_camera
from drivers.opencv.camera import OpenCvCamera
from slrig.devices import AppliedSettings, Camera, CameraSettings, Trigger
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from tests.contract.opencv_bench import NetworkCamera, Served
from tests.contract.stage import Stage
from tests.contract.suite import sequence_for
from tests.contract.v4l2_bench import PROJECTOR, staged

LONG_S = 20.0
WHITE = sequence_for(PROJECTOR).profiles[0]


@contextmanager
def before(light: Stage, *, network: NetworkCamera | None = None, **options: Any) -> Iterator[OpenCvCamera]:
    """A camera that looks at a stage over the network."""
    with Served(network or NetworkCamera(light)) as served:
        camera = open_camera("eye", {**served.camera.options(served.url), **options}, Path())
        assert isinstance(camera, OpenCvCamera)
        try:
            yield camera
        finally:
            camera.close()


def read_on(camera: Camera, timeout_s: float = LONG_S) -> None:
    while True:
        camera.read(time.monotonic_ns(), timeout_s)


def test_a_source_declares_what_its_table_says() -> None:
    with (
        pytest.raises(UnsupportedByDeviceError, match="requested 64 x 48, the source gives 80 x 60"),
        before(staged(), size_px=[64, 48]),
    ):
        pass
    with before(staged()) as camera:
        info = camera.info
        assert (info.exposure_range_s, info.gain_range) == ((0.01, 0.01), (1.0, 1.0))
        assert info.triggers == {Trigger.FREE}
        assert str(info.format.size) == "80 x 60"
        assert camera.configure(CameraSettings(0.01005)) == AppliedSettings(0.01, 1.0, min_period_s=0.02)
        with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s 0.02, it takes 0.01 only"):
            camera.configure(CameraSettings(0.02))
        with pytest.raises(UnsupportedByDeviceError, match="requested gain 2, it takes 1 only; OpenCV has no control"):
            camera.configure(CameraSettings(0.01, 2.0))


def test_a_source_faster_than_its_table_gives_no_frame_and_says_why() -> None:
    with before(staged(), frame_rate_hz=1.0) as camera:
        camera.arm(1, Trigger.FREE)
        with pytest.raises(FrameTimeoutError, match=r"half a period of frame_rate_hz = 1 .*sends more frames"):
            camera.read(0, 0.3)


def test_cut_frames_are_skipped_and_counted() -> None:
    light = staged()
    with before(light, network=NetworkCamera(light, cut=0.5)) as camera:
        camera.arm(1, Trigger.FREE)
        light.show(WHITE)
        frames = [camera.read(time.monotonic_ns(), LONG_S) for _ in range(6)]
        # Which frames are cut is chance, and on a busy machine the reader may begin after the first of them.
        while frames[-1].dropped_count == 0 and len(frames) < 60:
            frames.append(camera.read(time.monotonic_ns(), LONG_S))
        assert frames[-1].dropped_count > 0
        assert all(frame.image.mean() > 30 for frame in frames[2:])


def test_a_source_that_ends_is_gone_and_stays_so() -> None:
    network = NetworkCamera(staged())
    with before(network.stage, network=network) as camera:
        camera.arm(1, Trigger.FREE)
        camera.read(0, LONG_S)
        network.gone.set()
        for _ in range(2):
            with pytest.raises(DeviceGoneError, match=r"127.0.0.1:\d+/video gives no more frames"):
                read_on(camera)
        camera.disarm()
        with pytest.raises(DeviceGoneError):
            camera.arm(1, Trigger.FREE)
        camera.close()


def test_a_url_without_a_camera_is_refused_and_its_password_is_not_shown() -> None:
    network = NetworkCamera(staged())
    with Served(network) as served:
        url = served.url
        with pytest.raises(DeviceGoneError, match="no video"):
            open_camera("eye", network.options(f"{url}/else"), Path())
    options = network.options(url.replace("127.0.0.1", "admin:secret@127.0.0.1"))
    with pytest.raises(DeviceGoneError, match=r"no answer from http://127.0.0.1:\d+/video,") as refused:
        open_camera("eye", options, Path())
    assert "secret" not in str(refused.value)


def test_closing_ends_a_read_that_waits() -> None:
    with before(staged()) as camera:
        camera.arm(1, Trigger.FREE)
        ended = threading.Event()

        def wait() -> None:
            with pytest.raises(DeviceStateError, match="closed"):
                camera.read(time.monotonic_ns() + 10**12, 60)
            ended.set()

        thread = threading.Thread(target=wait, daemon=True)
        thread.start()
        camera.close()
        assert ended.wait(LONG_S)
        thread.join(LONG_S)


def test_a_pipe_without_a_writer_does_not_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.opencv.feeds.OPEN_LIMIT_S", 0.2)
    os.mkfifo(tmp_path / "video.mjpeg")
    with pytest.raises(DeviceGoneError, match=r"video.mjpeg did not open within 0.2 s"):
        open_camera("eye", NetworkCamera(staged()).options("video.mjpeg"), tmp_path)
    # Lets the attempt that was given up come to its end.
    os.close(os.open(tmp_path / "video.mjpeg", os.O_WRONLY))


def test_a_device_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match=r"/dev/video250: .*plug it in"):
        open_camera("eye", {"device": 250}, tmp_path)
    with pytest.raises(UnsupportedByDeviceError, match="/dev/null: requesting frames"):
        open_camera("eye", {"device": "/dev/null"}, tmp_path)
    (tmp_path / "film.avi").write_text("no film")
    with pytest.raises(DeviceError, match=r"film.avi: OpenCV cannot open it"):
        open_camera("eye", {"device": "film.avi", "source_exposure_s": 0.01}, tmp_path)

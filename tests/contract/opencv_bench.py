"""The OpenCV driver before staged light: a network camera on loopback, and the same through a pipe."""

from __future__ import annotations

import os
import random
import select
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self

import cv2

from drivers import opencv
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.contract.v4l2_bench import PROJECTOR, staged


@dataclass
class NetworkCamera:
    """A sensor that runs free, and what its server sends of it. Times in seconds.

    delay_s : frames are sent so long after their exposure at most, and `least_delay_s` at least, at a time drawn at
    random; the server, as one that promises this, throws away what has become older. lost, cut : share of frames that
    are not sent, or sent without their end or a part of their middle.
    """

    stage: Stage
    period_s: float = 0.02
    exposure_s: float = 0.01
    delay_s: float = 0.01
    least_delay_s: float = 0.0
    lost: float = 0.0
    cut: float = 0.0
    seed: int = 0
    gone: threading.Event = field(default_factory=threading.Event)

    def parts(self) -> Iterator[bytes]:
        """What one client is sent, part by part, in time, until the camera is gone."""
        rng = random.Random(self.seed)
        begun_ns, number = time.monotonic_ns(), 0
        while not self.gone.is_set():
            age_s = (time.monotonic_ns() - begun_ns) / 1e9 - self.least_delay_s - self.exposure_s
            number = max(number + 1, int(age_s / self.period_s))
            start_ns = begun_ns + round(number * self.period_s * 1e9)
            end_ns = start_ns + round(self.exposure_s * 1e9)
            spread_s = 0.5 * (self.delay_s - self.least_delay_s)
            due_ns = end_ns + round((self.least_delay_s + rng.random() * spread_s) * 1e9)
            lost, cut = rng.random() < self.lost, rng.random() < self.cut
            while (left_ns := due_ns - time.monotonic_ns()) > 0:
                if self.gone.wait(left_ns / 1e9):
                    return
            encoded, data = cv2.imencode(".jpg", self.stage.exposed(start_ns, end_ns), [cv2.IMWRITE_JPEG_QUALITY, 100])
            assert encoded
            sent = bytes(data)
            if cut:
                # Of holes of 100 bytes one in 250 leaves a JPEG that decodes to a whole picture: no decoder knows.
                end, again = rng.choice([(len(sent) // 2, len(sent)), (len(sent) // 3, len(sent) // 3 * 2)])
                sent = sent[:end] + sent[again:]
            if not lost and time.monotonic_ns() < end_ns + self.delay_s * 1e9:
                yield b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(sent) + sent + b"\r\n"

    def options(self, device: str) -> dict[str, object]:
        """The driver's options for it. What is promised is written with room for a busy machine."""
        return {
            "device": device,
            "source_exposure_s": self.exposure_s,
            "delay_s": 3 * self.delay_s,
            "frame_rate_hz": 1 / self.period_s,
        }


class Source(ABC):
    """Where a camera's frames can be had. A context manager."""

    @abstractmethod
    def close(self) -> None:
        """End it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Served(Source):
    """The camera as a server on loopback."""

    def __init__(self, camera: NetworkCamera) -> None:
        self.camera = camera

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path != "/video":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                with suppress(ConnectionError):
                    for part in camera.parts():
                        self.wfile.write(part)

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=partial(self._server.serve_forever, 0.05), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}/video"

    def close(self) -> None:
        self.camera.gone.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(10)


class Piped(Source):
    """The camera as a program that writes into a named pipe."""

    def __init__(self, camera: NetworkCamera, path: Path) -> None:
        self.camera = camera
        self.path = path
        os.mkfifo(path)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def _write(self) -> None:
        while not self.camera.gone.wait(0.005):
            # Nobody may be there to read.
            with suppress(OSError):
                pipe = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)
                try:
                    for part in self.camera.parts():
                        self._send(pipe, part)
                finally:
                    os.close(pipe)

    def _send(self, pipe: int, part: bytes) -> None:
        while part and not self.camera.gone.is_set():
            if select.select([], [pipe], [], 0.05)[1]:
                with suppress(BlockingIOError):
                    part = part[os.write(pipe, part) :]

    def close(self) -> None:
        self.camera.gone.set()
        self._thread.join(10)


def served_bench(folder: Path, *, through: str = "stream") -> Bench:
    """A network camera, or one that another program writes into a file as it goes: a named pipe."""
    light = staged(noise_dn=1.0)
    source: Source
    if through == "stream":
        source = Served(NetworkCamera(light))
        device = source.url
    else:
        source = Piped(NetworkCamera(light), folder / "video.mjpeg")
        device = "video.mjpeg"

    def open_head() -> BenchHead:
        camera = opencv.open_camera("eye", source.camera.options(device), folder)
        return BenchHead({"eye": camera}, StagedProjector(light))

    return Bench(open_head, sequence_for(PROJECTOR), source.close)

"""What the fake video device's sensor sees, as the bytes that a camera would send."""

from __future__ import annotations

import json
import socketserver
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slrig.model import Pixels
from tests.contract.stage import Stage

BIT_DEPTHS = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y16 ": 16, "Y10P": 10, "YUYV": 8, "UYVY": 8, "MJPG": 8, "RG10": 10}
GAIN_UNITS = 16
"""The device's number for gain 1."""
BLUR_PX = 0.06
"""Standard deviation of the blur by a lens that stands one unit of its focus away from where it makes sharp pictures.
"""


def encoded(image: Pixels, code: str, row_bytes: int) -> bytes:
    """Return an image as a camera of this pixel format sends it; rows are padded to `row_bytes`."""
    if code == "MJPG":
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        return bytes(data)
    height, width = image.shape
    match code:
        case "GREY":
            rows = image.astype(np.uint8)
        case "YUYV" | "UYVY":
            rows = np.full((height, 2 * width), 128, np.uint8)
            rows[:, (code == "UYVY") :: 2] = image
        case "Y10P":
            rows = np.array([_packed(row) for row in image], np.uint8)
        case _:
            rows = image.astype("<u2").view(np.uint8)
    padded = np.full((height, row_bytes), 0xEE, np.uint8)
    padded[:, : rows.shape[1]] = rows
    return padded.tobytes()


def _packed(row: Pixels) -> list[int]:
    packed: list[int] = []
    for first in range(0, len(row), 4):
        group = [int(sample) for sample in row[first : first + 4]]
        packed += [sample >> 2 for sample in group]
        packed.append(sum((sample & 3) << 2 * place for place, sample in enumerate(group)))
    return packed


class Sensor:
    """What a fake camera sees: each question is one exposure, each answer the bytes of one frame.

    rolling : its rows are exposed one after another, within the read-out. sharp_at : the place of its lens that makes a
    sharp picture; others blur it by `BLUR_PX` for each unit of its focus.
    noise_when_corrupt : whether a corrupt frame holds random bytes; otherwise its second half is missing.
    asked : every question so far, the truth about the frames that came.
    """

    def __init__(
        self,
        stage: Stage,
        *,
        readout_s: float = 0.0,
        rolling: bool = False,
        sharp_at: int = 0,
        noise_when_corrupt: bool = True,
    ) -> None:
        self.stage = stage
        self.readout_ns = round(readout_s * 1e9) if rolling else 0
        self.sharp_at = sharp_at
        self.noise_when_corrupt = noise_when_corrupt
        self.rng = np.random.default_rng(1)
        self.asked: list[dict[str, Any]] = []

    def image_bytes(self, asked: dict[str, Any]) -> bytes:
        self.asked.append(asked)
        data = encoded(self.image(asked), asked["code"], asked["row_bytes"])
        if not asked["corrupt"]:
            return data
        return self.rng.bytes(len(data)) if self.noise_when_corrupt else data[: len(data) // 2]

    def image(self, asked: dict[str, Any]) -> Pixels:
        start_ns, exposure_ns = asked["start_ns"], asked["exposure_ns"]
        return self.stage.exposed(
            start_ns,
            start_ns + exposure_ns,
            gain=max(asked["gain"], GAIN_UNITS) / GAIN_UNITS,
            readout_ns=self.readout_ns,
            defocus_px=BLUR_PX * abs(asked["focus"] - self.sharp_at),
        )


class SensorService(Sensor):
    """The same for a camera in another process, which asks over a socket."""

    def __init__(self, path: Path, stage: Stage, **more: Any) -> None:
        super().__init__(stage, **more)
        service = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    data = service.image_bytes(json.loads(line))
                    self.wfile.write(b"%d\n" % len(data) + data)

        class Server(socketserver.ThreadingUnixStreamServer):
            daemon_threads = True
            block_on_close = False

        self._server = Server(str(path), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, name="sensor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

"""Live depth: its messages as arrays, from a service or from a recording of them."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slrig.client.connection import Json, Resource, given
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ServiceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_HEAD = struct.Struct("<II")
_MOST_BYTES = 1 << 28  # of one message: longer ones are not of a stream of depth
_LEAST_SIGMA_MM, _SIGMA_RATIO = 1e-4, 1.05


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """One depth image. depth_mm, sigma_mm : (h, w) float32, along the camera's axis, NaN where none is known. state :
    (h, w) uint8: 0 measured, 1 moved (its frames do not show one surface, and the depth may be off by `moved_mm` of
    `facts`), 2 saturated, 3 dark, 4 unclear, 5 unseen by camera or projector, 6 outside the region. grey : (h, w)
    uint8. directions : (h, w, 2) float32, x/z and y/z of each ray in the camera. facts : number, time_s, window_s,
    age_s (from the arrival of the newest frame to the image), came_s (that arrival, by the monotonic clock of the
    service), shares by state, distance_mm, tilt_deg and more.
    """

    depth_mm: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    state: NDArray[np.uint8]
    grey: NDArray[np.uint8]
    directions: NDArray[np.float32]
    facts: dict[str, Any]

    @property
    def points_mm(self) -> NDArray[np.float32]:
        """(h, w, 3) float32: organised cloud in the camera's frame, mm; NaN unless measured."""
        import numpy as np

        depth = np.where(self.state == 0, self.depth_mm, np.float32(np.nan))[:, :, None]
        return np.concatenate([self.directions * depth, depth], axis=2).astype(np.float32)


class Live(Resource):
    """Live depth of a service: the rig repeats a short sequence while it is idle."""

    def start(
        self,
        camera: str | None = None,
        *,
        step: int | None = None,
        exposure_s: float | None = None,
        preset: str | None = None,
        region: Mapping[str, Any] | None = None,
    ) -> Json:
        """Begin. step : at least, pixels from one decoded point to the next. region : what of the scene is decoded, as
        {"depth_mm": [400, 700]}; None for that of the preset or of the rig file. Raises ServiceError: there is one
        already with other options.
        """
        options = given(camera=camera, step=step, exposure_s=exposure_s, preset=preset, region=region)
        return self._connection.json("POST", "/live", json=options)

    def status(self) -> Json:
        """State of live depth: `depth_per_s`, `viewers`, `facts` of the newest image."""
        return self._connection.json("GET", "/live")

    def end(self) -> None:
        """End it. The projector is dark when the exposure under way is over."""
        self._connection.send("DELETE", "/live")

    def _messages(self, step: int | None = None) -> Iterator[tuple[dict[str, Any], bytes]]:
        """The messages as they come, until live depth ends. step : pixels of the camera from point to point."""
        with self._connection.streamed("/live/depth", params=given(step=step)) as pieces:
            yield from split_messages(pieces)

    def watch(self, step: int | None = None) -> Iterator[LiveFrame]:
        """The depth images as they come, until the caller stops. Raises ServiceError: why live depth ended."""
        yield from frames(self._messages(step))

    def record(self, path: Path, *, step: int | None = None, seconds: float = 10.0) -> int:
        """Write the depth images of some seconds of the rig's clock into a new file; return how many.

        `read_recording` reads them. Raises ServiceError, StorageError.
        """
        count, begin_s = 0, None
        with storage_errors(path), path.open("xb") as file:
            for head, body in self._messages(step):
                if head["kind"] in ("geometry", "depth"):
                    text = json.dumps(head, separators=(",", ":")).encode()
                    file.write(_HEAD.pack(len(text), len(body)) + text + body)
                if head["kind"] == "end":
                    raise ServiceError(head.get("reason", "live depth ended"))
                if head["kind"] == "depth":
                    count += 1
                    begin_s = head["time_s"] if begin_s is None else begin_s
                    if head["time_s"] - begin_s >= seconds:
                        break
        return count


def read_recording(path: Path) -> Iterator[LiveFrame]:
    """The depth images of a recording, in order. Raises StorageError; ConfigError: it is none, or was cut."""
    with storage_errors(path), path.open("rb") as file:
        try:
            yield from frames(split_messages(iter(lambda: file.read(1 << 20), b"")))
        except (ValueError, KeyError, zlib.error) as error:
            message = f"{path}: not a recording of live depth, or a damaged one ({error}); record it again"
            raise ConfigError(message) from error


def split_messages(pieces: Iterable[bytes]) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Heads and bodies of a stream that comes in pieces. Raises ValueError: it is another stream, or was cut."""
    waiting = bytearray()
    for piece in pieces:
        waiting += piece
        while len(waiting) >= _HEAD.size:
            text, body = _HEAD.unpack_from(waiting)
            if text + body > _MOST_BYTES:
                message = f"a message of {text + body} bytes"
                raise ValueError(message)
            end = _HEAD.size + text + body
            if len(waiting) < end:
                break
            head = json.loads(waiting[_HEAD.size : _HEAD.size + text])
            yield head, bytes(waiting[_HEAD.size + text : end])
            del waiting[:end]
    if waiting:
        message = f"the last message was cut after {len(waiting)} bytes"
        raise ValueError(message)


def frames(messages: Iterable[tuple[dict[str, Any], bytes]]) -> Iterator[LiveFrame]:
    """Depth images of messages. Raises ServiceError: live depth ended, and why; ValueError: a message is damaged."""
    import numpy as np

    directions: NDArray[np.float32] | None = None
    for head, body in messages:
        if head["kind"] == "end":
            raise ServiceError(head.get("reason", "live depth ended"))
        if head["kind"] not in ("geometry", "depth"):
            continue
        shape = head["height"], head["width"]
        if head["kind"] == "geometry":
            directions = np.frombuffer(zlib.decompress(body), "<f4").reshape(*shape, 2)
        elif directions is not None and directions.shape[:2] == shape:
            low, high, sigmas, state, grey = np.frombuffer(zlib.decompress(body), np.uint8).reshape(5, *shape)
            q = np.cumsum(low + (high.astype(np.uint16) << 8), axis=1, dtype=np.uint16)
            depth = np.where(q > 0, head["near_mm"] + (q - 1.0) * head["unit_mm"], np.nan).astype(np.float32)
            sigma = _LEAST_SIGMA_MM * _SIGMA_RATIO ** (sigmas.astype(np.float32) - 1)
            sigma = np.where(sigmas > 0, sigma, np.nan).astype(np.float32)
            yield LiveFrame(depth, sigma, state, grey, directions, head)

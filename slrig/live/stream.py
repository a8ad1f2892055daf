"""The messages of a stream of depth images, encoded once for all who watch.

A message is a head of eight bytes, two little-endian uint32: the lengths of a JSON text and of the bytes after it.
The first one, "geometry", has the rays, as deflated float32 (h, w, 2): x/z and y/z of each pixel. Each "depth" has, as
one deflated block of planes, the differences along each row of the quantised depth (uint16, low bytes, then high
bytes), and as bytes σ on a logarithmic scale, state and grey value.
"""

from __future__ import annotations

import json
import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    # Not for the service, which loads no mathematics.
    from slrig.live.depth import DepthImage, Float32

_HEAD = struct.Struct("<II")
_LEVEL = 1  # of compression: higher ones take several times as long for a tenth less
SIGMA_RATIO = 1.05
"""Of neighbouring codes of σ."""
LEAST_SIGMA_MM = 1e-4


def message(head: dict[str, Any], body: bytes) -> bytes:
    """Frame one message."""
    text = json.dumps(head, separators=(",", ":")).encode()
    return _HEAD.pack(len(text), len(body)) + text + body


def geometry_message(directions: Float32, step: int, facts: dict[str, Any]) -> bytes:
    """Encode what holds for all depth images of every `step`-th ray. directions : (h, w, 2)."""
    rays = np.ascontiguousarray(directions[::step, ::step], "<f4")
    head = {"kind": "geometry", "width": rays.shape[1], "height": rays.shape[0], **facts}
    return message(head, zlib.compress(rays.tobytes(), _LEVEL))


def depth_message(image: DepthImage, step: int, near_mm: float, unit_mm: float, facts: dict[str, Any]) -> bytes:
    """Encode every `step`-th pixel of a depth image: depth z as q, z = near_mm + (q − 1) unit_mm, 0 for none."""
    depth, sigma = image.depth_mm[::step, ::step], image.sigma_mm[::step, ::step]
    known = np.isfinite(depth)
    codes = np.where(known, np.clip(np.rint((depth - near_mm) / unit_mm) + 1, 1, 65535), 0).astype(np.uint16)
    rows = np.diff(codes, axis=1, prepend=np.uint16(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.rint(np.log(sigma / np.float32(LEAST_SIGMA_MM)) / np.float32(np.log(SIGMA_RATIO))) + 1
    sigmas = np.where(known, np.clip(scale, 1, 255), 0).astype(np.uint8)
    planes: list[NDArray[np.uint8]] = [
        (rows & 0xFF).astype(np.uint8), (rows >> 8).astype(np.uint8), sigmas,
        image.state[::step, ::step], image.grey[::step, ::step],
    ]  # fmt: skip
    body = zlib.compress(b"".join(plane.tobytes() for plane in planes), _LEVEL)
    head = {"kind": "depth", "width": depth.shape[1], "height": depth.shape[0], "near_mm": near_mm, "unit_mm": unit_mm}
    return message({**head, **facts}, body)

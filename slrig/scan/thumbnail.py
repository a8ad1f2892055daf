"""A small picture of a scan's mesh alone, for lists, cut out of its preview. Loads none of what computes a scan."""

from __future__ import annotations

import cv2
import numpy as np

from slrig.errors import DamagedError

GAP_PX, CAPTION_PX = 10, 34
"""Of the preview: beside and above its panels, and below each."""

BACKDROP = (74, 67, 63)
"""Behind the mesh, blue, green, red."""

_WIDE_PX, _HIGH_PX = 320, 240
_FILL = 0.86


def encode_thumbnail(preview: bytes) -> bytes:
    """The last panel of a preview.png, the mesh that is turned, as a PNG, 320 x 240, without caption and scale.

    Raises DamagedError: that is no picture.
    """
    shown = cv2.imdecode(np.frombuffer(preview, dtype=np.uint8), cv2.IMREAD_COLOR)
    if shown is None:
        message = "preview.png cannot be read as a picture. Reconstruct the scan again."
        raise DamagedError(message)
    panel_px = (shown.shape[1] - 4 * GAP_PX) // 3
    panel = shown[GAP_PX:-CAPTION_PX, -GAP_PX - panel_px : -GAP_PX]
    # Everywhere on a mesh there is more red than blue, and elsewhere, scale and its letters included, less.
    mesh = panel[..., 2] > panel[..., 0]
    left, top, wide, high = cv2.boundingRect(mesh.astype(np.uint8))
    thumbnail = np.full((_HIGH_PX, _WIDE_PX, 3), BACKDROP, dtype=np.uint8)
    if mesh.any():
        alone = np.where(mesh[..., None], panel, thumbnail[0, 0])[top : top + high, left : left + wide]
        scale = min(_FILL * _WIDE_PX / wide, _FILL * _HIGH_PX / high, 1.0)
        size = max(1, round(wide * scale)), max(1, round(high * scale))
        small = cv2.resize(alone, size, interpolation=cv2.INTER_AREA)
        row, column = (_HIGH_PX - size[1]) // 2, (_WIDE_PX - size[0]) // 2
        thumbnail[row : row + size[1], column : column + size[0]] = small
    return cv2.imencode(".png", thumbnail)[1].tobytes()

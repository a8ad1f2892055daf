"""From a pattern to the light on a camera's pixels: projector response, projector blur, table look-up, camera blur.

A pattern that varies along one axis, blurred by a round Gaussian, is a product of one profile along the columns and
one along the rows. So the light of a pattern at any projector position is two table look-ups.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import upfirdn
from scipy.special import ndtr

from simulated_rig.transport import Paths
from slrig.model import FloatArray, Pixels, Size

Float32Array = NDArray[np.float32]

NODES_PER_PX = 32
"""Table nodes per projector pixel; between them the look-up is linear (error under 0.0003 of white at blur 0.5 px)."""


@dataclass(frozen=True, slots=True)
class Response:
    """How a projector turns grey values into light: leak + (1 - leak) * (value / 255) ^ gamma, and its blur.

    `blur_px` is the standard deviation of the lens's Gaussian spread; each pixel is a square before it.
    """

    gamma: float
    leak: float
    blur_px: float

    def light(self, values: Pixels) -> FloatArray:
        """Light of grey values 0..255, same shape, as a fraction of full white."""
        return np.asarray(self.leak + (1 - self.leak) * (values / 255.0) ** self.gamma, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LightTable:
    """The light of one pattern: along(columns) * along(rows), NODES_PER_PX samples per projector pixel.

    columns, rows : (n,) float32; node i lies at the projector coordinate i / NODES_PER_PX - margin_px.
    """

    columns: Float32Array
    rows: Float32Array
    margin_px: int

    @property
    def peak(self) -> float:
        """The brightest light of the pattern, full white giving 1."""
        return float(self.columns.max() * self.rows.max())


def light_table(profile: Pixels, projector: Size, response: Response) -> LightTable:
    """Return the light of one pattern; `profile` is (1, Wp), (Hp, 1) or (1, 1) uint8."""
    light = response.light(profile)
    if light.shape[0] > 1 and light.shape[1] > 1:
        message = f"a pattern may vary along one axis only, found an image of shape {profile.shape}"
        raise ValueError(message)
    across = np.broadcast_to(light[0], projector.width_px) if light.shape[0] == 1 else np.ones(projector.width_px)
    down = np.broadcast_to(light[:, 0], projector.height_px) if light.shape[0] > 1 else np.ones(projector.height_px)
    margin = _margin_px(response.blur_px)
    return LightTable(_spread(across, response.blur_px), _spread(down, response.blur_px), margin)


def no_light(projector: Size) -> LightTable:
    """Return the table of a lamp that is off."""
    return LightTable(
        np.zeros(projector.width_px * NODES_PER_PX, np.float32),
        np.zeros(projector.height_px * NODES_PER_PX, np.float32),
        0,
    )


def radiance(paths: Paths, table: LightTable) -> Float32Array:
    """(H, W) float32: light that reaches each camera pixel from the projector, a white diffuser giving 1."""
    light: Float32Array = _gather(
        paths.column_px, paths.row_px, paths.weight, table.columns, table.rows, np.float32(table.margin_px)
    )
    return light


def blurred(image: Float32Array, blur_px: float) -> Float32Array:
    """The image as the camera's lens spreads it: a Gaussian of standard deviation blur_px."""
    if blur_px == 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _margin_px(blur_px: float) -> int:
    return int(np.ceil(4.5 * blur_px)) + 1


@lru_cache(maxsize=8)
def _spread_of_one_pixel(blur_px: float) -> FloatArray:
    """A unit square pixel blurred by a Gaussian, sampled at the nodes from -margin to +margin."""
    margin = _margin_px(blur_px)
    x = np.arange(-margin * NODES_PER_PX, margin * NODES_PER_PX + 1) / NODES_PER_PX
    if blur_px == 0:
        return np.where(np.abs(x) < 0.5, 1.0, np.where(np.abs(x) == 0.5, 0.5, 0.0))
    return np.asarray(ndtr((x + 0.5) / blur_px) - ndtr((x - 0.5) / blur_px), dtype=np.float64)


def _spread(light: FloatArray, blur_px: float) -> Float32Array:
    return np.asarray(upfirdn(_spread_of_one_pixel(blur_px), light, up=NODES_PER_PX), np.float32)


@njit(cache=True, nogil=True)
def _looked_up(table: Float32Array, position: np.float32, margin: np.float32) -> np.float32:
    at = (position + margin) * np.float32(NODES_PER_PX)
    if not (at >= 0) or at >= len(table) - 1:
        return np.float32(0)
    node = int(at)
    part = at - np.float32(node)
    return np.float32(table[node] + part * (table[node + 1] - table[node]))


@njit(cache=True, nogil=True)
def _gather(
    column: Float32Array,
    row: Float32Array,
    weight: Float32Array,
    columns: Float32Array,
    rows: Float32Array,
    margin: np.float32,
) -> Float32Array:
    height, width, count = weight.shape
    out = np.zeros((height, width), np.float32)
    for r in range(height):
        for c in range(width):
            total = np.float32(0)
            for s in range(count):
                share = weight[r, c, s]
                if share > 0:
                    light = _looked_up(columns, column[r, c, s], margin)
                    if light > 0:
                        total += share * light * _looked_up(rows, row[r, c, s], margin)
            out[r, c] = total / np.float32(count)
    return out

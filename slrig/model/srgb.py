"""sRGB, in which pictures and meshes hold colours in 8 bits, and the light that it stands for (IEC 61966-2-1:1999).

Light is a share of white, and proportional to photons; an sRGB value is about light to the power of 1/2.4, as eyes see.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model.arrays import FloatArray

_FULL_16 = 65_535
# Light below which the curve is straight, and what comes out there.
_STRAIGHT_BELOW, _STRAIGHT_SLOPE = 0.0031308, 12.92
_POWER, _OFFSET = 2.4, 0.055


def srgb_of(light: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """(...) uint8: the sRGB value of light, a share of white. Beyond 0 to 1 it is cut; NaN gives 0."""
    share = np.clip(np.nan_to_num(light, nan=0.0, posinf=1.0), 0, 1)
    return np.asarray(_to_srgb()[np.rint(share * _FULL_16).astype(np.uint16)])


def light_of(srgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """(...) uint16: the light of an sRGB value, of 65535 for white. 8 bits of it could not tell dark colours apart."""
    return np.asarray(_to_light()[srgb])


@cache
def _to_srgb() -> NDArray[np.uint8]:
    """(65536,) uint8, by light of 65535: the steepest place errs by a fortieth of an sRGB step."""
    light: FloatArray = np.arange(_FULL_16 + 1) / _FULL_16
    curved = (1 + _OFFSET) * light ** (1 / _POWER) - _OFFSET
    value: FloatArray = np.where(light <= _STRAIGHT_BELOW, _STRAIGHT_SLOPE * light, curved)
    return np.rint(255 * value).astype(np.uint8)


@cache
def _to_light() -> NDArray[np.uint16]:
    """(256,) uint16, by sRGB value."""
    value: FloatArray = np.arange(256) / 255
    straight = value <= _STRAIGHT_SLOPE * _STRAIGHT_BELOW
    light: FloatArray = np.where(straight, value / _STRAIGHT_SLOPE, ((value + _OFFSET) / (1 + _OFFSET)) ** _POWER)
    return np.rint(_FULL_16 * light).astype(np.uint16)

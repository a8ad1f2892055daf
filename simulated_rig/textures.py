"""Albedo that varies over an object: checkers and smooth noise."""

from __future__ import annotations

import numpy as np

from slrig.kernels import kernel_part


@kernel_part
def _hash01(x: int, y: int, z: int) -> float:
    """A number in 0..1 that looks random, the same for the same lattice point."""
    # 64-bit arithmetic cut to 32 bits after each product: the same under numba and in plain Python.
    h = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return float(h ^ (h >> 16)) / 4294967295.0


@kernel_part
def texture_value(kind: int, x: float, y: float, z: float) -> float:
    """Darkness 0..1 of a texture at (x, y, z), in grains. 0 uniform, 1 checker, 2 smooth value noise, two octaves."""
    if kind == 1:
        return float((int(np.floor(x)) + int(np.floor(y))) % 2)
    if kind != 2:
        return 0.0
    total = 0.0
    for octave in range(2):
        scale = 1.0 + octave
        xs, ys, zs = x * scale, y * scale, z * scale
        i, j, k = int(np.floor(xs)), int(np.floor(ys)), int(np.floor(zs))
        fx, fy, fz = xs - i, ys - j, zs - k
        # Smoothstep, so that the shading has no creases at the lattice.
        fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
        value = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            share = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
            value += share * _hash01(i + a, j + b, k + c)
        total += value * (2.0 / 3.0 if octave == 0 else 1.0 / 3.0)
    return total

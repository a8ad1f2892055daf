"""How a mesh is lit, against the same light in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numba import config
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import Size
from slrig.scan import shading
from slrig.scan.shading import Picture, resized

SHAPE = (30, 40)


def plain_lit(face: NDArray[np.int32], normals: NDArray[np.float32], front: NDArray[np.bool_]) -> Picture:
    """Each light's share of each pixel, at once over the whole picture."""
    light = 0.12 + np.maximum(normals.astype(np.float64) @ LIGHTS.T, 0).sum(axis=2)
    colour = np.where(front[..., None], (196, 209, 219), (92, 92, 176))
    return np.where((face >= 0)[..., None], light[..., None] * colour, 7).astype(np.uint8)


LIGHTS = np.array(((0.0, 0.0, -0.46), (0.25, -0.29, -0.22)))


@pytest.mark.parametrize("threads", [1, 2])
def test_light_is_that_of_plain_arithmetic(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    random = np.random.default_rng(5)
    normals = random.normal(size=(*SHAPE, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    face = random.integers(-1, 3, SHAPE).astype(np.int32)
    front = random.random(SHAPE) < 0.5
    picture = np.full((*SHAPE, 3), 7, dtype=np.uint8)
    given = face, normals, front, LIGHTS, shading._COLOURS, picture
    in_bands(shading._lit, SHAPE[0], *given, rows_at_least=1)
    expected = plain_lit(face, normals, front)
    # Where a product is a whole number but for rounding, either side of it may be found.
    assert np.abs(picture.astype(int) - expected).max() <= 1
    assert (picture == expected).mean() > 0.999


def test_a_picture_of_the_size_asked_for_is_left_alone() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
    assert resized(picture, Size(40, 30)) is picture
    assert np.array_equal(resized(picture, Size(80, 60))[::2, ::2], picture)
    half = picture.reshape(15, 2, 20, 2, 3).mean(axis=(1, 3))
    assert resized(picture, Size(20, 15)) == pytest.approx(half, abs=0.5)

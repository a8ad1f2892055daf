"""Edges of the code, where light from other surfaces adds to a bit or to its inverse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from slrig.model import FloatArray, NoiseModel
from slrig.reconstruction.camera_response import CameraResponse
from slrig.reconstruction.decoded_image import (
    DecodedImage,
    ReconstructionLimits,
    code_edge_points,
    light_from_surfaces,
    undecoded_image,
)
from slrig.reconstruction.stripes import StripeLimits
from tests.unit.reconstruction.builders import code_frames, grid

SHAPE = (120, 400)
CELLS_PX = (200, 130, 90, 70, 50, 40, 30, 20)
SHARES = (0.2, 0.7, 0.4, 0.1, 0.5, 0.3, 0.8, 0.9)
EDGES_PX = np.arange(20.0, 400.0, 20.0) - 0.5


def image_of(from_walls: float, shares: Sequence[float]) -> DecodedImage:
    """A plate with up to this much light from walls, of which each bit has a share, and its inverse the rest."""
    random = np.random.default_rng(3)
    x, _ = grid(SHAPE)
    glow = from_walls * np.exp(-(((x - 200) / 150) ** 2))
    lit = [gaussian_filter1d((x // cell % 2).astype(np.float64), 1.0, axis=1) for cell in CELLS_PX]

    def seen(light: FloatArray) -> NDArray[np.float32]:
        return np.asarray(20 + 100 * light + random.standard_normal(SHAPE), np.float32)

    bits = [seen(each + share * glow) for each, share in zip(lit, shares, strict=True)]
    inverses = [seen(1 - each + (1 - share) * glow) for each, share in zip(lit, shares, strict=True)]
    frames = code_frames(bits=np.array(bits), inverses=np.array(inverses), white=seen(1 + glow), black=seen(0 * x))
    return undecoded_image(frames, CameraResponse(NoiseModel(1.0, 0.0)), ReconstructionLimits())


@pytest.mark.parametrize("from_walls", [0.0, 0.4])
def test_edges_stay_in_place_under_light_from_other_surfaces(from_walls: float) -> None:
    points = code_edge_points(image_of(from_walls, SHARES), StripeLimits(), 1.0)[-1]
    across, down = points.points_px.T
    inner = (np.abs(down - SHAPE[0] / 2) < 40) & (across > 30) & (across < 370)
    error = np.abs(across[inner, None] - EDGES_PX).min(axis=1)
    assert np.count_nonzero(inner) > 1000
    assert np.median(error) < 0.01
    # Half of the errors of a normal distribution are below 0.67 standard deviations.
    assert 0.5 < np.median(error) / np.median(points.sigma_px[inner]) < 1.2


@pytest.mark.parametrize("from_walls", [0.0, 0.4, 1.0])
def test_the_share_of_light_from_other_surfaces_is_measured(from_walls: float) -> None:
    median, most = light_from_surfaces(image_of(from_walls, [0.5] * len(CELLS_PX)))
    assert most == pytest.approx(from_walls / (1 + from_walls), abs=0.06)
    assert median <= most

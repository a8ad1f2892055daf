"""Colour in the rendered rig: objects reflect light of three colours, and a camera that is told to see them does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from simulated_rig.device import SimulatedHead
from simulated_rig.transport import LUMA
from slrig.errors import ConfigError
from slrig.model import FloatArray, Frame
from tests.unit.simulated_rig.building import FACING_PLATE, frames_of, small_head

PLATE = """
[[object]]
shape = "plane"
size_mm = [400.0, 400.0]
albedo = 0.5
colour = [0.2, 0.6, 1.0]
"""
CHECKED = (
    PLATE
    + """
[object.texture]
kind = "checker"
contrast = 0.0
scale_mm = 16.0
colour = [1.0, 0.5, 0.1]
"""
)
WHITE, BLACK = 0, 1
SEES = (0.7, 1.0, 0.6)
QUIET = {"full_well_e": 1e9, "bit_depth": 16, "read_noise_e": 0.0}


def light_of(white: Frame, black: Frame) -> FloatArray:
    """(H, W, 3): white less black, in colour."""
    assert white.colour is not None
    assert black.colour is not None
    return white.colour().astype(float) - black.colour()


def reflectance(head: SimulatedHead) -> FloatArray:
    """(H, W, 3): the truth."""
    paths = head._views["eye"].prepare()
    return np.stack([paths.for_channel(channel).albedo for channel in range(3)], axis=2).astype(float)


def test_a_camera_that_sees_colour_has_the_grey_frames_that_it_had_without(tmp_path: Path) -> None:
    mono = frames_of(small_head(tmp_path, ambient=0.1), WHITE, BLACK)
    colour = frames_of(small_head(tmp_path, ambient=0.1, camera={"colour": SEES}), WHITE, BLACK)
    # White is white however it is told.
    scene = FACING_PLATE + "colour = [1.0, 1.0, 1.0]\n[object.texture]\ncolour = [1.0, 1.0, 1.0]\n"
    told = frames_of(small_head(tmp_path, scene, ambient=0.1, camera={"colour": SEES}), WHITE, BLACK)
    for one, other, third in zip(mono, colour, told, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.image, third.image)
        assert one.colour is None
        assert other.colour is not None


def test_frames_of_a_coloured_plate_have_its_colour_and_grey_is_its_luma(tmp_path: Path) -> None:
    head = small_head(tmp_path, PLATE, camera={"colour": (1.0, 1.0, 1.0), **QUIET})
    assert head.cameras["eye"].info.colour
    white, black = frames_of(head, WHITE, BLACK)
    light = light_of(white, black)
    np.testing.assert_allclose(light.mean(axis=(0, 1)) / light.mean(axis=(0, 1))[2], [0.2, 0.6, 1.0], rtol=1e-3)
    grey = white.image.astype(float) - black.image
    np.testing.assert_allclose(light @ LUMA, grey, rtol=2e-3)
    np.testing.assert_allclose(reflectance(head)[24, 32], 0.5 * np.array([0.2, 0.6, 1.0]), rtol=1e-5)
    plain = frames_of(small_head(tmp_path, PLATE.replace("colour = [0.2, 0.6, 1.0]", ""), camera=QUIET), WHITE, BLACK)
    luma = 0.2 * 0.114 + 0.6 * 0.587 + 0.299
    np.testing.assert_allclose(grey.mean(), luma * (plain[0].image.mean() - plain[1].image.mean()), rtol=1e-3)


@pytest.mark.parametrize(("blur_px", "defocus_px"), [(0.0, 0.0), (0.8, 3.0)])
def test_white_less_black_has_the_colours_of_a_texture(tmp_path: Path, blur_px: float, defocus_px: float) -> None:
    eye = {"colour": SEES, "blur_px": blur_px, "defocus_px": defocus_px, "focus_mm": 400.0, **QUIET}
    head = small_head(tmp_path, CHECKED, camera=eye, ambient=0.2)
    light, truth = light_of(*frames_of(head, WHITE, BLACK)), reflectance(head)
    hues = np.unique(np.round(truth[20:28, 10:54].reshape(-1, 3), 3), axis=0)
    assert {tuple(hue) for hue in hues} >= {(0.1, 0.3, 0.5), (0.5, 0.25, 0.05)}
    reach = 3 if blur_px == 0 else 9
    # Away from the edges of squares, as far as blur reaches, all of a pixel's light comes from one colour.
    inside = maximum_filter(truth[..., 0], reach) - minimum_filter(truth[..., 0], reach) < 1e-6
    inside[:4] = inside[-4:] = inside[:, :4] = inside[:, -4:] = False
    assert np.count_nonzero(inside) > 40
    shares = light[inside] / (truth[inside] * SEES)
    # One light for all three colours.
    np.testing.assert_allclose(shares / shares.mean(axis=1, keepdims=True), 1.0, atol=0.01)
    np.testing.assert_allclose(shares / np.median(shares), 1.0, atol=0.06)


def test_a_stale_frame_has_the_colour_of_the_one_before(tmp_path: Path) -> None:
    head = small_head(tmp_path, PLATE, camera={"colour": SEES}, faults={"stale_frames": [1]})
    white, black = frames_of(head, WHITE, BLACK)
    assert not light_of(white, black).any()


def test_colours_are_shares(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"object\.0\.plane\.colour|colour"):
        small_head(tmp_path, PLATE.replace("1.0]", "1.5]"))

"""Lenses that are sharp at one distance, against the width that a line's image has at each."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_rig.light import Float32Array, Response, light_table
from simulated_rig.optics import LEVELS_PX, Focus, level_weights
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import Scene, build_surface
from slrig.model import FloatArray, Pinhole, Size
from tests.unit.simulated_rig.building import line_profile

SIZE = Size(400, 60)
FOCAL_PX = 1500.0
BLUR_PX = 0.5
LAMP = Size(1024, 64)
PERIOD = 64


def device(x_mm: float, size: Size) -> Pinhole:
    matrix = np.array([[FOCAL_PX, 0, (size.width_px - 1) / 2], [0, FOCAL_PX, (size.height_px - 1) / 2], [0, 0, 1]])
    return Pinhole(size, matrix, np.zeros(5), np.eye(3), np.array([-x_mm, 0.0, 500.0]))


def image(
    *, turned_deg: float = 0.0, z_mm: float = 0.0, lamp: Focus, lens: Focus, blur_px: float = BLUR_PX
) -> Float32Array:
    """(H, W): a plate about the world's origin under lines of one column, as one camera sees it."""
    plate: dict[str, Any] = {
        "shape": "plane", "size_mm": [900.0, 900.0], "position_mm": [0.0, 0.0, z_mm],
        "rotation_deg": [0.0, turned_deg, 0.0],
    }  # fmt: skip
    projector = device(10.0, LAMP)
    stage = SceneState(
        build_surface(Scene.model_validate({"object": [plate]}), Path()), projector, working_distance_mm=500
    )
    view = CameraView(
        device(-10.0, SIZE), stage, blur_px=blur_px, focus=(lamp, lens), ambient=0.0, samples_per_axis=3, jitter=False,
        seed=1, workers=1,
    )  # fmt: skip
    response = Response(gamma=1.0, leak=0.0, blur_px=BLUR_PX, focus=lamp)
    return view.image([(1.0, light_table(line_profile(LAMP, 5, period=PERIOD), LAMP, response))])


SHARP = Focus()


def test_each_pixel_lies_between_two_levels() -> None:
    spread = np.array([[0.0, 0.2, 0.5, 1.9, 2.6, 4.0]])
    weights = level_weights(spread)
    assert sum(weights.values()) == pytest.approx(np.ones((1, 6)))
    assert sum(LEVELS_PX[index] * weight for index, weight in weights.items()) == pytest.approx(spread)
    assert all(np.count_nonzero([weight[0, x] for weight in weights.values()]) <= 2 for x in range(6))


def test_spread_grows_with_the_distance_from_the_focus() -> None:
    focus = Focus(500.0, 10.0)
    assert focus.spread_px(np.array([250.0, 500.0, 625.0, np.nan])) == pytest.approx([4.0, 0.0, 2.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("soft", ["lamp", pytest.param("lens", marks=pytest.mark.slow)])
def test_a_plate_at_one_distance_is_as_soft_as_through_a_lens_of_that_blur(soft: str) -> None:
    # 125 mm beyond the focus a spread of 10 px far away is one of 2 px; aside of the axis it is a little more.
    out = Focus(500.0, 10.0)
    lamp, lens = (out, SHARP) if soft == "lamp" else (SHARP, out)
    blurred = image(z_mm=125.0, lamp=lamp, lens=lens)
    focused = image(z_mm=125.0, lamp=SHARP, lens=SHARP)
    wider = image(z_mm=125.0, lamp=SHARP, lens=SHARP, blur_px=math.hypot(BLUR_PX, 2.0))
    inner = np.s_[10:-10, 30:-30]
    # Both devices have as many pixels to the millimetre, so it does not matter which of them is out of focus.
    assert blurred[inner] == pytest.approx(wider[inner], abs=0.01)
    assert np.abs(blurred[inner] - focused[inner]).max() > 0.1
    at_focus = image(lamp=lamp, lens=lens)
    assert at_focus[inner] == pytest.approx(image(lamp=SHARP, lens=SHARP)[inner], abs=0.01)


def widths_px(seen: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Centre and standard deviation of each line in the middle row."""
    row = seen[SIZE.height_px // 2].astype(np.float64)
    middles = [x for x in range(20, len(row) - 20) if row[x] == row[x - 20 : x + 21].max() > 0.05]
    found = []
    for middle in middles:
        x = np.arange(middle - 20, middle + 21)
        light = row[x] / row[x].sum()
        centre = (light * x).sum()
        found.append((centre, math.sqrt((light * (x - centre) ** 2).sum())))
    return np.array(found).T[0], np.array(found).T[1]


@pytest.mark.slow
def test_on_a_slanted_plate_lines_widen_as_the_lens_says() -> None:
    seen = image(turned_deg=50.0, lamp=Focus(500.0, 9.0), lens=SHARP)
    sharp = image(turned_deg=50.0, lamp=SHARP, lens=SHARP)
    centre, width = widths_px(seen)
    _, sharp_width = widths_px(sharp)
    camera, slope = device(-10.0, SIZE), math.tan(math.radians(50.0))
    # A ray from (-10, 0, -500) along (a, 0, 1) meets z = -x tan 50° at t = (500 + 10 tan 50°)/(1 + a tan 50°).
    a = (centre - camera.matrix[0, 2]) / FOCAL_PX
    t = (500 + 10 * slope) / (1 + a * slope)
    points = np.stack([-10 + a * t, -500 + t], axis=1)
    distance = np.hypot(points[:, 0] - 10.0, points[:, 1] + 500.0)
    spread = 9.0 * np.abs(1 - 500.0 / distance)
    assert np.ptp(spread) > 0.9
    # A column of the lamp is as many pixels wide as the plate's slant makes it: near 1 here.
    along = np.gradient(centre) / PERIOD
    expected = np.hypot(sharp_width, spread * along)
    assert width == pytest.approx(expected, rel=0.06)

"""The sRGB curve against the formula of IEC 61966-2-1, written out once more."""

from __future__ import annotations

import numpy as np

from slrig.model.srgb import light_of, srgb_of


def formula(share: float) -> float:
    return 12.92 * share if share <= 0.0031308 else 1.055 * share ** (1 / 2.4) - 0.055


def test_values_are_those_of_the_formula() -> None:
    light = np.random.default_rng(0).random(20_000) ** 3
    exact = np.array([255 * formula(share) for share in light.tolist()])
    assert np.abs(srgb_of(light) - exact).max() < 0.53
    assert srgb_of(np.array([[0.0, 1.0], [0.18, 0.5]])).tolist() == [[0, 255], [118, 188]]


def test_light_beyond_white_is_white_and_none_is_black() -> None:
    assert srgb_of(np.array([-1.0, 7.0, np.inf, -np.inf, np.nan], dtype=np.float32)).tolist() == [0, 255, 255, 0, 0]


def test_every_value_comes_back_and_dark_ones_stay_apart() -> None:
    values = np.arange(256, dtype=np.uint8)
    light = light_of(values)
    assert light.dtype == np.uint16
    assert light[[0, 128, 255]].tolist() == [0, 14146, 65535]
    assert (np.diff(light.astype(int)) >= 19).all()
    assert np.array_equal(srgb_of(light / 65535), values)

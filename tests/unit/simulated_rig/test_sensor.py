"""Noise, saturation and quantisation of the rendered camera."""

from __future__ import annotations

import numpy as np
import pytest

from simulated_rig import rendering as sensor_module
from simulated_rig.rendering import SensorModel


def sensor(**changes: float) -> SensorModel:
    values: dict[str, float] = {
        "full_well_e": 12000.0,
        "read_noise_e": 10.0,
        "saturation_s": 0.02,
        "pedestal_dn": 0.0,
    }
    bit_depth = int(changes.pop("bit_depth", 12))
    values |= changes
    return SensorModel(bit_depth=bit_depth, **values)


def flat(electrons: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.full((300, 300), electrons, np.float32)


def test_the_photon_transfer_curve_has_the_slope_of_the_gain_and_the_offset_of_the_read_noise() -> None:
    camera = sensor()
    means, variances = [], []
    for index, electrons in enumerate((500.0, 1500.0, 3000.0, 6000.0, 9000.0)):
        frame = camera.read_out(flat(electrons), gain=1.0, rng=np.random.default_rng(index)).astype(np.float64)
        means.append(frame.mean())
        variances.append(frame.var() - 1 / 12)
    k = 4095 / 12000
    slope, offset = np.polyfit(means, variances, 1)
    assert slope == pytest.approx(k, rel=0.03)
    np.testing.assert_allclose(np.array(means), k * np.array([500.0, 1500, 3000, 6000, 9000]), rtol=2e-3)
    dark = camera.read_out(flat(0.0) + 400, gain=1.0, rng=np.random.default_rng(9)).astype(np.float64)
    assert dark.var() - 1 / 12 == pytest.approx(k**2 * (100 + 400), rel=0.03)
    assert abs(offset) < 0.05 * max(variances)


@pytest.mark.parametrize(("bit_depth", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_the_full_well_is_the_full_scale_at_every_depth(bit_depth: int, dtype: type[np.generic]) -> None:
    camera = sensor(bit_depth=bit_depth, read_noise_e=0.0)
    rng = np.random.default_rng(0)
    saturated = camera.read_out(flat(30000.0), gain=1.0, rng=rng)
    assert saturated.dtype == dtype
    assert (saturated == 2**bit_depth - 1).all()
    half = camera.read_out(flat(6000.0), gain=1.0, rng=rng)
    assert half.mean() == pytest.approx((2**bit_depth - 1) / 2, rel=2e-3)


def test_gain_multiplies_and_clips_at_full_scale() -> None:
    camera = sensor()
    plain = camera.read_out(flat(2000.0), gain=1.0, rng=np.random.default_rng(1))
    louder = camera.read_out(flat(2000.0), gain=4.0, rng=np.random.default_rng(1))
    assert louder.mean() == pytest.approx(4 * plain.mean(), rel=1e-3)
    assert (camera.read_out(flat(11000.0), gain=4.0, rng=np.random.default_rng(1)) == 4095).all()


def test_the_pedestal_lifts_the_dark_and_keeps_its_noise_visible() -> None:
    camera = sensor(bit_depth=10, pedestal_dn=20.0, read_noise_e=30.0)
    dark = camera.read_out(flat(0.0), gain=1.0, rng=np.random.default_rng(2)).astype(np.float64)
    assert dark.mean() == pytest.approx(20.0, abs=0.05)
    expected = camera.dn_per_electron(1.0) * 30.0
    assert np.sqrt(dark.var() - 1 / 12) == pytest.approx(expected, rel=0.02)
    assert camera.dn_per_electron(1.0) == pytest.approx((1023 - 20) / 12000)


def test_values_are_rounded_to_the_nearest_number() -> None:
    camera = sensor(bit_depth=8, full_well_e=255.0, read_noise_e=0.0)
    image = np.array([[0.0, 0.49, 0.51, 7.2, 254.6, 300.0]], np.float32)
    out = np.zeros(image.shape, np.uint8)
    arguments = (image, np.zeros_like(image), *(np.float32(a) for a in (255.0, 0.0, 1.0, 0.0, 255.0, 1.0)), out)
    sensor_module._digitise(*arguments)
    np.testing.assert_array_equal(out, [[0, 0, 1, 7, 255, 255]])
    assert camera.dn_per_electron(1.0) == 1


def test_digitising_kernel_equals_numpy() -> None:
    rng = np.random.default_rng(3)
    electrons = rng.uniform(0, 14000, (20, 30)).astype(np.float32)
    camera = sensor(bit_depth=10, pedestal_dn=5.0)
    found = camera.read_out(electrons, gain=2.0, rng=np.random.default_rng(7))
    draws = np.random.default_rng(7).standard_normal((20, 30), dtype=np.float32)
    held = np.minimum(electrons + np.sqrt(electrons + 100) * draws, 12000)
    expected = np.clip(np.floor(5 + 2 * (1023 - 5) / 12000 * held + 0.5), 0, 1023)
    assert np.abs(found - expected).max() <= 1
    assert (found == expected).mean() > 0.99


def test_electrons_follow_exposure_and_saturate_at_the_stated_one() -> None:
    camera = sensor()
    white = np.ones((2, 2), np.float32)
    np.testing.assert_allclose(camera.electrons(white, 0.02), 12000, rtol=1e-6)
    np.testing.assert_allclose(camera.electrons(white, 0.005), 3000, rtol=1e-6)


@pytest.mark.parametrize("response", [0.45, 1.0, 2.2])
def test_values_grow_with_light_to_the_power_of_the_response(response: float) -> None:
    camera = sensor(response=response, read_noise_e=0.0, full_well_e=1e6, bit_depth=16, pedestal_dn=500.0)
    for share in (0.05, 0.3, 0.8):
        read = camera.read_out(flat(share * 1e6), gain=1.0, rng=np.random.default_rng(0))
        linear = (500 + share * (65535 - 500)) / 65535
        assert read.mean() == pytest.approx(65535 * linear**response, rel=2e-3)
    assert (camera.read_out(flat(2e6), gain=1.0, rng=np.random.default_rng(0)) == 65535).all()

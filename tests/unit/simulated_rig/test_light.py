"""Patterns turned into light: response, blur, and the table look-up against shading by brute force."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from simulated_rig import light
from simulated_rig.light import NODES_PER_PX, LightTable, Response, blur_image, dark_table, light_table, radiance
from simulated_rig.transport import LightPaths
from slrig.model import FloatArray, Pixels, Size
from tests.unit.simulated_rig.building import line_profile, small_head

SIZE = Size(24, 16)
WHITE = np.full((1, 1), 255, np.uint8)


def spread_by_hand(values: FloatArray, positions: FloatArray, blur_px: float) -> FloatArray:
    """Square pixels of given light, seen at `positions` through a Gaussian: a sum of error functions."""
    low = positions[:, None] - np.arange(len(values)) - 0.5
    scale = np.sqrt(2) * blur_px
    return np.asarray((values * (erf((low + 1) / scale) - erf(low / scale)) / 2).sum(axis=1))


def nodes(table: LightTable) -> FloatArray:
    return np.arange(len(table.columns)) / NODES_PER_PX - table.margin_px


@pytest.mark.parametrize("blur_px", [0.3, 0.6, 1.7])
def test_a_table_holds_the_blurred_line_pattern(blur_px: float) -> None:
    profile = line_profile(SIZE, 3)
    table = light_table(profile, SIZE, Response(gamma=1.0, leak=0.0, blur_px=blur_px))
    expected = spread_by_hand(profile[0] / 255.0, nodes(table), blur_px)
    np.testing.assert_allclose(table.columns, expected, atol=1e-5)


def test_without_blur_a_table_holds_the_square_pixels() -> None:
    table = light_table(line_profile(SIZE, 3), SIZE, Response(gamma=1.0, leak=0.0, blur_px=0.0))
    at = nodes(table)
    lit = np.abs((at - 3 + 4) % 8 - 4) < 0.5
    off = np.abs((at - 3 + 4) % 8 - 4) > 0.5
    assert (table.columns[lit & (at > 0)] == 1).all()
    assert (table.columns[off] == 0).all()


def test_the_response_is_a_power_law_above_the_leak() -> None:
    response = Response(gamma=2.2, leak=0.01, blur_px=0.0)
    values = np.array([[0, 51, 128, 255]], np.uint8)
    expected = 0.01 + 0.99 * np.array([[0, 0.2, 128 / 255, 1]]) ** 2.2
    np.testing.assert_allclose(response.light(values), expected)


def test_native_patterns_of_black_and_white_do_not_know_gamma() -> None:
    tables = [
        light_table(line_profile(SIZE, 3), SIZE, Response(gamma=gamma, leak=0.001, blur_px=0.6)) for gamma in (1.0, 2.6)
    ]
    np.testing.assert_array_equal(tables[0].columns, tables[1].columns)


@pytest.mark.parametrize("lit", [np.arange(24) % 8 == 3, np.arange(24) // 8 == 1], ids=["lines", "bar"])
def test_gamma_acts_on_values_that_the_signal_has_spread(lit: NDArray[np.bool_]) -> None:
    response = Response(gamma=2.2, leak=0.01, blur_px=0.6, signal_blur_px=0.5)
    table = light_table(np.where(lit, 255, 0).astype(np.uint8)[None], SIZE, response)
    # Spread by a sampled Gaussian: weights exp(-i²/2σ²) that sum to 1, over four σ.
    weight = np.exp(-(np.arange(-2, 3) ** 2) / (2 * 0.5**2))
    value = np.convolve(lit.astype(np.float64), weight / weight.sum(), mode="same")
    expected = spread_by_hand(0.01 + 0.99 * value**2.2, nodes(table), 0.6)
    np.testing.assert_allclose(table.columns, expected, atol=1e-5)


def test_a_row_pattern_varies_down_and_fades_at_the_sides() -> None:
    profile = np.zeros((16, 1), np.uint8)
    profile[5] = 255
    table = light_table(profile, SIZE, Response(gamma=1.0, leak=0.0, blur_px=0.5))
    rows = np.arange(len(table.rows)) / NODES_PER_PX - table.margin_px
    np.testing.assert_allclose(table.rows, spread_by_hand(profile[:, 0] / 255.0, rows, 0.5), atol=1e-5)
    np.testing.assert_allclose(table.columns, spread_by_hand(np.ones(24), nodes(table), 0.5), atol=1e-5)


def test_no_light_is_dark_and_white_peaks_at_one() -> None:
    response = Response(gamma=1.8, leak=0.002, blur_px=0.6)
    assert dark_table(SIZE).peak == 0
    assert light_table(WHITE, SIZE, response).peak == pytest.approx(1, abs=1e-4)
    assert light_table(np.zeros((1, 1), np.uint8), SIZE, response).peak == pytest.approx(0.002, rel=1e-3)


def test_a_pattern_that_varies_both_ways_is_refused() -> None:
    with pytest.raises(ValueError, match="one axis"):
        light_table(np.zeros((16, 24), np.uint8), SIZE, Response(gamma=1.0, leak=0.0, blur_px=0.0))


@pytest.mark.parametrize(("per_axis", "blur_px"), [(1, 0.0), (1, 0.7), (2, 0.0), (2, 0.6), (3, 0.25), (3, 2.1)])
def test_kernels_equal_interpolation_and_a_filter_of_all_samples_in_numpy(per_axis: int, blur_px: float) -> None:
    rng = np.random.default_rng(2)
    shape = (6, 7, per_axis**2)
    paths = LightPaths(
        rng.uniform(-4, 28, shape).astype(np.float32),
        rng.uniform(-4, 20, shape).astype(np.float32),
        np.where(rng.random(shape) < 0.3, 0, rng.random(shape)).astype(np.float32),
        np.zeros(shape[:2], np.float32),
    )
    table = light_table(line_profile(SIZE, 2), SIZE, Response(gamma=1.0, leak=0.001, blur_px=0.6))
    across = np.interp(paths.column_px, nodes(table), table.columns, left=0, right=0)
    down_at = np.arange(len(table.rows)) / NODES_PER_PX - table.margin_px
    down = np.interp(paths.row_px, down_at, table.rows, left=0, right=0)
    fine = (paths.weight * across * down).reshape(6, 7, per_axis, per_axis).transpose(0, 2, 1, 3)
    expected = through_optics(fine.reshape(6 * per_axis, 7 * per_axis), per_axis, blur_px)
    np.testing.assert_allclose(radiance(paths, table, blur_px=blur_px), expected, atol=1e-5)
    tables = (table.columns, table.rows, np.float32(table.margin_px))
    shares = light._pixel_weights(blur_px, per_axis)
    sides = [light._mirror_indices(length, shares.shape) for length in (7, 6)]
    rows = light._filter_rows.py_func(paths.column_px, paths.row_px, paths.weight, *tables, shares, sides[0])
    np.testing.assert_allclose(light._filter_columns.py_func(rows, shares, sides[1]), expected, atol=1e-5)


def through_optics(fine: FloatArray, per_axis: int, blur_px: float) -> FloatArray:
    """The pixels of a fine image, mirrored at its border: Gaussian and square laid over every sample, no separation."""
    around = np.ceil(5 * blur_px + 1).astype(int) * per_axis
    rows, columns = (np.arange(-around, length + around) for length in fine.shape)
    image = np.pad(fine, around, mode="symmetric")
    out = np.zeros((fine.shape[0] // per_axis, fine.shape[1] // per_axis))
    for r, c in np.ndindex(*out.shape):
        off = [(at + 0.5) / per_axis - 0.5 - centre for at, centre in ((rows, r), (columns, c))]
        if blur_px:
            scale = np.sqrt(2) * blur_px
            down, across = (erf((d + 0.5) / scale) - erf((d - 0.5) / scale) for d in off)
        else:
            down, across = ((np.abs(d) < 0.5).astype(np.float64) for d in off)
        weight = down[:, None] * across
        out[r, c] = (weight * image).sum() / weight.sum()
    return out


@pytest.mark.parametrize("axis", ["column", "row"])
def test_a_rendered_frame_equals_shading_by_brute_force(tmp_path: Path, axis: str) -> None:
    """Every sample of every pixel traced, projected and shaded again, in plain numpy and OpenCV."""
    size = Size(80, 60)
    values = np.arange(80 if axis == "column" else 60)
    profile: Pixels = np.where(values % 5 < 2, 200, 20).astype(np.uint8)
    profile = profile[None] if axis == "column" else profile[:, None]
    projector = {"blur_px": 0.6, "gamma": 1.8, "leak": 0.01, "distortion": [-0.1, 0.05, 0.002, -0.001, 0.01]}
    head = small_head(tmp_path, projector=projector, samples_per_axis=2, ambient=0.05)
    view = head._views["eye"]
    found = view.image([(1.0, light_table(profile, size, view_response(gamma=1.8, leak=0.01)))])

    camera, lens = head.exact_calibration.cameras["eye"], head.exact_calibration.projector
    assert lens is not None
    expected = np.zeros((48, 64))
    linear = 0.01 + 0.99 * (profile.ravel() / 255.0) ** 1.8
    rotation, _ = cv2.Rodrigues(lens.rotation)
    column, row = np.meshgrid(np.arange(64.0), np.arange(48.0))
    for du in (-0.25, 0.25):
        for dv in (-0.25, 0.25):
            in_camera = np.stack([(column + du - 31.5) / 400, (row + dv - 23.5) / 400, np.ones_like(row)], axis=-1)
            ray = in_camera.reshape(-1, 3) @ camera.rotation
            point = camera.centre_mm + ray * (-camera.centre_mm[2] / ray[:, 2])[:, None]
            pixels, _ = cv2.projectPoints(point, rotation, lens.translation_mm, lens.matrix, lens.distortion)
            u, v = np.asarray(pixels).reshape(-1, 2).T
            across = spread_by_hand(linear if axis == "column" else np.ones(80), u, 0.6)
            down = spread_by_hand(linear if axis == "row" else np.ones(60), v, 0.6)
            distance = np.linalg.norm(point - lens.centre_mm, axis=1)
            shade = 0.8 * 500 / distance * (np.hypot(60, 500) / distance) ** 2
            expected += (across * down * shade).reshape(48, 64) / 4
    np.testing.assert_allclose(found, expected + 0.05 * 0.8, atol=5e-4)
    assert np.ptp(expected) > 0.3


def view_response(*, gamma: float, leak: float) -> Response:
    return Response(gamma=gamma, leak=leak, blur_px=0.6)


def test_the_blur_of_an_image_has_the_stated_width_and_keeps_the_light() -> None:
    image = np.zeros((41, 41), np.float32)
    image[20, 20] = 1
    out = blur_image(image, 1.3).astype(np.float64)
    offset = np.arange(41) - 20.0
    assert out.sum() == pytest.approx(1, abs=1e-5)
    assert (out.sum(axis=0) * offset**2).sum() == pytest.approx(1.3**2, rel=0.02)
    assert (out.sum(axis=1) * offset**2).sum() == pytest.approx(1.3**2, rel=0.02)
    assert blur_image(image, 0.0) is image


def test_two_lights_in_one_exposure_mix_by_their_time(tmp_path: Path) -> None:
    head = small_head(tmp_path)
    view = head._views["eye"]
    response = Response(gamma=1.0, leak=0.0, blur_px=0.0)
    size = Size(80, 60)
    white, lines = light_table(WHITE, size, response), light_table(line_profile(size, 1), size, response)
    mixed = view.image([(0.25, white), (0.75, lines)])
    expected = 0.25 * view.image([(1.0, white)]) + 0.75 * view.image([(1.0, lines)])
    np.testing.assert_allclose(mixed, expected, atol=1e-6)

"""Albedo of points whose light was made by Lambert's law in plain numpy, and its marks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import AlbedoMark, FloatArray, Pinhole, Size
from slrig.reconstruction.albedo import (
    BRIGHT_ALBEDO,
    BRIGHT_PERCENT,
    MIN_COSINE,
    Albedo,
    AlbedoSamples,
    Illumination,
    estimate_albedo,
    sample_contrast,
)
from tests.unit.reconstruction import builders
from tests.unit.reconstruction.builders import PROJECTOR, Sphere, opencv_rays

BALL = Sphere()


def coarse(device: Pinhole) -> Pinhole:
    """The device with a sixth of its pixels."""
    return replace(device, size=Size(256, 192), matrix=device.matrix * [[0.4], [0.4], [1.0]])


CAMERA, OTHER_CAMERA = coarse(builders.CAMERA), coarse(builders.OTHER_CAMERA)
SHAPE = CAMERA.size.shape
SOUND = (AlbedoMark.NONE, AlbedoMark.SHADED)


def tint(points_mm: FloatArray, channels: int = 1) -> FloatArray:
    """(n, C): what the ball is painted with, from 0.2 to 0.7."""
    phase = np.arange(channels)
    return np.asarray(0.45 + 0.25 * np.sin(points_mm[:, :1] / 11 + points_mm[:, 1:2] / 17 + phase))


def lit(points_mm: FloatArray) -> FloatArray:
    """(n,): the light that falls there."""
    towards = PROJECTOR.centre_mm - points_mm
    distance = np.linalg.norm(towards, axis=1)
    cosine = (normals_of(points_mm) * towards).sum(axis=1) / distance
    return np.asarray(np.maximum(cosine, 0) / distance**2)


def normals_of(points_mm: FloatArray) -> FloatArray:
    outward = points_mm - np.array(BALL.centre_mm)
    return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))


def seen_by(device: Pinhole, gain: float = 1.0, channels: int = 1) -> Illumination:
    """The ball before a camera whose values are `gain` times as large as another's."""
    rows, columns = np.indices(SHAPE).reshape(2, -1).astype(np.float64)
    points = on_ball(device, np.stack([columns, rows], axis=1))
    decoded = np.isfinite(points[:, 0])
    light = np.zeros((len(points), channels), dtype=np.float32)
    light[decoded] = gain * 1e7 * lit(points[decoded])[:, None] * tint(points[decoded], channels)
    return Illumination(device, light.reshape(*SHAPE, channels), np.zeros(SHAPE, np.bool_), decoded.reshape(SHAPE))


def on_ball(device: Pinhole, pixels_px: FloatArray) -> FloatArray:
    """(n, 3): where rays meet the ball, NaN where they do not."""
    with np.errstate(invalid="ignore"):
        return BALL.seen_along(device.centre_mm, opencv_rays(device, pixels_px))


def points_in(*views: Illumination, shared: bool = True, count: int = 3000, base: int = 0) -> AlbedoSamples:
    """Random points that each camera sees, lit; those of the camera `base`, more than of any other, are seen by all."""
    random = np.random.default_rng(1)
    parts, pixels = [], []
    for index, view in enumerate(views):
        rows, columns = np.nonzero(cv2.erode(view.decoded.astype(np.uint8), np.ones((5, 5), np.uint8)))
        wanted = 2 * count if index == base else count
        some = random.choice(len(rows), wanted)
        places = np.stack([columns, rows], axis=1)[some] + random.uniform(-0.5, 0.5, (wanted, 2))
        points = on_ball(view.device, places)
        kept = lit(points) * np.linalg.norm(PROJECTOR.centre_mm - points, axis=1) ** 2 > 1.2 * MIN_COSINE
        parts.append(points[kept])
        pixels.append(places[kept])
    points, counts = np.concatenate(parts), [len(part) for part in parts]
    camera = np.repeat(np.arange(len(views), dtype=np.int32), counts)
    nowhere: NDArray[np.bool_] = np.zeros(len(points), dtype=np.bool_)
    by_all = (camera == base) & shared
    bits = np.where(by_all, (1 << len(views)) - 1, np.int64(1) << camera.astype(np.int64))
    return AlbedoSamples(points, normals_of(points), np.concatenate(pixels), camera, bits, nowhere)


def relative_error(found: Albedo, truth: FloatArray) -> float:
    """Rms, after one scale for all."""
    sound = np.isin(found.mark, SOUND)
    ratio = found.value[sound] / truth[sound]
    return float((ratio / np.median(ratio)).std())


@pytest.mark.parametrize("channels", [1, 3])
def test_albedo_matches_the_paint_of_the_ball(channels: int) -> None:
    view = seen_by(CAMERA, channels=channels)
    points = points_in(view)
    found = estimate_albedo(points, [view], PROJECTOR.centre_mm)
    assert found.value.shape == (len(points.camera), channels)
    assert (found.mark == AlbedoMark.NONE).all()
    # One scale for all channels: their ratios are colour.
    assert relative_error(found, tint(points.points_mm, channels)) < 0.003
    assert np.percentile(found.value.max(axis=1), BRIGHT_PERCENT) == pytest.approx(BRIGHT_ALBEDO, rel=1e-3)
    brightness = estimate_albedo(points, [view], None)
    assert relative_error(brightness, tint(points.points_mm, channels)) > 0.15
    assert (brightness.mark == AlbedoMark.SHADED).all()


def test_places_between_pixels_are_those_of_opencv() -> None:
    random = np.random.default_rng(2)
    image = random.random((40, 50, 2)).astype(np.float32)
    view = Illumination(CAMERA, image, random.random((40, 50)) > 0.9, np.ones((40, 50), np.bool_))
    # OpenCV knows places to a thirty-second of a pixel.
    places = random.integers(-20, 32 * 51, (3000, 2)) / 32
    seen, clipped = sample_contrast(view, places)
    maps = places.astype(np.float32)[:, None]
    expected = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(seen, expected[:, 0], atol=1e-6)
    share = cv2.remap(view.clipped.astype(np.float32), maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    assert np.array_equal(clipped, share.ravel() > 0)


@pytest.mark.parametrize("base", [0, 1])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_cameras_of_different_gain_come_to_one_scale_by_common_points(order: tuple[int, int], base: int) -> None:
    both = [seen_by(CAMERA), seen_by(OTHER_CAMERA, gain=3.7)]
    views = [both[index] for index in order]
    points = points_in(*views, base=base)
    found = estimate_albedo(points, views, PROJECTOR.centre_mm)
    expected = 1 / 3.7 if order == (0, 1) else 3.7
    assert found.gains.ravel() == pytest.approx([1, expected], rel=2e-3)
    assert found.shared[1] > 1000
    assert relative_error(found, tint(points.points_mm)) < 0.004


def test_cameras_that_see_nothing_in_common_come_to_the_same_median() -> None:
    views = [seen_by(CAMERA), seen_by(OTHER_CAMERA, gain=3.7)]
    points = points_in(*views, shared=False)
    found = estimate_albedo(points, views, PROJECTOR.centre_mm)
    assert found.shared == (0, 0)
    assert np.median(found.value[points.camera == 1]) == pytest.approx(np.median(found.value[points.camera == 0]))


def test_clipped_points_and_other_surfaces_do_not_count_for_the_gain() -> None:
    views = [seen_by(CAMERA), seen_by(OTHER_CAMERA, gain=2.0)]
    bright = views[1].contrast[..., 0] > np.percentile(views[1].contrast[views[1].decoded], 40)
    contrast = np.where(bright[..., None], np.float32(50), views[1].contrast)
    views[1] = replace(views[1], contrast=contrast, clipped=bright)
    points = points_in(*views)
    found = estimate_albedo(points, views, PROJECTOR.centre_mm)
    assert found.gains[1, 0] == pytest.approx(0.5, rel=5e-3)


def test_marks_name_the_first_cause() -> None:
    view = seen_by(CAMERA)
    points = points_in(view)
    clipped = np.zeros(SHAPE, dtype=np.bool_)
    # Of the four pixels that a point is read from, one is enough.
    left, above = np.floor(points.pixels_px[:3]).astype(int).T
    clipped[above + 1, left + 1] = True
    normals, border = points.normals.copy(), points.border.copy()
    normals[2:4] = np.nan
    towards = PROJECTOR.centre_mm - points.points_mm[4:6]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    aside = np.cross(towards, (0, 1, 0))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    cosines = np.array([[MIN_COSINE - 0.01], [-0.3]])
    normals[4:6] = cosines * towards + np.sqrt(1 - cosines**2) * aside
    border[[0, 5, 6]] = True
    found = estimate_albedo(
        replace(points, normals=normals, border=border), [replace(view, clipped=clipped)], PROJECTOR.centre_mm
    )
    names = [AlbedoMark(mark).name for mark in found.mark[:8].tolist()]
    assert names == ["SATURATED"] * 2 + ["UNKNOWN"] * 2 + ["GRAZING"] * 2 + ["BORDER", "NONE"]
    assert np.isnan(found.value[2:4]).all()
    assert np.isfinite(np.delete(found.value, (2, 3), axis=0)).all()
    # Flat light does not make a point as bright as it likes.
    seen = (
        sample_contrast(view, points.pixels_px[4:6])[0]
        * np.linalg.norm(PROJECTOR.centre_mm - points.points_mm[4:6], axis=1)[:, None] ** 2
    )
    assert found.value[4] / found.value[5] == pytest.approx(seen[0] / seen[1], rel=1e-5)


def test_the_scale_is_that_of_points_without_a_mark() -> None:
    view = seen_by(CAMERA)
    points = points_in(view)
    shining = np.zeros(SHAPE, dtype=np.bool_)
    shining[:, : SHAPE[1] // 2] = True
    bright = replace(
        view, contrast=view.contrast * np.where(shining, 40, 1).astype(np.float32)[..., None], clipped=shining
    )
    found = estimate_albedo(points, [bright], PROJECTOR.centre_mm)
    sound = found.value[found.mark == AlbedoMark.NONE]
    assert 500 < len(sound) < 0.8 * len(points.camera)
    assert np.percentile(sound, BRIGHT_PERCENT) == pytest.approx(BRIGHT_ALBEDO, rel=1e-3)


def test_a_scan_of_marked_points_or_of_none_has_a_scale_all_the_same() -> None:
    view = seen_by(CAMERA)
    points = points_in(view, count=50)
    found = estimate_albedo(points, [replace(view, clipped=np.ones(SHAPE, np.bool_))], PROJECTOR.centre_mm)
    assert (found.mark == AlbedoMark.SATURATED).all()
    assert np.isfinite(found.value).all()
    none = AlbedoSamples(*(getattr(points, name)[:0] for name in AlbedoSamples.__slots__))
    assert estimate_albedo(none, [view], PROJECTOR.centre_mm).value.shape == (0, 1)
    assert estimate_albedo(none, [view, view], None).value.shape == (0, 1)


def test_an_uneven_projector_is_corrected() -> None:
    view = seen_by(CAMERA)
    points = points_in(view)
    row = np.arange(SHAPE[0], dtype=np.float32)[:, None, None]
    uneven = replace(view, contrast=np.asarray(view.contrast * (1 + row / SHAPE[0]), dtype=np.float32))
    light = 1 + points.pixels_px[:, 1] / SHAPE[0]
    truth = tint(points.points_mm)
    assert relative_error(estimate_albedo(points, [uneven], PROJECTOR.centre_mm), truth) > 0.05
    assert relative_error(estimate_albedo(points, [uneven], PROJECTOR.centre_mm, light=light[:, None]), truth) < 0.003

"""Pictures whose content is known: where the mesh falls, how it is lit, what the legend shows."""

from __future__ import annotations

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from numba import config
from numpy.typing import NDArray

from slrig.errors import DamagedError, StorageError
from slrig.kernels import in_bands
from slrig.model import FloatArray, Mesh, Pinhole, Refusal, Size
from slrig.scan import pictures
from slrig.scan import pictures as placing
from slrig.scan import pictures as shading
from slrig.scan.pictures import (
    _CAUSES,
    Picture,
    described_causes,
    encode_png,
    placed_vertices,
    preview,
    rejection_picture,
    resampled,
    resized,
)
from slrig.scan.thumbnail import BACKDROP, encode_thumbnail
from tests.core import parametrize_core
from tests.unit.scan.test_mesh_formats import only

SIZE = Size(640, 480)
PANEL = Size(520, 390)
TOP = LEFT = 10


def camera(distortion: tuple[float, ...] = (0, 0, 0, 0, 0), size: Size = SIZE) -> Pinhole:
    """At the origin, looking along z, 500 px focal length."""
    matrix = np.array([[500, 0, (size.width_px - 1) / 2], [0, 500, (size.height_px - 1) / 2], [0, 0, 1]], dtype=float)
    return Pinhole(size, matrix, np.array(distortion, dtype=float), np.eye(3), np.zeros(3))


def patch(centre_mm: tuple[float, float, float], half_mm: float, *, slope: float = 0.0, turned: bool = False) -> Mesh:
    """A square of 20 x 20 cells, at `centre_mm`, z rising by `slope` per mm of x; its front towards the camera."""
    side = np.linspace(-half_mm, half_mm, 21)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    vertices = np.stack((x, y, slope * x), axis=1) + centre_mm
    index = np.arange(21 * 21, dtype=np.int32).reshape(21, 21)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    faces = np.concatenate((np.stack((a, c, b), 1), np.stack((b, c, d), 1)))
    normal = np.array((slope, 0.0, -1.0)) / np.hypot(slope, 1)
    return Mesh(
        vertices_mm=vertices.astype(np.float32),
        faces=np.ascontiguousarray(faces[:, ::-1]) if turned else faces,
        normals=np.tile(-normal if turned else normal, (len(x), 1)).astype(np.float32),
        colour=np.zeros((len(x), 3), dtype=np.uint8),
        mark=np.zeros(len(x), dtype=np.uint8),
        sigma_mm=np.zeros(len(x), dtype=np.float32),
        stripe=np.zeros(len(x), dtype=np.int32),
    )


def white(size: Size = SIZE) -> NDArray[np.uint8]:
    return np.full(size.shape, 200, dtype=np.uint8)


def panel(picture: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
    """The picture of one panel, without its caption."""
    left = LEFT + number * (PANEL.width_px + LEFT)
    return picture[TOP : TOP + PANEL.height_px, left : left + PANEL.width_px]


def covered(area: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where something else than backdrop is, the scale bar in the lower left corner left out."""
    found = (area != np.array(BACKDROP, dtype=np.uint8)).any(axis=2)
    found[-50:, :200] = False
    return np.asarray(found)


def bounds(mask: NDArray[np.bool_]) -> FloatArray:
    rows, columns = np.nonzero(mask)
    return np.array((columns.min(), rows.min(), columns.max(), rows.max()), dtype=np.float64)


def test_three_panels_of_sensible_width() -> None:
    picture = preview(patch((0, 0, 500), 100), camera(), white(), 255)
    assert picture.dtype == np.uint8
    assert picture.shape[1] == 3 * PANEL.width_px + 4 * LEFT <= 1600
    assert (panel(picture, 0) == 200).all()


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), (-0.4, 0.1, 0.002, 0.001, 0.0)])
def test_the_mesh_lies_where_the_camera_sees_it(distortion: tuple[float, ...]) -> None:
    mesh, seen_by = patch((60, 40, 500), 80), camera(distortion)
    rays = mesh.vertices_mm[:, :2] / mesh.vertices_mm[:, 2:]
    k1, k2, p1, p2, _ = distortion
    square = (rays**2).sum(axis=1)
    x, y = rays.T
    lens = (1 + k1 * square + k2 * square**2)[:, None] * rays
    lens += np.stack((2 * p1 * x * y + p2 * (square + 2 * x**2), p1 * (square + 2 * y**2) + 2 * p2 * x * y), axis=1)
    pixels = lens * 500 + (319.5, 239.5)
    scale = PANEL.width_px / SIZE.width_px
    expected = (np.concatenate((pixels.min(axis=0), pixels.max(axis=0))) + 0.5) * scale - 0.5
    found = bounds(covered(panel(preview(mesh, seen_by, white(), 255), 1)))
    assert found == pytest.approx(expected, abs=1.0)


def test_a_thumbnail_shows_the_turned_mesh_alone_as_large_as_it_fits() -> None:
    shown = preview(patch((60, 40, 500), 80), camera(), white(), 255)
    small = cv2.imdecode(np.frombuffer(encode_thumbnail(encode_png(shown)), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert small is not None
    assert small.shape == (240, 320, 3)
    left, top, right, bottom = bounds((small != BACKDROP).any(axis=2))
    assert max((bottom - top + 1) / 240, (right - left + 1) / 320) == pytest.approx(0.86, abs=0.005)
    assert (left + right, top + bottom) == pytest.approx((319, 239), abs=1)
    # Neither letters nor scale, which are brighter than the mesh.
    turned = panel(shown, 2)
    redder = turned[..., 2] > turned[..., 0]
    assert small.max() <= turned[redder].max()
    with pytest.raises(DamagedError, match=r"preview\.png"):
        encode_thumbnail(b"not a picture")


def joined(first: Mesh, second: Mesh) -> Mesh:
    parts = {each.name: [getattr(first, each.name), getattr(second, each.name)] for each in fields(Mesh)}
    parts["faces"][1] = parts["faces"][1] + np.int32(len(first.vertices_mm))
    return Mesh(**{name: np.concatenate(pair) for name, pair in parts.items()})


def test_light_falls_from_the_side_to_which_the_surface_leans() -> None:
    def brightness(mesh: Mesh) -> FloatArray:
        area = panel(preview(mesh, camera(), white(), 255), 1)
        return np.array((area[190:200, 175:185].mean(), area[190:200, 335:345].mean()))

    # A roof: a large half leans to one side (normal x has the sign of the slope), a small one to the other.
    large_left = joined(patch((-100, 0, 500), 90, slope=-0.5), patch((100, 0, 500), 50, slope=0.5))
    large_right = joined(patch((100, 0, 500), 90, slope=0.5), patch((-100, 0, 500), 50, slope=-0.5))
    left, right = brightness(large_left)
    assert left > right + 20
    assert brightness(large_right) == pytest.approx((right, left), abs=1)


def test_backs_are_red() -> None:
    def middle(*, turned: bool) -> NDArray[np.float64]:
        area = panel(preview(patch((0, 0, 500), 60, turned=turned), camera(), white(), 255), 1)
        return np.asarray(area[190:200, 255:265].reshape(-1, 3).mean(axis=0))

    blue, green, red = middle(turned=True)
    assert red > 1.5 * green
    assert red > 1.5 * blue
    blue, green, red = middle(turned=False)
    assert red < 1.2 * green


def test_the_turned_view_shows_depth_that_the_camera_cannot_see() -> None:
    near, far = patch((0, 0, 500), 40), patch((0, 0, 560), 20)
    both = joined(near, far)
    alone = preview(near, camera(), white(), 255)
    together = preview(both, camera(), white(), 255)
    assert np.array_equal(covered(panel(alone, 1)), covered(panel(together, 1)))
    assert not np.array_equal(covered(panel(alone, 2)), covered(panel(together, 2)))


def test_stray_vertices_do_not_move_the_turned_view() -> None:
    mesh = patch((0, 0, 500), 40)
    stray = np.array([[4000, 4000, 600], [4000, 4001, 600], [4001, 4000, 600]], dtype=np.float32)
    spoilt = joined(mesh, replace(only(mesh, 3), vertices_mm=stray, faces=np.array([[0, 1, 2]], dtype=np.int32)))
    one = bounds(covered(panel(preview(mesh, camera(), white(), 255), 2)))
    other = bounds(covered(panel(preview(spoilt, camera(), white(), 255), 2)))
    assert other == pytest.approx(one, abs=2)


def test_vertices_behind_the_camera_do_no_harm() -> None:
    mesh = patch((0, 0, 500), 60)
    behind = preview(joined(mesh, patch((0, 0, -20), 5)), camera(), white(), 255)
    assert np.array_equal(panel(behind, 1), panel(preview(mesh, camera(), white(), 255), 1))
    # Nor if all are: there is nothing to see, and no length that a bar could show.
    nothing = preview(patch((0, 0, -500), 60), camera(), white(), 255)
    assert (panel(nothing, 1) == BACKDROP).all()
    # Nor if no triangle has an area.
    assert not covered(panel(preview(patch((0, 0, 500), 0), camera(), white(), 255), 1)).any()


@pytest.mark.parametrize("sampled", [100, 101])
def test_a_sample_of_the_triangles_shows_the_same_view(monkeypatch: pytest.MonkeyPatch, sampled: int) -> None:
    # 800 triangles in rows of 20: every eighth of them would always be one of the same few columns.
    mesh = patch((60, 40, 500), 80, slope=0.3)
    whole = preview(mesh, camera(), white(), 255)
    monkeypatch.setattr(pictures, "_SAMPLED", sampled)
    some = preview(mesh, camera(), white(), 255)
    assert np.array_equal(panel(some, 1)[:-50], panel(whole, 1)[:-50])
    assert bounds(covered(panel(some, 2))) == pytest.approx(bounds(covered(panel(whole, 2))), abs=8)


def test_a_dark_white_image_is_brightened_and_a_deep_one_scaled() -> None:
    mesh = patch((0, 0, 500), 60)
    deep = np.full(SIZE.shape, 2048, dtype=np.uint16)
    assert panel(preview(mesh, camera(), deep, 2047), 0).min() == 255
    dark = panel(preview(mesh, camera(), np.full(SIZE.shape, 51, dtype=np.uint8), 255), 0)
    assert np.abs(dark - 0.9 * 255).max() <= 1
    # No light at all: nothing to divide by, and black stays black.
    assert panel(preview(mesh, camera(), np.zeros(SIZE.shape, dtype=np.uint8), 255), 0).max() == 0


def test_a_mesh_without_triangles_gives_two_panels() -> None:
    none = only(patch((0, 0, 500), 60), 0)
    picture = preview(none, camera(), white(), 255)
    assert picture.shape[1] == 2 * PANEL.width_px + 3 * LEFT
    assert not covered(panel(picture, 1)).any()


@pytest.mark.parametrize("size", [Size(64, 48), Size(300, 4000), Size(5000, 800)])
def test_odd_cameras_give_a_picture_too(size: Size) -> None:
    picture = preview(patch((0, 0, 500), 20), camera(size=size), white(size), 255)
    assert picture.shape[1] <= 1600
    assert picture.shape[0] <= 700


def test_every_cause_has_a_colour_of_its_own() -> None:
    assert set(_CAUSES) == set(Refusal)
    assert len({colour for colour, _ in _CAUSES.values()}) == len(Refusal)
    described = described_causes()
    assert [described[cause]["name"].upper() for cause in Refusal] == [cause.name for cause in Refusal]
    assert len({described[cause]["words"] for cause in Refusal}) == len(Refusal)


def test_refused_pixels_have_their_cause_in_colour_and_legend() -> None:
    refusals = np.zeros((800, 800), dtype=np.uint8)
    for cause in Refusal:
        refusals[40 * cause : 40 * cause + 30, 100:300] = cause
    picture = rejection_picture(refusals, np.full((800, 800), 180, dtype=np.uint8), 255)
    legend = picture[:, 800:]
    for cause in Refusal:
        swatch = (legend == np.array(_CAUSES[cause][0], dtype=np.uint8)).all(axis=2)
        assert swatch.sum() >= 100, cause.name
        if cause is not Refusal.NONE:
            assert tuple(picture[40 * cause + 20, 200]) == _CAUSES[cause][0]
    assert tuple(picture[799, 799]) == (180, 180, 180)
    # The legend has the counts.
    few, many = np.zeros((500, 500), dtype=np.uint8), np.full((500, 500), Refusal.SATURATED, dtype=np.uint8)
    few[0, 0] = Refusal.SATURATED
    assert not np.array_equal(rejection_picture(few)[:, 500:], rejection_picture(many)[:, 500:])


@parametrize_core("shape", [(12, 16), (1024, 1280), (3000, 4096), (40, 3000)])
def test_a_rejection_picture_of_any_camera_is_legible(shape: tuple[int, int]) -> None:
    picture = rejection_picture(np.full(shape, Refusal.SHADOW_EDGE, dtype=np.uint8))
    assert 330 < picture.shape[1] <= 1600
    assert picture.shape[0] >= 30 * len(Refusal)
    assert tuple(picture[0, 0]) == _CAUSES[Refusal.SHADOW_EDGE][0]


def test_a_png_is_read_back_as_it_was_or_cannot_be_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    found = cv2.imdecode(np.frombuffer(encode_png(picture), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(np.asarray(found), picture)
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(StorageError, match="could not encode"):
        encode_png(picture)


# The light on a mesh, against the same in plain numpy

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


# Where vertices fall, against OpenCV's own projection

ROTATION = np.asarray(cv2.Rodrigues(np.array((0.1, -0.2, 0.05)))[0], dtype=np.float64)
TURNED = Pinhole(
    Size(640, 480),
    np.array([[500, 0.0, 310], [0, 510, 250], [0, 0, 1]], dtype=np.float64),
    np.array((-0.2, 0.06, 0.001, -0.002, 0.01)),
    ROTATION,
    np.array((10.0, -20.0, 30.0)),
)
POINTS = np.random.default_rng(3).uniform((-100, -100, 300), (100, 100, 500), (1000, 3)).astype(np.float32)


@pytest.mark.parametrize("at_once", [64, 10_000])
@pytest.mark.parametrize("per_px", [2.0, 0.4])
def test_vertices_fall_where_opencv_has_them(monkeypatch: pytest.MonkeyPatch, at_once: int, per_px: float) -> None:
    monkeypatch.setattr(placing, "_AT_ONCE", at_once)
    pixels, _ = cv2.projectPoints(
        POINTS.astype(np.float64), cv2.Rodrigues(ROTATION)[0], TURNED.translation_mm, TURNED.matrix, TURNED.distortion
    )
    device = resampled(TURNED, per_px, Size(round(640 * per_px), round(480 * per_px)))
    placed = placed_vertices(POINTS, device)
    # The left border of the first pixel, at -0.5, is one place in both.
    assert placed[:, :2] == pytest.approx((pixels.reshape(-1, 2) + 0.5) * per_px - 0.5, abs=1e-3)
    assert placed[:, 2] == pytest.approx((POINTS @ ROTATION.T + TURNED.translation_mm)[:, 2], rel=1e-6)
    assert placed.dtype == np.float32


def test_a_point_behind_the_camera_has_no_pixel_and_no_depth_before_it() -> None:
    behind = (np.array([[0.0, 0.0, -50.0]]) - TURNED.translation_mm) @ ROTATION
    (column, row, depth), *others = placed_vertices(behind, TURNED)
    assert not others
    assert np.isnan((column, row)).all()
    assert depth == pytest.approx(-50)
    assert placed_vertices(behind[:0], TURNED).shape == (0, 3)

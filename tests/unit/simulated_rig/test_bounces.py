"""Light by way of two surfaces, against form factors, a sphere's inside and images in a mirror."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from simulated_rig.bounces import Bounces, Interreflection, MirrorPaths
from simulated_rig.device import SimulatedHead
from simulated_rig.light import LightTable, light_table, radiance
from simulated_rig.optics import image_positions
from simulated_rig.scene import rotation_matrix
from slrig.errors import ConfigError
from slrig.model import FloatArray, Pinhole, Pixels
from tests.unit.simulated_rig.building import FACING_PLATE, line_profile, small_head

ALBEDO = 0.6
WHITE = np.full((1, 1), 255, np.uint8)
# From so far that the light is parallel and even, over a square of 120 mm.
SUN = {"size_px": [240, 240], "focal_px": [2e5, 2e5], "position_mm": [0.0, 0.0, -1e5], "leak": 0.0}

# Kernels of scattered light, which few scenes need, take seconds to compile.
pytestmark = pytest.mark.slow


def groove(opening_deg: float, **more: Any) -> str:
    options = {"opening_deg": opening_deg, "wall_mm": 40.0, "length_mm": 60.0, "albedo": ALBEDO, **more}
    lines = (f"{key} = {value}" for key, value in options.items())
    return "\n".join(["interreflection = true", "[[object]]", 'shape = "groove"', *lines])


def bounces_of(head: SimulatedHead) -> Bounces:
    view = head._views["eye"]
    view.prepare()
    assert view._cache.bounces is not None
    return view._cache.bounces


def scattered(head: SimulatedHead) -> Interreflection:
    found = bounces_of(head).scattered
    assert found is not None
    return found


def mirrored(head: SimulatedHead) -> MirrorPaths:
    found = bounces_of(head).mirrored
    assert found is not None
    return found


def lamp_of(head: SimulatedHead) -> Pinhole:
    lamp = head.exact_calibration.projector
    assert lamp is not None
    return lamp


def table(head: SimulatedHead, profile: Pixels) -> LightTable:
    return light_table(profile, head.projector.info.size, head._projector._response)


def seen_points(head: SimulatedHead) -> FloatArray:
    """(H, W, 3): points at the pixel centres, NaN where there are none."""
    camera, depth = head.exact_calibration.cameras["eye"], head.truth().cameras["eye"].depth_mm
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    at = np.stack([(u - camera.matrix[0, 2]) / camera.matrix[0, 0], (v - camera.matrix[1, 2]) / camera.matrix[1, 1]], 2)
    rays = np.dstack([at, np.ones(depth.shape)]) * depth[:, :, None]
    return np.asarray((rays - camera.translation_mm) @ camera.rotation)


def form_factor(point: FloatArray, normal: FloatArray, corners: Sequence[FloatArray]) -> float:
    """From a point to a polygon that is wholly above its horizon (Lambert 1760)."""
    total = np.zeros(3)
    for here, there in zip(corners, [*corners[1:], corners[0]], strict=True):
        a, b = ((each - point) / np.linalg.norm(each - point) for each in (here, there))
        across = np.cross(a, b)
        total += np.arccos(np.clip(a @ b, -1, 1)) * across / np.linalg.norm(across)
    return float(abs(normal @ total) / (2 * np.pi))


@pytest.mark.parametrize("opening_deg", [60.0, 90.0, 130.0])
def test_walls_of_a_groove_light_each_other_by_their_form_factor(tmp_path: Path, opening_deg: float) -> None:
    head = small_head(tmp_path, groove(opening_deg), projector=SUN)
    light = scattered(head).irradiance(table(head, WHITE))
    half = np.deg2rad(opening_deg / 2)
    rim_x, rim_z = 40 * np.sin(half), -40 * np.cos(half)
    points = seen_points(head)
    checked = 0
    for row, column in np.argwhere(np.isfinite(points[:, :, 0]))[::17]:
        point = points[row, column]
        # The edges of the projector's pixels do not follow the edge of the groove.
        if not 2 < abs(point[0]) < rim_x - 1 or abs(point[1]) > 26:
            continue
        own = np.sign(point[0])
        normal = np.array([-own * np.cos(half), 0, -np.sin(half)])
        other = [
            np.array(each) for each in ((0, -30, 0), (0, 30, 0), (-own * rim_x, 30, rim_z), (-own * rim_x, -30, rim_z))
        ]
        expected = ALBEDO * np.sin(half) * form_factor(point, normal, other)
        assert light[row, column] == pytest.approx(expected, rel=0.025)
        checked += 1
    assert checked > 30


def test_scattered_light_is_even_inside_a_sphere(tmp_path: Path) -> None:
    bowl = (
        "interreflection = true\n[[object]]\nshape = 'bowl'\nradius_mm = 40.0\nhalf_angle_deg = 70.0\n"
        f"albedo = {ALBEDO}\n"
    )
    head = small_head(tmp_path, bowl, projector=SUN)
    light = scattered(head).irradiance(table(head, WHITE))
    inside = np.isfinite(seen_points(head)[:, :, 0])
    # All patches of a sphere have the form factor dA / (4 π R²), from everywhere inside.
    np.testing.assert_allclose(light[inside], ALBEDO * np.sin(np.deg2rad(70)) ** 2 / 4, rtol=0.015)
    assert not light[~inside].any()


def test_scattered_light_is_the_sum_over_a_pattern(tmp_path: Path) -> None:
    head = small_head(tmp_path, groove(80.0, rotation_deg="[10.0, 5.0, 25.0]"), projector={"leak": 0.0})
    found, size = scattered(head), head.projector.info.size
    whole = found.irradiance(table(head, WHITE))
    lines = [found.irradiance(table(head, line_profile(size, shift))) for shift in range(8)]
    np.testing.assert_allclose(np.sum(lines, axis=0), whole, rtol=1e-4, atol=1e-6)
    upper = np.where(np.arange(size.height_px) < 20, 255, 0).astype(np.uint8)[:, None]
    halves = [found.irradiance(table(head, each)) for each in (upper, 255 - upper)]
    np.testing.assert_allclose(np.sum(halves, axis=0), whole, rtol=1e-4, atol=1e-6)
    assert (halves[0] != halves[1]).any()


def test_no_wall_scatters_more_than_it_receives(tmp_path: Path) -> None:
    head = small_head(tmp_path, groove(25.0, albedo=1.0), projector=SUN)
    light = scattered(head).irradiance(table(head, WHITE))
    assert 0.1 < light.max() / np.sin(np.deg2rad(12.5)) < 1


def test_a_screen_between_two_walls_keeps_their_light_apart(tmp_path: Path) -> None:
    screen = (
        "\n[[object]]\nshape = 'plane'\nsize_mm = [60.0, 80.0]\nrotation_deg = [0.0, 90.0, 0.0]\n"
        "position_mm = [0.0, 0.0, -30.05]\nalbedo = 0.001\n"
    )
    apart, open_ = (
        scattered(head).irradiance(table(head, WHITE))
        for head in (small_head(tmp_path, groove(90.0) + more, projector=SUN) for more in (screen, ""))
    )
    left = seen_points(small_head(tmp_path, groove(90.0), projector=SUN))[:, :, 0] < -12
    # Blocks of pixels that lie on both walls count as visible.
    assert apart[left].mean() < 0.05 * open_[left].mean()


TILT_DEG = 55.0
MIRROR_MM = np.array([30.0, 0.0, -12.0])
MIRROR_NORMAL = rotation_matrix((0.0, TILT_DEG, 0.0)) @ (0, 0, -1.0)


def beside_mirror(roughness: float = 0.0) -> str:
    """A plate, and at its right a mirror that faces it."""
    return FACING_PLATE + (
        f"[[object]]\nshape = 'plane'\nsize_mm = [30.0, 50.0]\nrotation_deg = [0.0, {TILT_DEG}, 0.0]\nalbedo = 0.001\n"
        f"position_mm = {MIRROR_MM.tolist()}\nmirror = {{ share = 0.9, roughness = {roughness} }}\n"
    )


def reflected(point: FloatArray) -> FloatArray:
    """Mirror image of points, (..., 3)."""
    return np.asarray(point - 2 * ((point - MIRROR_MM) @ MIRROR_NORMAL)[..., None] * MIRROR_NORMAL)


Paths = tuple[FloatArray, FloatArray, NDArray[np.float32]]


def paths_at(head: SimulatedHead) -> tuple[Paths, Paths]:
    """(points, column and row, weight) of paths at pixels that show the mirror, and at those that show the plate."""
    paths, points = mirrored(head), seen_points(head).reshape(-1, 3)[mirrored(head).pixel]
    position = np.column_stack([paths.column_px, paths.row_px])
    on_mirror = np.abs((points - MIRROR_MM) @ MIRROR_NORMAL) < 1e-6
    return (points[on_mirror], position[on_mirror], paths.weight[on_mirror]), (
        points[~on_mirror],
        position[~on_mirror],
        paths.weight[~on_mirror],
    )


def test_a_mirror_shows_points_where_their_images_are(tmp_path: Path) -> None:
    head = small_head(tmp_path, beside_mirror(), samples_per_axis=1)
    (points, position, weight), _ = paths_at(head)
    assert len(points) > 100
    # The eye's mirror image looks straight through the mirror at the plate.
    eye, lamp = reflected(head.exact_calibration.cameras["eye"].centre_mm), lamp_of(head).centre_mm
    shown = eye + (points - eye) * (eye[2] / (eye[2] - points[:, 2]))[:, None]
    np.testing.assert_allclose(position, image_positions(shown, lamp_of(head)), atol=1e-3)
    distance = np.linalg.norm(shown - lamp, axis=1)
    np.testing.assert_allclose(weight, 0.9 * 0.8 * (500 / distance) * (np.hypot(60, 500) / distance) ** 2, rtol=1e-4)


def test_a_mirror_lights_points_from_the_image_of_the_projector(tmp_path: Path) -> None:
    head = small_head(tmp_path, beside_mirror(), samples_per_axis=1)
    _, (points, position, weight) = paths_at(head)
    assert len(points) > 100
    projector = lamp_of(head)
    # The light that would reach a point's mirror image, were there no mirror.
    np.testing.assert_allclose(position, image_positions(reflected(points), projector), atol=1e-3)
    to_point = points - reflected(projector.centre_mm)
    distance = np.linalg.norm(to_point, axis=1)
    expected = 0.9 * 0.8 * (to_point[:, 2] / distance) * (np.hypot(60, 500) / distance) ** 2
    np.testing.assert_allclose(weight, expected, rtol=1e-4)


def test_a_rough_mirror_spreads_lines_and_keeps_their_light(tmp_path: Path) -> None:
    shifts = []
    for roughness in (0.0, 0.03):
        head = small_head(tmp_path, beside_mirror(roughness), projector={"leak": 0.0}, samples_per_axis=1)
        images = np.zeros((8, 48, 64), np.float32)
        for shift, image in enumerate(images):
            mirrored(head).add_to(image, table(head, line_profile(head.projector.info.size, shift)))
        shifts.append(images)
    sharp, soft = shifts
    lit = (sharp.sum(axis=0) > 0) & (np.arange(64) > 32)
    assert np.median(soft.sum(axis=0)[lit] / sharp.sum(axis=0)[lit]) == pytest.approx(1, abs=0.02)
    assert np.median(soft.std(axis=0)[lit] / sharp.std(axis=0)[lit]) < 0.5


@pytest.mark.parametrize("kind", ["seen", "lit"])
def test_the_spread_of_a_rough_mirror_is_that_of_tilted_ones(tmp_path: Path, kind: str) -> None:
    """The same pixels, with the mirror turned about the point that a ray meets, by the standard deviation of slopes."""
    head = small_head(tmp_path, beside_mirror(1e-3), samples_per_axis=1)
    paths, projector = mirrored(head), lamp_of(head)
    on_mirror = np.abs((seen_points(head).reshape(-1, 3)[paths.pixel] - MIRROR_MM) @ MIRROR_NORMAL) < 1e-6
    index = np.flatnonzero(on_mirror if kind == "seen" else ~on_mirror)[::7]
    points = seen_points(head).reshape(-1, 3)[paths.pixel[index]]
    eye, lamp = head.exact_calibration.cameras["eye"].centre_mm, projector.centre_mm
    image = reflected(lamp)
    height = (points - MIRROR_MM) @ MIRROR_NORMAL
    met = (
        points
        if kind == "seen"
        else points + (image - points) * (height / (height - (image - MIRROR_MM) @ MIRROR_NORMAL))[:, None]
    )
    squares = np.zeros((len(index), 2))
    for axis in (np.array([0.0, 1.0, 0.0]), np.cross(MIRROR_NORMAL, (0.0, 1.0, 0.0))):
        positions = []
        for slope in (-1e-3, 1e-3):
            normal = MIRROR_NORMAL + slope * axis
            normal /= np.linalg.norm(normal)
            if kind == "seen":
                ray = points - eye
                ray = ray - 2 * (ray @ normal)[:, None] * normal
                positions.append(image_positions(points - ray * (points[:, 2] / ray[:, 2])[:, None], projector))
            else:
                turned = lamp - 2 * ((lamp - met) @ normal)[:, None] * normal
                height_there = (turned - MIRROR_MM) @ MIRROR_NORMAL
                there = points + (turned - points) * (height / (height - height_there))[:, None]
                positions.append(image_positions(there, projector))
        squares = squares + ((positions[1] - positions[0]) / 2) ** 2
    # Spreads below 1 px are levels themselves.
    found = np.column_stack([paths.column_level, paths.row_level])[index]
    assert found.max() < 1
    np.testing.assert_allclose(found, np.sqrt(squares), rtol=0.02, atol=1e-4)


def test_light_that_bounces_leaves_the_direct_light_as_it_is(tmp_path: Path) -> None:
    plain = groove(90.0).replace("interreflection = true\n", "")
    metal = groove(90.0, mirror="{ share = 0.3, roughness = 0.1 }")
    paths, views = [], []
    for scene in (plain, metal):
        view = small_head(tmp_path, scene)._views["eye"]
        paths.append(view.prepare())
        views.append(view)
    for name in ("column_px", "row_px", "weight", "albedo"):
        np.testing.assert_array_equal(*(getattr(each, name) for each in paths))
    assert views[0]._cache.bounces is None
    head = small_head(tmp_path, metal)
    light = table(head, WHITE)
    direct = radiance(paths[1], light, blur_px=0.0)
    np.testing.assert_array_equal(views[0].image([(1.0, light)]), direct)
    whole = views[1].image([(1.0, light)])
    assert (whole >= direct - 1e-6).all()
    assert whole.mean() > 1.1 * direct.mean()


def test_what_reflects_more_than_it_receives_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"albedo and mirror.share together must not exceed 1, found 0.6 and 0.5"):
        small_head(tmp_path, groove(90.0, mirror="{ share = 0.5 }"))

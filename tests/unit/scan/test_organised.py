"""The surface in a camera's grid, against every triangle tried at every pixel in plain numpy, and OpenCV's lens."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numba import config
from numpy.typing import NDArray

from slrig.model import FloatArray, Mesh, Pinhole, Refusal, Size
from slrig.scan import clouds as module
from slrig.scan.clouds import OrganisedCloud, encode_depth_tiff, encode_npz, encode_pcd, organised
from slrig.scan.pictures import described_causes
from tests.core import parametrize_core

SIZE = Size(48, 40)
CAUSES = [each["name"] for each in described_causes()]
BARREL = (-0.35, 0.12, 0.004, -0.003, 0.01)
LENSES = [(0.0,) * 5, BARREL, (0.25, 0.05, -0.002, 0.001, 0.0)]


def camera(lens: tuple[float, ...] = BARREL, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Pinhole:
    """A camera of a wide view; turned about the middle of what lies 300 mm before one that is not."""
    rotation = np.asarray(cv2.Rodrigues(np.array(turn, dtype=np.float64))[0])
    pivot = np.array([0.0, 0.0, 300.0])
    matrix = np.array([[52.0, 0.3, 24.1], [0, 50.0, 19.3], [0, 0, 1]])
    return Pinhole(SIZE, matrix, np.array(lens), rotation, pivot - rotation @ pivot)


def mesh_of(corners_mm: FloatArray, seed: int = 1) -> Mesh:
    """Triangles, (n, 3, 3), that share no vertex, with whatever else a mesh has."""
    random, count = np.random.default_rng(seed), 3 * len(corners_mm)
    normals = random.normal(size=(count, 3))
    return Mesh(
        vertices_mm=corners_mm.reshape(-1, 3).astype(np.float32),
        faces=np.arange(count, dtype=np.int32).reshape(-1, 3),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        colour=random.integers(0, 256, (count, 3), dtype=np.uint8),
        mark=random.integers(0, 6, count, dtype=np.uint8),
        sigma_mm=random.uniform(0.01, 0.1, count).astype(np.float32),
        stripe=np.zeros(count, dtype=np.int32),
    )


def random_mesh(count: int = 80, seed: int = 4) -> Mesh:
    """Triangles small and large that pass through one another, some of them beside the picture."""
    random = np.random.default_rng(seed)
    middles = random.uniform((-160, -130, 220), (160, 130, 380), (count, 3))
    return mesh_of(middles[:, None] + random.normal(size=(count, 3, 3)) * random.choice([4, 60], count)[:, None, None])


def plain_rays(device: Pinhole) -> FloatArray:
    """(H * W, 3): world directions of depth 1 through pixel centres, by OpenCV's lens."""
    rows, columns = np.mgrid[: device.size.height_px, : device.size.width_px].astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    # OpenCV knows no skew: columns are freed of it first.
    m = device.matrix
    upright = columns - m[0, 1] * (rows - m[1, 2]) / m[1, 1]
    straight = np.array([[m[0, 0], 0, m[0, 2]], [0, m[1, 1], m[1, 2]], [0, 0, 1]])
    pixels = np.stack((upright.ravel(), rows.ravel()), axis=1)[:, None]
    x, y = cv2.undistortPoints(pixels, straight, device.distortion, criteria=criteria)[:, 0].T
    return np.asarray(np.stack((x, y, np.ones_like(x)), axis=1) @ device.rotation)


def plain_cloud(mesh: Mesh, device: Pinhole, refused: NDArray[np.uint8]) -> dict[str, FloatArray]:
    """The arrays of the cloud, each triangle tried at each pixel (Möller and Trumbore 1997)."""
    directions, origin = plain_rays(device), device.centre_mm
    count = len(directions)
    nearest, which, weights = np.full(count, np.inf), np.full(count, -1), np.full((count, 3), np.nan)
    for number, face in enumerate(mesh.faces):
        a, b, c = mesh.vertices_mm[face].astype(np.float64)
        across = np.cross(directions, c - a)
        share = 1 / (across @ (b - a))
        u = across @ (origin - a) * share
        turned = np.cross(origin - a, b - a)
        v, depth = directions @ turned * share, (c - a) @ turned * share
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0) & (depth < nearest)
        nearest[met], which[met] = depth[met], number
        weights[met] = np.stack((1 - u - v, u, v), axis=1)[met]
    cause = np.where(refused.ravel() != 0, refused.ravel(), np.where(which < 0, int(Refusal.NO_SURFACE), 0))
    weights[cause != 0] = np.nan
    corners = mesh.faces[which]
    normals = np.einsum("nk,nkc->nc", weights, mesh.normals[corners].astype(np.float64))
    colour = np.einsum("nk,nkc->nc", weights, mesh.colour[corners].astype(np.float64))
    with np.errstate(invalid="ignore"):
        largest = np.where(cause == 0, weights.argmax(axis=1), 0)
    return {
        "points_mm": np.einsum("nk,nkc->nc", weights, mesh.vertices_mm[corners].astype(np.float64)),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
        "sigma_mm": (weights * mesh.sigma_mm[corners]).sum(axis=1),
        "colour": np.where(np.isnan(colour), 0, colour),
        "mark": np.where(cause == 0, mesh.mark[corners[np.arange(count), largest]], 0),
        "cause": cause,
    }


def check_against_plain(cloud: OrganisedCloud, expected: dict[str, FloatArray]) -> None:
    np.testing.assert_array_equal(cloud.cause.ravel(), expected["cause"])
    for name, accuracy in {"points_mm": 1e-4, "normals": 1e-5, "sigma_mm": 1e-7, "colour": 0.5001, "mark": 0}.items():
        found = getattr(cloud, name)
        np.testing.assert_allclose(
            found.reshape(expected[name].shape).astype(np.float64), expected[name], rtol=0, atol=accuracy, err_msg=name
        )
    for name in ("points_mm", "normals", "sigma_mm"):
        finite = np.isfinite(getattr(cloud, name)).reshape(*SIZE.shape, -1)
        assert (finite == (cloud.cause == 0)[..., None]).all(), name


@parametrize_core("threads", [1, 2], core=[1])
@parametrize_core("turn", [(0.0, 0.0, 0.0), (0.2, -0.5, 0.1)], ids=["ahead", "turned"], core=[1])
@pytest.mark.parametrize("lens", LENSES, ids=["ideal", "barrel", "pincushion"])
def test_a_pixel_has_the_point_of_the_nearest_triangle_on_its_ray(
    monkeypatch: pytest.MonkeyPatch, lens: tuple[float, ...], turn: tuple[float, float, float], threads: int
) -> None:
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    for name in ("_FACES_AT_LEAST", "_ROWS_AT_LEAST"):
        monkeypatch.setattr(module, name, 1)
    mesh, device = random_mesh(), camera(lens, turn)
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    refused[5:15, 10:40] = Refusal.SATURATED
    cloud = organised(mesh, "left", device, refused, CAUSES)
    assert 0.3 < (cloud.cause == 0).mean() < 0.95
    check_against_plain(cloud, plain_cloud(mesh, device, refused))


@pytest.mark.parametrize("side", [1, -1])
def test_what_one_camera_sees_may_hide_from_another(side: int) -> None:
    """A large wall, and a small screen before it, whose edges are bent by the lens."""
    wall = [
        [[-900, -900, 400], [900, -900, 400], [-900, 900, 400]],
        [[900, 900, 400], [-900, 900, 400], [900, -900, 400]],
    ]
    screen = [[[-30, -40, 300], [30, -40, 300], [0, 50, 300]]]
    mesh = mesh_of(np.array(wall + screen, dtype=np.float64))
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    clouds = [organised(mesh, "left", camera(turn=(0.0, turn, 0.0)), refused, CAUSES) for turn in (0.0, side * 0.4)]
    for cloud in clouds:
        check_against_plain(cloud, plain_cloud(mesh, cloud.device, refused))
        assert (cloud.cause == 0).all()
    hidden = [cloud.points_mm[np.isclose(cloud.points_mm[..., 2], 300)] for cloud in clouds]
    assert all(len(points) > 30 for points in hidden)
    # The screen hides another part of the wall.
    walls = [cloud.points_mm[..., 0][np.isclose(cloud.points_mm[..., 2], 400, atol=0.01)] for cloud in clouds]
    assert abs(np.histogram(walls[0], 20, (-100, 100))[0] - np.histogram(walls[1], 20, (-100, 100))[0]).max() > 3


def test_a_hole_is_told_apart_from_what_the_camera_refused() -> None:
    mesh = mesh_of(np.array([[[-200.0, -200, 300], [200, -200, 300], [-200, 200, 300]]]))
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    refused[:, :4] = Refusal.NOT_LIT
    cloud = organised(mesh, "left", camera(), refused, CAUSES)
    assert cloud.causes == tuple(CAUSES)
    assert set(np.unique(cloud.cause[:, :4])) == {Refusal.NOT_LIT}
    assert {cloud.causes[number] for number in np.unique(cloud.cause[:, 4:])} == {"none", "no_surface"}


def test_what_lies_behind_or_beside_the_camera_is_not_met() -> None:
    around = np.array(
        [[[-200.0, -200, 300], [200, -200, 300], [0, 100, -50]], [[1e-3, 0, 1e-12], [900, 5, 1e-9], [0, 9, 1]]]
    )
    mesh = mesh_of(around)
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    cloud = organised(mesh, "left", camera(), refused, CAUSES)
    only = mesh_of(around[1:])
    assert (organised(only, "left", camera(), refused, CAUSES).cause == cloud.cause).all()
    empty = mesh_of(np.zeros((0, 3, 3)))
    assert (organised(empty, "left", camera(), refused, CAUSES).cause == int(Refusal.NO_SURFACE)).all()


def test_a_normal_that_is_not_known_stays_unknown() -> None:
    mesh = mesh_of(np.array([[[-900.0, -900, 300], [900, -900, 300], [0, 900, 300]]]))
    mesh.normals[0] = np.nan
    cloud = organised(mesh, "left", camera(), np.zeros(SIZE.shape, dtype=np.uint8), CAUSES)
    met = cloud.cause == 0
    assert met.any()
    assert np.isfinite(cloud.points_mm[met]).all()
    assert np.isnan(cloud.normals).all()


def test_a_cloud_without_points_has_its_files_all_the_same() -> None:
    cloud = organised(mesh_of(np.zeros((0, 3, 3))), "left", camera(), np.zeros(SIZE.shape, dtype=np.uint8), CAUSES)
    values = cv2.imdecode(np.frombuffer(encode_depth_tiff(cloud), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert values is not None
    assert values.shape == SIZE.shape
    assert not values.any()
    table = np.frombuffer(encode_pcd(cloud).partition(b"DATA binary\n")[2], dtype="<f4").reshape(*SIZE.shape, 8)
    assert np.isnan(table[..., [0, 1, 2, 3, 4, 5, 7]]).all()
    assert encode_npz(cloud) == encode_npz(cloud)

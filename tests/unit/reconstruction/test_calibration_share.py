"""The share of a calibration's error in every vertex, against points triangulated with slightly wrong devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Pinhole, SolveRecord, Source
from slrig.reconstruction.uncertainty import calibration_modes, calibration_sigma, stripe_tangents
from tests.unit.calibration.perturbed import (
    changed,
    covariance_by_known_points,
    left_camera,
    light_source,
    met_with_projector,
    pixels,
    ray_directions,
    right_camera,
)

# These kernels take ten seconds to compile.
slow = pytest.mark.slow
BOX = np.array([[-60.0, -50, 550], [60, 50, 660]])
NAMES = ("left", "right")


def calibrated(cameras: dict[str, Pinhole], projector: Pinhole | None, seed: int = 0) -> Calibration:
    devices = [*cameras.values(), *([projector] if projector else [])]
    covariance = covariance_by_known_points(devices, 1, 0.05, seed)
    solved = SolveRecord("a solve", "2026-11-22T06:00:00+00:00", covariance, BOX, 0.01)
    return Calibration(cameras, projector, solved)


def inside(device: Pinhole, points: FloatArray) -> NDArray[np.bool_]:
    at = pixels(device, points)
    return np.asarray(((at > -0.5) & (at < [device.size.width_px - 0.5, device.size.height_px - 0.5])).all(axis=1))


def places_in_box(*devices: Pinhole) -> FloatArray:
    """Places, evenly spaced all over the box, that all of these devices see."""
    steps = (np.indices((10, 10, 10)).reshape(3, -1).T + 0.5) / 10
    places = BOX[0] + steps * (BOX[1] - BOX[0])
    for device in devices:
        places = places[inside(device, places)]
    return np.asarray(places)


def surface(count: int, seed: int, *devices: Pinhole) -> tuple[FloatArray, NDArray[np.float32]]:
    """Points in the box that these devices see, and normals up to 50° off the view."""
    random = np.random.default_rng(seed)
    points = random.uniform(BOX[0], BOX[1], (4 * count, 3))
    for device in devices or (left_camera(), right_camera(), light_source()):
        points = points[inside(device, points)]
    points = points[:count]
    normals = random.normal(size=(len(points), 3)) * 0.5 + [0, 0, -1]
    return points, (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def factor(covariance: FloatArray) -> FloatArray:
    """(p, k): a square root of the covariance by Cholesky's way."""
    known = np.diagonal(covariance) > 0
    scale = np.sqrt(np.diagonal(covariance)[known])
    columns = np.zeros((len(covariance), int(known.sum())))
    columns[known] = scale[:, None] * np.linalg.cholesky(covariance[np.ix_(known, known)] / np.outer(scale, scale))
    return columns


def without_rigid(fields: FloatArray, places: FloatArray, of: FloatArray, of_places: FloatArray) -> FloatArray:
    """Fields (n, 3) at points without the rigid motion that is nearest to those (m, 3) at the places."""
    middle = of_places.mean(axis=0)

    def motions(points: FloatArray) -> FloatArray:
        turns = [np.cross(axis, points - middle) for axis in np.eye(3)]
        shifts = [np.tile(axis, (len(points), 1)) for axis in np.eye(3)]
        return np.stack([*shifts, *turns], axis=2)

    motion = np.linalg.lstsq(motions(of_places).reshape(-1, 6), places.ravel(), rcond=None)[0]
    return np.asarray(fields - motions(of) @ motion)


def by_light(camera: Pinhole, projector: Pinhole, points: FloatArray, change: FloatArray, axis: int) -> FloatArray:
    """By how far points move when the camera's and the projector's parameters change: found again, either way."""
    at, lit = pixels(camera, points), pixels(projector, points)[:, axis]
    ends = [
        met_with_projector(
            changed(camera, s * change[:15]), changed(projector, s * change[-15:]), at, lit, points, axis
        )
        for s in (1, -1)
    ]
    return np.asarray((ends[0] - ends[1]) / 2)


def by_stripe(
    left: Pinhole, right: Pinhole, points: FloatArray, tangents: FloatArray, change: FloatArray
) -> FloatArray:
    """The same by two cameras: the point stays on the stripe seen by the second one."""
    at, other = pixels(left, points), pixels(right, points)
    step = pixels(right, points + 1e-3 * tangents) - pixels(right, points - 1e-3 * tangents)
    across = np.column_stack([step[:, 1], -step[:, 0]]) / np.linalg.norm(step, axis=1, keepdims=True)
    ends = []
    for s in (1, -1):
        first, second = changed(left, s * change[:15]), changed(right, s * change[15:30])
        directions = ray_directions(first, at)
        depth = points @ first.rotation[2] + first.translation_mm[2]
        for _ in range(6):
            off = [
                np.einsum("ni,ni->n", pixels(second, first.centre_mm + d[:, None] * directions) - other, across)
                for d in (depth, depth + 1e-3)
            ]
            depth = depth - off[0] / (off[1] - off[0]) * 1e-3
        ends.append(first.centre_mm + depth[:, None] * directions)
    return np.asarray((ends[0] - ends[1]) / 2)


def epipolar_tangents(points: FloatArray) -> FloatArray:
    """Tangents of stripes that run straight across the epipolar lines in the second camera."""
    right = right_camera()
    along = pixels(right, points * 1.0001) - pixels(right, points)
    across = np.column_stack([along[:, 1], -along[:, 0]])
    steps = np.stack([pixels(right, points + 1e-3 * e) - pixels(right, points - 1e-3 * e) for e in np.eye(3)], axis=2)
    # Of all directions in space that the camera sees at right angles to the line, the one that faces it.
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.pinv(steps), across))


def sigma_of(moves: list[FloatArray], normals: NDArray[np.float32]) -> FloatArray:
    return np.asarray(np.sqrt(sum(np.einsum("ni,ni->n", normals, move) ** 2 for move in moves)))


def share(
    calibration: Calibration,
    points: FloatArray,
    normals: NDArray[np.float32],
    *,
    cameras: Sequence[str] = ("left",),
    axis: Axis = Axis.COLUMN,
    source: int = 0,
    camera: int = 0,
    seen_by: int = 0b11,
    tangents: FloatArray | None = None,
) -> FloatArray:
    """The share in points that are all of one source and camera; tangents : NaN for none."""
    modes = calibration_modes(calibration, cameras, axis)
    assert modes is not None
    count = len(points)
    return calibration_sigma(
        modes, points, normals, np.full(count, source, dtype=np.uint8), np.full(count, camera, dtype=np.int32),
        np.full(count, seen_by, dtype=np.int64), np.full((count, 3), np.nan) if tangents is None else tangents,
    )  # fmt: skip


def changes(calibration: Calibration) -> FloatArray:
    """Independent errors of the parameters, one a row."""
    assert calibration.solved is not None
    return factor(calibration.solved.covariance).T


@slow
@pytest.mark.parametrize("axis", Axis)
def test_the_share_of_a_camera_and_a_projector(axis: Axis) -> None:
    camera, projector = left_camera(), light_source()
    if axis is Axis.ROW:
        # A projector above the camera.
        turn = cv2.Rodrigues(np.array([0, 0, np.pi / 2]))[0]
        projector = replace(
            projector, rotation=turn @ projector.rotation, translation_mm=turn @ projector.translation_mm
        )
    calibration = calibrated({"left": camera}, projector)
    points, normals = surface(100, 1, camera, projector)
    places = places_in_box(camera, projector)
    row = int(axis is Axis.ROW)
    moves = []
    for change in changes(calibration):
        field = by_light(camera, projector, points, change, row)
        moves.append(without_rigid(field, by_light(camera, projector, places, change, row), points, places))
    modes = calibration_modes(calibration, ["left"], axis)
    assert modes is not None
    assert modes.modes.shape[1] < 21
    expected = sigma_of(moves, normals)
    assert np.abs(share(calibration, points, normals, axis=axis) / expected - 1).max() < 0.01


@slow
def test_the_share_of_two_cameras() -> None:
    left, right = left_camera(), right_camera()
    calibration = calibrated({"left": left, "right": right}, None)
    points, normals = surface(100, 3)
    places = places_in_box(left, right)
    tangents = np.cross(normals, [1.0, 0.3, 0.1])
    moves = []
    for change in changes(calibration):
        rigid = by_stripe(left, right, places, epipolar_tangents(places), change)
        moves.append(without_rigid(by_stripe(left, right, points, tangents, change), rigid, points, places))

    def found(tangents: FloatArray | None) -> FloatArray:
        source = int(Source.CAMERA_CAMERA)
        return share(calibration, points, normals, cameras=NAMES, source=source, tangents=tangents)

    assert np.abs(found(tangents) / sigma_of(moves, normals) - 1).max() < 0.01
    assert found(None) == pytest.approx(found(epipolar_tangents(points)), rel=1e-4)


@slow
def test_the_share_of_two_cameras_and_a_projector() -> None:
    """Points of either camera, and the mean of both by how far each sees a point move along the projector's ray."""
    left, right, projector = left_camera(), right_camera(), light_source()
    calibration = calibrated({"left": left, "right": right}, projector)
    points, normals = surface(100, 5)
    places = places_in_box(projector)
    places = places[inside(left, places) | inside(right, places)]

    def parts(at: FloatArray) -> FloatArray:
        ray = at - projector.centre_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        squares = [
            ((pixels(each, at + 1e-3 * ray) - pixels(each, at - 1e-3 * ray)) ** 2).sum(axis=1) * inside(each, at)
            for each in (left, right)
        ]
        return np.asarray(np.stack(squares) / np.sum(squares, axis=0))

    def moved(at: FloatArray, change: FloatArray) -> list[FloatArray]:
        own = [np.concatenate([change[15 * k : 15 * k + 15], change[30:]]) for k in range(2)]
        single = [by_light(each, projector, at, own[k], 0) for k, each in enumerate((left, right))]
        part = parts(at)
        return [*single, part[0][:, None] * single[0] + part[1][:, None] * single[1]]

    moves: list[list[FloatArray]] = [[], [], []]
    for change in changes(calibration):
        rigid = moved(places, change)[2]
        for kind, field in enumerate(moved(points, change)):
            moves[kind].append(without_rigid(field, rigid, points, places))
    both = int(Source.ALL)
    # The last: the other camera has the point in its image, and did not measure it.
    for kind, source, camera, seen_by in ((0, 0, 0, 1), (1, 0, 1, 2), (2, both, 0, 3), (1, both, 0, 2)):
        found = share(calibration, points, normals, cameras=NAMES, source=source, camera=camera, seen_by=seen_by)
        assert np.abs(found / sigma_of(moves[kind], normals) - 1).max() < 0.01


@slow
def test_cameras_in_another_order_and_one_that_is_not_in_the_scan() -> None:
    left, right, projector = left_camera(), right_camera(), light_source()
    whole = calibrated({"right": right, "left": left}, projector)
    points, normals = surface(50, 7)
    assert whole.solved is not None
    kept = np.r_[15:45]
    alone = Calibration(
        {"left": left}, projector, replace(whole.solved, covariance=whole.solved.covariance[np.ix_(kept, kept)])
    )
    assert share(whole, points, normals) == pytest.approx(share(alone, points, normals))


@slow
def test_without_a_normal_the_viewing_ray_is_used() -> None:
    calibration = calibrated({"left": left_camera()}, light_source())
    points, _ = surface(30, 8)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    along = share(calibration, points, rays.astype(np.float32))
    unknown = np.full((len(points), 3), np.nan, dtype=np.float32)
    assert share(calibration, points, unknown) == pytest.approx(along, rel=1e-4)


def test_a_calibration_without_covariance_has_no_modes() -> None:
    assert calibration_modes(Calibration({"left": left_camera()}, light_source()), ["left"], Axis.COLUMN) is None


@slow
def test_an_exact_calibration_has_no_share() -> None:
    plain = Calibration({"left": left_camera()}, light_source())
    exact = Calibration(plain.cameras, plain.projector, SolveRecord("id", "now", np.zeros((30, 30)), BOX, 0.0))
    assert (share(exact, *surface(5, 9)) == 0).all()


@slow
def test_a_volume_that_no_device_sees_is_refused() -> None:
    calibration = calibrated({"left": left_camera()}, light_source())
    assert calibration.solved is not None
    behind = replace(calibration, solved=replace(calibration.solved, volume_mm=BOX - [0, 0, 5000]))
    with pytest.raises(CalibrationError, match=r"solved\.volume_mm: expected a box .*calibrate again"):
        calibration_modes(behind, ["left"], Axis.COLUMN)


def test_tangents_follow_the_curve_and_stop_at_bridges() -> None:
    points = np.zeros((7, 3))
    points[:, 1] = [0, 1, 3, 10, 11, 0, 5]
    tangents = stripe_tangents(
        points, np.array([0, 5, 6, 7], dtype=np.int32), np.array([False, False, True, False, False, False, False])
    )
    assert tangents[:5, 1] == pytest.approx([3, 3, 3, 1, 1])
    assert np.isnan(tangents[5:]).all()

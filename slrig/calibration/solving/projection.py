"""Projection of corners and light, with analytic derivatives; parameters of devices, poses and board as arrays.

A device is a row of 21: fx, fy, cx, cy, k1, k2, p1, p2, k3, its rotation row by row, its translation (mm): world to
device. A pose is a row of 12: rotation and translation, board to world. Lenses are those of `slrig.model.lens`.

The board's surface is (x, y, z(x, y)). z is a polynomial of the second and third degree with the coefficients `bend`
(mm), in coordinates that are centred and divided by half the board's extent (`frame`: centre x, centre y, that half).
It is 0 for a flat board.

A corner is projected into its camera. Light is traced backwards: the camera pixel's ray is intersected with the board,
and the intersection is projected into the projector. A small change moves the intersection by

    dX = a + d (n·(dt_b + w_b x (X - t_b)) + φ·dbend - n·a) / (n·d),    a = do + s dd,

with the ray o + s d, the surface's normal n, the board's turn w_b and shift dt_b, and the bend's basis φ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.calibration.board import Correspondences, Observations
from slrig.calibration.solution import PARAMETERS, BoardPose
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray, Pinhole, Size
from slrig.model.lens_kernels import distort, distortion_by_terms, undistort

MIN_CORNERS = 6
"""Minimum number of corners of a view: fewer determine a pose too poorly."""

DEVICE, POSE, BEND = 15, 6, 7
CORNER_TERMS = DEVICE + POSE + 2 + BEND
LIGHT_TERMS = 2 * DEVICE + POSE + BEND
_FIRST_TURN = PARAMETERS.index("turn_x")
_MAX_STEPS = 30
_UNDISTORTION_TOLERANCE = 1e-12  # of normalised coordinates
_MIN_ROWS_IN_BANDS = 20_000


@dataclass(frozen=True, slots=True)
class Measurements:
    """All observations of some poses by some cameras.

    corner_where : (n, 3) int32, camera, pose and corner; corner_px : (n, 2); corner_sigma : (n,), px, as stated.
    match_where : (k, 3) int32, camera, pose and axis of each correspondence with the projector; match_pixel : (k, 2),
    in the camera; match_px : (k,), projector coordinates; match_sigma : (k,), as stated.
    """

    corner_where: IntArray
    corner_px: FloatArray
    corner_sigma: FloatArray
    match_where: IntArray
    match_pixel: FloatArray
    match_px: FloatArray
    match_sigma: FloatArray

    def select(self, corners: NDArray[np.bool_], matches: NDArray[np.bool_]) -> Measurements:
        """Measurements of the chosen corners, (n,) bool, and matches, (k,) bool."""
        return Measurements(
            self.corner_where[corners], self.corner_px[corners], self.corner_sigma[corners], self.match_where[matches],
            self.match_pixel[matches], self.match_px[matches], self.match_sigma[matches],
        )  # fmt: skip

    def select_poses(self, poses: NDArray[np.bool_], /, *, matches: bool = True) -> Measurements:
        """Measurements of the chosen poses, (m,) bool; matches : False leaves out their matches."""
        return self.select(poses[self.corner_where[:, 1]], poses[self.match_where[:, 1]] & matches)

    def thin(self, limit: int) -> Measurements:
        """Keep at most `limit` matches of each camera, pose and axis, spread over its image."""
        keep = np.zeros(len(self.match_px), dtype=np.bool_)
        for rows in find_groups(self.match_where):
            keep[rows.start + select_evenly(self.match_pixel[rows], limit)] = True
        return self.select(np.ones(len(self.corner_px), dtype=np.bool_), keep)


def collect_measurements(
    observations: Observations, flipped: Mapping[tuple[int, int], bool], /, *, matches_per_view: int
) -> Measurements:
    """Arrays of all poses, without values that are not finite or have no positive standard deviation.

    flipped : by (camera, pose), True if that view's corners are counted from the board's other end.
    matches_per_view : maximum number of correspondences of each camera, pose and axis, spread over its image.
    """
    last = observations.board.corner_count - 1
    empty = np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros(0)
    corners, matches = [empty], [(*empty, np.zeros(0))]
    for number, pose in enumerate(observations.poses):
        for camera, name in enumerate(observations.cameras):
            view = pose.views.get(name)
            if view is not None and len(view.corner) >= MIN_CORNERS:
                corner = last - view.corner if flipped.get((camera, number), False) else view.corner
                where = np.column_stack([np.full((len(corner), 2), (camera, number)), corner]).astype(np.int32)
                good = np.isfinite(view.points_px).all(axis=1) & (view.sigma_px > 0) & np.isfinite(view.sigma_px)
                corners.append((where[good], view.points_px[good], view.sigma_px[good]))
            light = pose.correspondences.get(name)
            if light is not None and len(light.axis) and observations.projector is not None:
                matches.append(_select_matches(camera, number, light, matches_per_view))
    columns = [*zip(*corners, strict=True), *zip(*matches, strict=True)]
    return Measurements(*(np.concatenate(column) for column in columns))


def _select_matches(
    camera: int, pose: int, light: Correspondences, limit: int
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    finite = np.isfinite(light.pixels_px).all(axis=1) & np.isfinite(light.position_px)
    good = finite & np.isfinite(light.sigma_px) & (light.sigma_px > 0)
    by_axis: list[IntArray] = []
    for axis in (0, 1):
        rows = np.flatnonzero(good & (light.axis == axis))
        by_axis.append(rows[select_evenly(light.pixels_px[rows], limit)].astype(np.int32))
    chosen = np.concatenate(by_axis)
    where = np.column_stack([np.full((len(chosen), 2), (camera, pose)), light.axis[chosen]]).astype(np.int32)
    return where, light.pixels_px[chosen], light.position_px[chosen], light.sigma_px[chosen]


def find_groups(where: IntArray, /, *, columns: int = 3) -> list[slice]:
    """Slices of consecutive rows with equal first `columns` numbers. Measurements are ordered in such groups."""
    if not len(where):
        return []
    changes = np.flatnonzero(np.any(np.diff(where[:, :columns], axis=0) != 0, axis=1)) + 1
    bounds = [0, *changes.tolist(), len(where)]
    return [slice(first, last) for first, last in pairwise(bounds)]


def select_evenly(points_px: FloatArray, limit: int) -> IntArray:
    """(at most limit,) int: row numbers of points (n, 2) spread evenly over their extent, one per cell first.

    The size of cells is about that at which the points would fill `limit` of them. The choice of a point in a cell is
    pseudo-random and reproducible.
    """
    count = len(points_px)
    if count <= limit:
        return np.arange(count, dtype=np.int32)
    order = np.random.default_rng(count).permutation(count)
    least = points_px.min(axis=0)
    extent = np.maximum(points_px.max(axis=0) - least, 1.0)
    side = np.sqrt(extent[0] * extent[1] / limit)
    cell = ((points_px[order] - least) / side).astype(np.int64)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    by_key = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(key[by_key]) != 0]))
    rank = np.arange(count) - np.repeat(starts, np.diff(np.append(starts, count)))
    first = by_key[np.argsort(rank, kind="stable")[:limit]]
    return np.sort(order[first])


@dataclass(frozen=True, slots=True)
class Geometry:
    """Devices, poses and shape of the board, as arrays of the kernels.

    devices : (d, 21); poses : (m, 12); points : (corners, 2), nominal positions of the board's corners, mm; offsets :
    (corners, 2), their offsets from those, mm; bend : (7,), mm; frame : (3,), the bend's coordinates.
    """

    devices: FloatArray
    poses: FloatArray
    points: FloatArray
    offsets: FloatArray
    bend: FloatArray
    frame: FloatArray

    @property
    def layout(self) -> ParameterLayout:
        """Positions of the parameters in the parameter vector."""
        return ParameterLayout(len(self.devices), len(self.poses), len(self.points))

    def apply_step(self, step: FloatArray) -> Geometry:
        """Add a step of the whole parameter vector."""
        layout = self.layout
        devices, poses = self.devices.copy(), self.poses.copy()
        by_device = step[: layout.first_pose].reshape(-1, DEVICE)
        devices[:, :_FIRST_TURN] += by_device[:, :_FIRST_TURN]
        devices[:, 9:18] = rotate(devices[:, 9:18], by_device[:, 9:12])
        devices[:, 18:] += by_device[:, 12:]
        by_pose = step[layout.first_pose : layout.first_offset].reshape(-1, POSE)
        poses[:, :9] = rotate(poses[:, :9], by_pose[:, :3])
        poses[:, 9:] += by_pose[:, 3:]
        offsets = self.offsets + step[layout.first_offset : layout.first_bend].reshape(-1, 2)
        return replace(self, devices=devices, poses=poses, offsets=offsets, bend=self.bend + step[layout.first_bend :])

    def shape_mm(self) -> FloatArray:
        """(corners, 3) float64: offset of each corner from its nominal position on a flat board."""
        return np.column_stack([self.offsets, self.bend_basis() @ self.bend])

    def bend_basis(self) -> FloatArray:
        """(corners, 7) float64: height of each corner per unit of each coefficient of the bend."""
        a, b = ((self.points + self.offsets - self.frame[:2]) / self.frame[2]).T
        return np.stack([a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3], axis=1)


@dataclass(frozen=True, slots=True)
class ParameterLayout:
    """Positions of the parameters of `devices`, `poses`, `corners` and the bend in the parameter vector."""

    devices: int
    poses: int
    corners: int

    @property
    def first_pose(self) -> int:
        """Index of the first pose's turn."""
        return DEVICE * self.devices

    @property
    def first_offset(self) -> int:
        """Index of the first corner's x offset."""
        return self.first_pose + POSE * self.poses

    @property
    def first_bend(self) -> int:
        """Index of the first coefficient of the bend."""
        return self.first_offset + 2 * self.corners

    @property
    def count(self) -> int:
        """Length of the vector."""
        return self.first_bend + BEND

    def free_mask(self, poses: NDArray[np.bool_], /, *, bend: bool = False, offsets: bool = False) -> NDArray[np.bool_]:
        """(count,) bool: parameters that are adjusted. poses : (m,) bool.

        The first device's pose is the world's and stays fixed. Without `bend` the board is flat, without `offsets` its
        corners are at their nominal positions.
        """
        free = np.zeros(self.count, dtype=np.bool_)
        devices = free[: self.first_pose].reshape(-1, DEVICE)
        devices[:, :_FIRST_TURN] = True
        devices[1:, _FIRST_TURN:] = True
        free[self.first_pose : self.first_offset] = np.repeat(poses, POSE)
        free[self.first_offset : self.first_bend] = offsets
        free[self.first_bend :] = bend
        return free


def rotate(rotations: FloatArray, turns: FloatArray) -> FloatArray:
    """(n, 9) float64: exp([turn]x) R for rotations (n, 9) row by row and turns (n, 3), rad."""
    matrices = Rotation.from_rotvec(turns).as_matrix() @ rotations.reshape(-1, 3, 3)
    return np.asarray(matrices.reshape(-1, 9), dtype=np.float64)


def device_difference(first: FloatArray, second: FloatArray) -> FloatArray:
    """(d, 15) float64: the step that leads from the second devices (d, 21) to the first."""
    turn = first[:, 9:18].reshape(-1, 3, 3) @ second[:, 9:18].reshape(-1, 3, 3).transpose(0, 2, 1)
    turns = Rotation.from_matrix(turn).as_rotvec()
    lens = _FIRST_TURN
    return np.hstack([first[:, :lens] - second[:, :lens], turns, first[:, 18:] - second[:, 18:]])


def device_row(
    matrix: FloatArray, distortion: FloatArray, rotation: FloatArray, translation_mm: FloatArray
) -> FloatArray:
    """(21,) float64: a device as a row. A skew of the matrix is dropped."""
    lens = np.concatenate([distortion, np.zeros(5)])[:5]
    focal = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    return np.concatenate([focal, lens, np.ravel(rotation), np.ravel(translation_mm)]).astype(np.float64)


def pose_row(rotation: FloatArray, translation_mm: FloatArray) -> FloatArray:
    """(12,) float64: a pose as a row."""
    return np.concatenate([np.ravel(rotation), np.ravel(translation_mm)]).astype(np.float64)


def to_pinhole(row: FloatArray, size: Size) -> Pinhole:
    """The device of a row."""
    matrix = np.array([[row[0], 0.0, row[2]], [0.0, row[1], row[3]], [0.0, 0.0, 1.0]])
    return Pinhole(size, matrix, row[4:9].copy(), row[9:18].reshape(3, 3).copy(), row[18:].copy())


def to_board_pose(row: FloatArray) -> BoardPose:
    """The board's pose of a row."""
    return BoardPose(row[:9].reshape(3, 3).copy(), row[9:].copy())


def corner_residuals(geometry: Geometry, m: Measurements, /, *, jacobian: bool) -> tuple[FloatArray, FloatArray]:
    """Projected minus measured corners, (n, 2) px, and derivatives (n, 2, 30), or (0, 2, 30) without `jacobian`.

    The derivatives are by the device's 15, the pose's 6, the corner's x and y, and the 7 of the bend. NaN behind the
    camera.
    """
    count = len(m.corner_where)
    residual = np.full((count, 2), np.nan)
    rows = np.zeros((count if jacobian else 0, 2, CORNER_TERMS))
    in_bands(
        _corner_kernel, count, geometry.devices, geometry.poses, geometry.points + geometry.offsets, geometry.bend,
        geometry.frame, m.corner_where, m.corner_px, jacobian, residual, rows, rows_at_least=_MIN_ROWS_IN_BANDS,
    )  # fmt: skip
    return residual, rows


def match_residuals(geometry: Geometry, m: Measurements, /, *, jacobian: bool) -> tuple[FloatArray, FloatArray]:
    """Projected minus measured projector coordinates, (k,) px, and derivatives (k, 43), or (0, 43) without `jacobian`.

    The last device is the projector. The derivatives are by the camera's 15, the projector's 15, the pose's 6, and the
    7 of the bend. NaN where the ray misses the board's surface or meets it behind a device.
    """
    count = len(m.match_where)
    residual = np.full(count, np.nan)
    rows = np.zeros((count if jacobian else 0, LIGHT_TERMS))
    if count:
        in_bands(
            _light_kernel, count, geometry.devices, geometry.poses, geometry.bend, geometry.frame, m.match_where,
            m.match_pixel, m.match_px, jacobian, residual, rows, rows_at_least=_MIN_ROWS_IN_BANDS,
        )  # fmt: skip
    return residual, rows


def weighted_blocks(
    rows: FloatArray, residual: FloatArray, weight: FloatArray, starts: Any, /
) -> tuple[FloatArray, FloatArray]:
    """Jᵀ W J, (g, T, T), and Jᵀ W r, (g, T), of each group of rows.

    rows : (n, T), residual and weight : (n,); starts : (g + 1,) int64, first row of each group, and n. Rows of weight 0
    may hold NaN.
    """
    terms = rows.shape[1]
    blocks, pulls = np.zeros((len(starts) - 1, terms, terms)), np.zeros((len(starts) - 1, terms))
    groups = len(starts) - 1
    in_bands(
        _block_kernel, groups, rows, residual, weight, starts, blocks, pulls,
        rows_at_least=1 if len(rows) >= _MIN_ROWS_IN_BANDS else groups,
    )  # fmt: skip
    return blocks, pulls


@kernel_part(inline="always")
def _height(bend: Any, frame: Any, x: float, y: float, basis: Any) -> Any:
    """The surface's height and slopes at board coordinates; fills the bend's basis (7,)."""
    s = 1 / frame[2]
    a, b = (x - frame[0]) * s, (y - frame[1]) * s
    basis[0], basis[1], basis[2] = a * a, a * b, b * b
    basis[3], basis[4], basis[5], basis[6] = a * a * a, a * a * b, a * b * b, b * b * b
    z = 0.0
    for k in range(BEND):
        z += bend[k] * basis[k]
    by_a = 2 * a * bend[0] + b * bend[1] + 3 * a * a * bend[3] + 2 * a * b * bend[4] + b * b * bend[5]
    by_b = a * bend[1] + 2 * b * bend[2] + a * a * bend[4] + 2 * a * b * bend[5] + 3 * b * b * bend[6]
    return z, by_a * s, by_b * s


@kernel_part(inline="always")
def _rotate(m: Any, start: int, x: float, y: float, z: float) -> Any:
    """R v for the rotation that starts at m[start]."""
    return (
        m[start] * x + m[start + 1] * y + m[start + 2] * z,
        m[start + 3] * x + m[start + 4] * y + m[start + 5] * z,
        m[start + 6] * x + m[start + 7] * y + m[start + 8] * z,
    )


@kernel_part(inline="always")
def _rotate_back(m: Any, start: int, x: float, y: float, z: float) -> Any:
    """Rᵀ v for the rotation that starts at m[start]."""
    return (
        m[start] * x + m[start + 3] * y + m[start + 6] * z,
        m[start + 1] * x + m[start + 4] * y + m[start + 7] * z,
        m[start + 2] * x + m[start + 5] * y + m[start + 8] * z,
    )


@kernel_part
def _device_derivatives(d: Any, row: bool, x: float, y: float, z: float, w: Any, out: Any) -> Any:
    """Write a coordinate's derivatives by its device's 15 parameters into out; return the gradient in the device.

    (x, y, z) : the point in the device; w : the point rotated into the device, before its translation.
    """
    xn, yn = x / z, y / z
    xd, yd, a, b, c = distort(d[4:9], xn, yn)
    if row:
        by_x, by_y = d[1] * b, d[1] * c
        out[0], out[1], out[2], out[3] = 0.0, yd, 0.0, 1.0
        out[4], out[5], out[6], out[7], out[8] = distortion_by_terms(0.0, d[1], xn, yn)
    else:
        by_x, by_y = d[0] * a, d[0] * b
        out[0], out[1], out[2], out[3] = xd, 0.0, 1.0, 0.0
        out[4], out[5], out[6], out[7], out[8] = distortion_by_terms(d[0], 0.0, xn, yn)
    gx, gy = by_x / z, by_y / z
    gz = -(gx * xn + gy * yn)
    out[9], out[10], out[11] = w[1] * gz - w[2] * gy, w[2] * gx - w[0] * gz, w[0] * gy - w[1] * gx
    out[12], out[13], out[14] = gx, gy, gz
    return gx, gy, gz


@kernel(in_every_scan=False)
def _corner_kernel(
    first: int, last: int, devices: Any, poses: Any, points: Any, bend: Any, frame: Any, where: Any,
    measured: Any, jacobian: bool, residual: Any, rows: Any,
) -> None:  # fmt: skip
    basis = np.zeros(BEND)
    for i in range(first, last):
        d, p, corner = devices[where[i, 0]], poses[where[i, 1]], where[i, 2]
        bx, by = points[corner, 0], points[corner, 1]
        bz, slope_x, slope_y = _height(bend, frame, bx, by, basis)
        q = _rotate(p, 0, bx, by, bz)
        w = _rotate(d, 9, q[0] + p[9], q[1] + p[10], q[2] + p[11])
        x, y, z = w[0] + d[18], w[1] + d[19], w[2] + d[20]
        if not z > 0:
            continue
        xd, yd, _, _, _ = distort(d[4:9], x / z, y / z)
        residual[i, 0] = d[0] * xd + d[2] - measured[i, 0]
        residual[i, 1] = d[1] * yd + d[3] - measured[i, 1]
        if not jacobian:
            continue
        for k in range(2):
            out = rows[i, k]
            g = _device_derivatives(d, k == 1, x, y, z, w, out)
            gw = _rotate_back(d, 9, g[0], g[1], g[2])
            out[15], out[16] = q[1] * gw[2] - q[2] * gw[1], q[2] * gw[0] - q[0] * gw[2]
            out[17] = q[0] * gw[1] - q[1] * gw[0]
            out[18], out[19], out[20] = gw
            gb = _rotate_back(p, 0, gw[0], gw[1], gw[2])
            out[21], out[22] = gb[0] + gb[2] * slope_x, gb[1] + gb[2] * slope_y
            for m in range(BEND):
                out[23 + m] = gb[2] * basis[m]


@kernel_part
def _intersect_board(bend: Any, frame: Any, o: Any, e: Any, basis: Any) -> Any:
    """Depth at which a ray, in the board's frame, meets the board, and the surface's slopes there."""
    s = -o[2] / e[2]
    for _ in range(_MAX_STEPS):
        bx, by = o[0] + s * e[0], o[1] + s * e[1]
        z, slope_x, slope_y = _height(bend, frame, bx, by, basis)
        off = o[2] + s * e[2] - z
        if abs(off) < 1e-10 * frame[2]:
            return s, slope_x, slope_y
        s -= off / (e[2] - slope_x * e[0] - slope_y * e[1])
    return np.nan, 0.0, 0.0


@kernel(in_every_scan=False)
def _light_kernel(
    first: int, last: int, devices: Any, poses: Any, bend: Any, frame: Any, where: Any,
    pixels: Any, positions: Any, jacobian: bool, residual: Any, rows: Any,
) -> None:  # fmt: skip
    projector = devices[len(devices) - 1]
    basis = np.zeros(BEND)
    for i in range(first, last):
        c, p, row = devices[where[i, 0]], poses[where[i, 1]], where[i, 2] == 1
        cxd, cyd = (pixels[i, 0] - c[2]) / c[0], (pixels[i, 1] - c[3]) / c[1]
        xn, yn = undistort(c[4:9], cxd, cyd, cxd, cyd, _UNDISTORTION_TOLERANCE)
        d = _rotate_back(c, 9, xn, yn, 1.0)
        o = _rotate_back(c, 9, -c[18], -c[19], -c[20])
        in_board = _rotate_back(p, 0, o[0] - p[9], o[1] - p[10], o[2] - p[11])
        s, slope_x, slope_y = _intersect_board(bend, frame, in_board, _rotate_back(p, 0, d[0], d[1], d[2]), basis)
        if not s > 0:
            continue
        px, py, pz = o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2]
        w = _rotate(projector, 9, px, py, pz)
        x, y, z = w[0] + projector[18], w[1] + projector[19], w[2] + projector[20]
        if not z > 0:
            continue
        xd, yd, _, _, _ = distort(projector[4:9], x / z, y / z)
        projected = projector[1] * yd + projector[3] if row else projector[0] * xd + projector[2]
        residual[i] = projected - positions[i]
        if not jacobian:
            continue
        out = rows[i]
        g = _device_derivatives(projector, row, x, y, z, w, out[15:30])
        gw = _rotate_back(projector, 9, g[0], g[1], g[2])
        n = _rotate(p, 0, -slope_x, -slope_y, 1.0)
        share = (gw[0] * d[0] + gw[1] * d[1] + gw[2] * d[2]) / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        # Gradient by a shift of the ray, in the camera: h = R_c (g - share n).
        h = _rotate(c, 9, gw[0] - share * n[0], gw[1] - share * n[1], gw[2] - share * n[2])
        _ray_derivatives(c, cxd, cyd, xn, yn, s, h, out)
        qx, qy, qz = px - p[9], py - p[10], pz - p[11]
        out[30], out[31] = share * (qy * n[2] - qz * n[1]), share * (qz * n[0] - qx * n[2])
        out[32] = share * (qx * n[1] - qy * n[0])
        out[33], out[34], out[35] = share * n[0], share * n[1], share * n[2]
        for m in range(BEND):
            out[36 + m] = share * basis[m]


@kernel_part
def _ray_derivatives(c: Any, xd: float, yd: float, xn: float, yn: float, s: float, h: Any, out: Any) -> None:
    """Write derivatives by the 15 parameters of the ray's camera into out; h : gradient in the camera."""
    _, _, a, b, e = distort(c[4:9], xn, yn)
    det = a * e - b * b
    # d(x, y) = J⁻¹ (d(xd, yd) - ∂distorted/∂k dk), and the gradient by (x, y) is s h.
    gx, gy = s * (e * h[0] - b * h[1]) / det, s * (a * h[1] - b * h[0]) / det
    out[0], out[1] = -gx * xd / c[0], -gy * yd / c[1]
    out[2], out[3] = -gx / c[0], -gy / c[1]
    out[4], out[5], out[6], out[7], out[8] = distortion_by_terms(-gx, -gy, xn, yn)
    qx, qy, qz = s * xn - c[18], s * yn - c[19], s - c[20]
    out[9], out[10], out[11] = h[1] * qz - h[2] * qy, h[2] * qx - h[0] * qz, h[0] * qy - h[1] * qx
    out[12], out[13], out[14] = -h[0], -h[1], -h[2]


@kernel(in_every_scan=False)
def _block_kernel(
    first: int, last: int, rows: Any, residual: Any, weight: Any, starts: Any, blocks: Any, pulls: Any
) -> None:
    terms = rows.shape[1]
    for group in range(first, last):
        block, pull = blocks[group], pulls[group]
        for i in range(starts[group], starts[group + 1]):
            if not weight[i] > 0:
                continue
            row = rows[i]
            for a in range(terms):
                share = weight[i] * row[a]
                pull[a] += share * residual[i]
                for b in range(a, terms):
                    block[a, b] += share * row[b]
        for a in range(terms):
            for b in range(a):
                block[a, b] = block[b, a]

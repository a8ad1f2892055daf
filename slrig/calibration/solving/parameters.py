"""The numbers that a solve moves: devices, poses of the board and its shape, as arrays, and which of them are free.

One vector holds them all: 15 per device, then 6 per pose (a small turn, and mm), then x and y of each corner's offset,
then 7 of the board's bend. Turns are small and act from the left: R' = exp([turn]x) R.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.calibration.solution import PARAMETERS, BoardPose
from slrig.calibration.solving.projection import BEND, DEVICE, POSE
from slrig.model import FloatArray, Pinhole, Size

_FIRST_TURN = PARAMETERS.index("turn_x")


@dataclass(frozen=True, slots=True)
class Geometry:
    """Where everything stands. Arrays as the kernels take them (`slrig.calibration.solving.projection`).

    devices : (d, 21); poses : (m, 12); points : (corners, 2), the board's corners as they are printed, mm; offsets :
    (corners, 2), by how much they lie off, mm; bend : (7,), mm; frame : (3,), the bend's coordinates.
    """

    devices: FloatArray
    poses: FloatArray
    points: FloatArray
    offsets: FloatArray
    bend: FloatArray
    frame: FloatArray

    @property
    def layout(self) -> Layout:
        """Where each number lies in the vector."""
        return Layout(len(self.devices), len(self.poses), len(self.points))

    def moved(self, step: FloatArray) -> Geometry:
        """A step of the whole vector on."""
        layout = self.layout
        devices, poses = self.devices.copy(), self.poses.copy()
        by_device = step[: layout.first_pose].reshape(-1, DEVICE)
        devices[:, :_FIRST_TURN] += by_device[:, :_FIRST_TURN]
        devices[:, 9:18] = turned(devices[:, 9:18], by_device[:, 9:12])
        devices[:, 18:] += by_device[:, 12:]
        by_pose = step[layout.first_pose : layout.first_offset].reshape(-1, POSE)
        poses[:, :9] = turned(poses[:, :9], by_pose[:, :3])
        poses[:, 9:] += by_pose[:, 3:]
        offsets = self.offsets + step[layout.first_offset : layout.first_bend].reshape(-1, 2)
        return replace(self, devices=devices, poses=poses, offsets=offsets, bend=self.bend + step[layout.first_bend :])

    def shape_mm(self) -> FloatArray:
        """(corners, 3) float64: by how much each corner lies off its place on a flat board."""
        return np.column_stack([self.offsets, self.bend_basis() @ self.bend])

    def bend_basis(self) -> FloatArray:
        """(corners, 7) float64: what each number of the bend adds to the height of each corner."""
        a, b = ((self.points + self.offsets - self.frame[:2]) / self.frame[2]).T
        return np.stack([a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3], axis=1)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the numbers of `devices`, `poses` and `corners` lie in the vector."""

    devices: int
    poses: int
    corners: int

    @property
    def first_pose(self) -> int:
        """Index of the first pose's turn."""
        return DEVICE * self.devices

    @property
    def first_offset(self) -> int:
        """Index of the first corner's x."""
        return self.first_pose + POSE * self.poses

    @property
    def first_bend(self) -> int:
        """Index of the first number of the bend."""
        return self.first_offset + 2 * self.corners

    @property
    def count(self) -> int:
        """Length of the vector."""
        return self.first_bend + BEND

    def free(self, poses: NDArray[np.bool_], /, *, bend: bool = False, offsets: bool = False) -> NDArray[np.bool_]:
        """(count,) bool: what may move. poses : (m,) bool.

        The first device's pose is the world's and stays. Without `bend` the board is flat, without `offsets` its
        corners lie as printed.
        """
        free = np.zeros(self.count, dtype=np.bool_)
        devices = free[: self.first_pose].reshape(-1, DEVICE)
        devices[:, :_FIRST_TURN] = True
        devices[1:, _FIRST_TURN:] = True
        free[self.first_pose : self.first_offset] = np.repeat(poses, POSE)
        free[self.first_offset : self.first_bend] = offsets
        free[self.first_bend :] = bend
        return free


def turned(rotations: FloatArray, turns: FloatArray) -> FloatArray:
    """(n, 9) float64: exp([turn]x) R for rotations (n, 9) row by row and turns (n, 3), rad."""
    matrices = Rotation.from_rotvec(turns).as_matrix() @ rotations.reshape(-1, 3, 3)
    return np.asarray(matrices.reshape(-1, 9), dtype=np.float64)


def difference(first: FloatArray, second: FloatArray) -> FloatArray:
    """(d, 15) float64: the step that leads from the second devices (d, 21) to the first."""
    turn = first[:, 9:18].reshape(-1, 3, 3) @ second[:, 9:18].reshape(-1, 3, 3).transpose(0, 2, 1)
    turns = Rotation.from_matrix(turn).as_rotvec()
    lens = _FIRST_TURN
    return np.hstack([first[:, :lens] - second[:, :lens], turns, first[:, 18:] - second[:, 18:]])


def device_row(
    matrix: FloatArray, distortion: FloatArray, rotation: FloatArray, translation_mm: FloatArray
) -> FloatArray:
    """(21,) float64: a device as kernels take it. A skew of the matrix is dropped."""
    lens = np.concatenate([distortion, np.zeros(5)])[:5]
    focal = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    return np.concatenate([focal, lens, np.ravel(rotation), np.ravel(translation_mm)]).astype(np.float64)


def pose_row(rotation: FloatArray, translation_mm: FloatArray) -> FloatArray:
    """(12,) float64: a pose as kernels take it."""
    return np.concatenate([np.ravel(rotation), np.ravel(translation_mm)]).astype(np.float64)


def to_pinhole(row: FloatArray, size: Size) -> Pinhole:
    """The device of a row."""
    matrix = np.array([[row[0], 0.0, row[2]], [0.0, row[1], row[3]], [0.0, 0.0, 1.0]])
    return Pinhole(size, matrix, row[4:9].copy(), row[9:18].reshape(3, 3).copy(), row[18:].copy())


def to_board_pose(row: FloatArray) -> BoardPose:
    """The board's pose of a row."""
    return BoardPose(row[:9].reshape(3, 3).copy(), row[9:].copy())

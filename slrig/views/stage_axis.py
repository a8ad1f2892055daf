"""The axis of a stage, from a board that stood on it at several angles.

Where a board's poses B_i are those of one body that a stage turned, T_i = B_0 B_i⁻¹ turns about the axis, as the poses
of views do: both are fitted by `slrig.views.turntable`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from slrig.errors import StageRefusedError
from slrig.model import FloatArray
from slrig.views.turntable import FoundAxis, axis_of, turntable

FEWEST_POSES = 3
LEAST_TURN_DEG = 20.0
"""In all: the arc over a turn of 20° bends by 1.5 % of its radius, which is what tells the radius."""
_LEAST_SLIP_MM, _SLIP_SIGMAS = 0.05, 2.0
"""Below either, the rms of what is left is bearings and wood, or noise: of three poses one in 2000 has more."""
_MOST_LEFT_MM = 0.5
"""Of any stage that turns about one axis: bearings of plastic have 0.1 to 0.3 mm."""
_SLIP_SHARE = 0.5
"""Of what is left over, that remains without the pose that slipped."""
_UPWARDS = np.array([0.0, -1.0, -1.0])
"""The side an axis points to where no angle tells: up in the first camera's image, and to the camera."""


class BoardAxis(NamedTuple):
    """The axis that a board was turned about.

    residual_mm : by pose, rms distance of the board's corners from where a pure turn puts them. angles_deg : by pose,
    from the first one on; errors_deg : those less what the table told, and their mean; empty where it told none.
    """

    found: FoundAxis
    residual_mm: dict[str, float]
    angles_deg: dict[str, float]
    errors_deg: dict[str, float]


def board_axis(
    names: Sequence[str],
    poses: FloatArray,
    covariance: FloatArray,
    points_mm: FloatArray,
    angles_deg: Sequence[float] | FloatArray | None = None,
) -> BoardAxis:
    """The axis from poses of a board that stood still on the stage.

    poses : (m, 4, 4), board to world. covariance : (6 m, 6 m), as `slrig.calibration.health.drift` has both.
    points_mm : (n, 3), the board's corners. angles_deg : (m,), where the stage says that it stood; its sense tells the
    axis' direction. Without, it points up in the first camera's image.

    Raises
    ------
    StageRefusedError
        There are fewer than three poses; the board was turned by less than 20° in all; it slipped, or is not turned
        about one axis.
    """
    if len(names) < FEWEST_POSES:
        raise StageRefusedError(
            f"expected {FEWEST_POSES} poses or more of a board that stands on the stage, found {len(names)}: turn the "
            "stage and shoot it again, best at six angles all around"
        )
    shot = _Shot(names, poses, covariance, points_mm)
    found = shot.fit(range(len(names)))
    turn_deg = 0.0 if found is None else _span_deg(found.angles_rad)
    if found is None or turn_deg < LEAST_TURN_DEG:
        raise StageRefusedError(
            f"expected a board that the stage turned by {LEAST_TURN_DEG:g}° or more in all, found {turn_deg:.1f}° over "
            f"{len(names)} poses: turn the stage further between them"
        )
    left = shot.left_mm(found)
    if found.rms_mm > _LEAST_SLIP_MM and found.rms_over_sigma > _SLIP_SIGMAS:
        shot.require_one_body(found, left)
    told = np.rad2deg(found.angles_rad) if angles_deg is None else np.asarray(angles_deg, dtype=np.float64)
    errors = _wrapped_deg(np.rad2deg(found.angles_rad) - told)
    other = _wrapped_deg(-np.rad2deg(found.angles_rad) - told)
    if np.std(other) < np.std(errors):
        found, errors = shot.fit(range(len(names)), -found.direction) or found, other
    return BoardAxis(
        found=found,
        residual_mm=dict(zip(names, left.tolist(), strict=True)),
        angles_deg=dict(zip(names, np.rad2deg(found.angles_rad).tolist(), strict=True)),
        errors_deg={} if angles_deg is None else dict(zip(names, (errors - errors.mean()).tolist(), strict=True)),
    )


class _Shot(NamedTuple):
    """See `board_axis`."""

    names: Sequence[str]
    poses: FloatArray
    covariance: FloatArray
    points_mm: FloatArray

    @property
    def _body(self) -> tuple[FloatArray, float]:
        """The middle of all placed corners, and their rms distance from it."""
        placed = self.points_mm @ self.poses[:, :3, :3].transpose(0, 2, 1) + self.poses[:, None, :3, 3]
        middle = placed.reshape(-1, 3).mean(axis=0)
        return middle, float(np.sqrt(np.square(placed - middle).sum(axis=2).mean()))

    def _between(self, which: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """T_i = B_0 B_i⁻¹ (k, 4, 4) of some poses, and their covariance (6 (k - 1), 6 (k - 1)) about the middle.

        With small motions ε of both poses it is ε_0 - T_i ε_i T_i⁻¹.
        """
        middle, poses = self._body[0], self.poses[list(which)]
        turns = poses[:1] @ np.linalg.inv(poses)
        by_pose = np.zeros((6 * len(poses), 6 * len(poses)))
        for i, (turn, pose) in enumerate(zip(turns, poses, strict=True)):
            mine = slice(6 * i, 6 * i + 6)
            by_pose[mine, :6] += _carried(np.eye(4), poses[0, :3, 3], middle)
            by_pose[mine, mine] -= _carried(turn, pose[:3, 3], middle)
        where = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in which])
        covariance = by_pose @ self.covariance[np.ix_(where, where)] @ by_pose.T
        return turns, covariance[6:, 6:]

    def fit(self, which: Sequence[int], towards: FloatArray = _UPWARDS) -> FoundAxis | None:
        """The axis of some of the poses."""
        return axis_of(*self._between(which), *self._body, towards)

    def left_mm(self, found: FoundAxis) -> FloatArray:
        """(m,): rms distance of corners, turned back by the stage's angles, from their mean over the poses."""
        back = turntable(found.point_mm, found.direction, found.angles_rad) @ self.poses
        placed = self.points_mm @ back[:, :3, :3].transpose(0, 2, 1) + back[:, None, :3, 3]
        return np.asarray(np.sqrt(np.square(placed - placed.mean(axis=0)).sum(axis=2).mean(axis=1)))

    def require_one_body(self, found: FoundAxis, left: FloatArray) -> None:
        """Raises StageRefusedError: some pose, or all from one on, stand elsewhere on the stage than the others."""
        best = min(self._without(), default=(np.inf, ""))
        if best[0] < min(_SLIP_SHARE * found.rms_mm, _MOST_LEFT_MM):
            raise StageRefusedError(
                f"{best[1]}: the poses are off turns about one axis by {found.rms_mm:.3f} mm rms, without that by "
                f"{best[0]:.3f} mm. Fix the board to the stage, and shoot all poses again, or leave that out"
            )
        if found.rms_mm > _MOST_LEFT_MM:
            worst = int(np.argmax(left))
            raise StageRefusedError(
                f"expected a board that turns about one axis, found poses that are off by {found.rms_mm:.2f} mm rms, "
                f"'{self.names[worst]}' by {left[worst]:.2f} mm, the most: the board slipped more than once, or was "
                "held by hand. Fix it to the stage, and shoot all poses again"
            )

    def _without(self) -> Iterator[tuple[float, str]]:
        """What is left over where the board slipped for one pose, or at some instant, rms mm, and where."""
        count = len(self.names)
        everyone = range(count)
        for i in everyone:
            yield self._rms_mm([each for each in everyone if each != i]), f"the board slipped in '{self.names[i]}'"
        for k in range(2, count - 1):
            parts = [self._rms_mm(part) for part in (everyone[:k], everyone[k:]) if len(part) >= FEWEST_POSES]
            yield max(parts, default=np.inf), f"the board slipped between '{self.names[k - 1]}' and '{self.names[k]}'"

    def _rms_mm(self, which: Sequence[int]) -> float:
        """Infinite where so few poses, or such that hardly turned, tell nothing."""
        found = self.fit(which) if len(which) >= FEWEST_POSES else None
        return np.inf if found is None or _span_deg(found.angles_rad) < LEAST_TURN_DEG else found.rms_mm


def _carried(turn: FloatArray, origin_mm: FloatArray, middle_mm: FloatArray) -> FloatArray:
    """(6, 6): from a small turn and a shift of a body's origin to those of the middle, the body carried on by `turn`.

    The carried body's point at the middle is the one that was at T⁻¹ m.
    """
    rotation = turn[:3, :3]
    arm = rotation.T @ (middle_mm - turn[:3, 3]) - origin_mm
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = rotation
    carried[3:, :3] = rotation @ np.cross(np.eye(3), arm).T
    return carried


def _wrapped_deg(angles: FloatArray) -> FloatArray:
    """Angles within half a turn of the first one."""
    return np.asarray((angles - angles[0] + 180) % 360 - 180 + angles[0])


def _span_deg(angles_rad: FloatArray) -> float:
    """The part of a turn that holds all angles."""
    turned = np.sort(np.rad2deg(angles_rad) % 360)
    return float(360 - np.diff(turned, append=turned[0] + 360).max())

"""What a solve gives: the devices, how well each number is known, and what is left over.

Parameters of a device, 15 in this order, each with its row and column in the covariance:
fx, fy, cx, cy (px), k1, k2, p1, p2, k3, a small turn (three angles, rad: R' = exp([turn]x) R), translation (mm).
The world is the first camera's frame, so that its pose has no variance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slrig.model import LENS_TERMS, Calibration, FloatArray, IntArray, Pinhole

PARAMETERS = ("fx", "fy", "cx", "cy", *LENS_TERMS, "turn_x", "turn_y", "turn_z", "x_mm", "y_mm", "z_mm")
CELLS = 6
"""Residual maps have 6 x 6 cells over the image."""

LEAST_HALVED = 8
"""So many poses are solved as two halves as well: four are the least of which a solve can hold any out, and so tell one
lens from another by itself."""

PROJECTOR = "projector"
"""The projector's name among devices."""


def device_title(name: str) -> str:
    """A device's name as a sentence has it.

    >>> device_title("left"), device_title("projector")
    ("camera 'left'", 'the projector')
    """
    return "the projector" if name == PROJECTOR else f"camera '{name}'"


def devices_of(calibration: Calibration, /) -> dict[str, Pinhole]:
    """Cameras in order, then the projector where there is one: the order of the covariance."""
    light = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **light}


def covariance_of(calibration: Calibration, /, *names: str, board: bool = True) -> FloatArray:
    """(15 k, 15 k) float64: the covariance of the named devices, of all without names; zeros where none is stated.

    board : False leaves out what the size of the board's squares is unsure by, for what is seen of the same board.
    """
    order = list(devices_of(calibration))
    if calibration.solved is None:
        return np.zeros((len(PARAMETERS) * len(names or order),) * 2)
    covariance = calibration.solved.covariance
    if not board and calibration.solved.scale_sigma > 0:
        mode = calibration.solved.scale_sigma * scale_mode(calibration)
        covariance = covariance - np.outer(mode, mode)
    indices = np.arange(len(PARAMETERS) * len(order)).reshape(len(order), -1)
    rows = indices[[order.index(name) for name in names or order]].ravel()
    return np.asarray(covariance[np.ix_(rows, rows)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class BoardPose:
    """Where the board stood: X_world = rotation @ X_board + translation_mm; (3, 3) and (3,) float64."""

    rotation: FloatArray
    translation_mm: FloatArray

    def placed(self, points_mm: FloatArray) -> FloatArray:
        """(n, 3) float64: points of the board (n, 3) where they lie."""
        return np.asarray(points_mm @ self.rotation.T + self.translation_mm)


@dataclass(frozen=True, slots=True)
class DeviceResiduals:
    """What is left of one device's observations, px: rms of the distance for a camera's corners (both coordinates), rms
    per coordinate for the projector's light.

    count : observations; outlying : of them, given next to no weight, and in no other figure; stated_rms_px : what
    their own deviations predict; held_out_rms_px : rms at poses that the solve had not seen, NaN if there were too
    few; pose_rms_px : by pose. map_rms_px : (6, 6) float64, NaN where nothing was seen; map_count : (6, 6) int32;
    map_mean_px : (6, 6, 2) float64, the mean residual vector of a cell.
    """

    rms_px: float
    stated_rms_px: float
    held_out_rms_px: float
    count: int
    outlying: int
    pose_rms_px: Mapping[str, float]
    map_rms_px: FloatArray
    map_mean_px: FloatArray
    map_count: IntArray


@dataclass(frozen=True, slots=True)
class Bow:
    """How far out of flat the board is: height_mm from its lowest corner to its highest, sigma_mm its deviation.

    solved : whether the solve took the board for bent; without it, the bow is what the poses would tell of one.
    """

    height_mm: float
    sigma_mm: float
    solved: bool


@dataclass(frozen=True, slots=True)
class BoardSize:
    """What is known of a print's size, in shares. scale_sigma : deviation of the mean of width and height, which no
    pose tells. stretch : width over height less 1, beyond what the board says of itself, as the poses tell it, and its
    deviation stretch_sigma.
    """

    scale_sigma: float = 0.0
    stretch: float = 0.0
    stretch_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """What a scan with this calibration may be wrong by, mm, over the volume in which the board was held.

    Root mean squares over the volume of one standard deviation each. Errors of position as a whole, which move and
    turn everything alike, are no errors of a measurement and are left out.

    volume_mm : (2, 3) float64, opposite corners of the volume's box in the world.
    point_mm : of a point along the first camera's viewing ray, from the calibration alone. noise_mm : from the noise of
    one point's light alone, that of a surface as bright as the board's paper; NaN where no light was observed.
    total_mm : both. length_share : of a length over that length, from the calibration alone, for lengths of half the
    volume's diagonal in all directions that occur in it. board_mm : the part of point_mm that the size of the board's
    squares makes, as far as that is known.
    grid_mm : (n, 3) float64, places in the volume that the devices see; grid_point_mm : (n,) float64, point_mm there.
    across : the calibration is of one camera alone, which tells no depth: point_mm is across its viewing ray, of points
    whose distance is known from elsewhere, and noise_mm, total_mm and length_share are NaN.
    """

    volume_mm: FloatArray
    point_mm: float
    noise_mm: float
    total_mm: float
    length_share: float
    grid_mm: FloatArray
    grid_point_mm: FloatArray
    across: bool = False
    board_mm: float = 0.0

    @property
    def point_words(self) -> str:
        """What `point_mm` is the error of."""
        return "a point of known distance" if self.across else "a scanned point"

    @property
    def way_words(self) -> str:
        """In which direction `point_mm` is, to be put behind it; empty where that need not be said."""
        return " across the line of sight" if self.across else ""


@dataclass(frozen=True, slots=True)
class Half:
    """What the odd or the even poses of a solve give alone. poses : their names. change : (15 d,) float64, its
    parameters less those of the whole solve; covariance : (15 d, 15 d) float64.
    """

    poses: tuple[str, ...]
    change: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Solution:
    """A solved calibration.

    calibration : cameras and projector in the world, the first camera's frame.
    covariance : (15 d, 15 d) float64, of the parameters of all d devices, cameras in order, then the projector.
    distortion : by device, the names of the lens terms that were solved for.
    poses : by name, those that were used; outliers : those left out, each with the reason in words.
    residuals : by device, PROJECTOR among them.
    board_shape_mm : (n, 3) float64, by how much each corner lies off its place, or None where that was not solved.
    bow : how far out of flat the board is; None where a person said that it is flat.
    halves : what the odd poses and the even ones give, each alone; empty where there are too few.
    size : of the board's print; its scale is in the covariance (`scale_mode`).
    """

    calibration: Calibration
    covariance: FloatArray
    distortion: Mapping[str, tuple[str, ...]]
    poses: Mapping[str, BoardPose]
    outliers: Mapping[str, str]
    residuals: Mapping[str, DeviceResiduals]
    board_shape_mm: FloatArray | None = None
    bow: Bow | None = None
    halves: tuple[Half, ...] = ()
    size: BoardSize = BoardSize()


def scale_mode(calibration: Calibration, /) -> FloatArray:
    """(15 d,) float64: by how much each parameter changes, per unit, when everything is larger by one share.

    The first camera stands still, and the distance of all others from it grows: of all parameters, translations alone.
    """
    base = next(iter(calibration.cameras.values())).centre_mm
    change = np.zeros((len(devices_of(calibration)), len(PARAMETERS)))
    for row, device in zip(change, devices_of(calibration).values(), strict=True):
        # A device at the centre c goes to base + (1 + s)(c - base), and its translation is -R c.
        row[-3:] = -device.rotation @ (device.centre_mm - base)
    return change.ravel()

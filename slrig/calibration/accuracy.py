"""Expected error of a calibration, comparison of its halves, and comparison of two calibrations.

Points move together as a rigid body, and relative to one another. Only the second changes a measured shape, so the
rigid motion is removed (`slrig.calibration.solution.remove_rigid_motion`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import COLUMN, ROW, Observations
from slrig.calibration.solution import (
    PROJECTOR,
    ExpectedError,
    PointSensitivity,
    RigidMotion,
    Solution,
    cell_centres,
    covariance_modes,
    device_covariance,
    device_title,
    devices_by_name,
    point_sensitivity,
    project_out_rigid_motion,
    projected_deviation,
    remove_rigid_motion,
    scale_mode,
)
from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Pinhole, triangulated_axis

_TARGET_POINTS = 1500  # in the volume
_MIN_POINTS = 60
_MAX_NODES = 50_000
_MAX_STEPS = 150  # along the longest side
_MAX_LENGTHS = 4000
_PAPER_QUANTILE = 0.05  # at least this fraction of the board's light comes from bright paper
_SURFACE_FIT_FACTOR = 0.4675
"""Deviation at the centre of a quadratic surface fitted to 5 x 5 pixels with Gaussian weights of 1.1 px, for unit
noise: a scan locates points by such fits."""
_LENGTH_TOLERANCE = 0.05
_MAX_PAIRED_POINTS = 900  # for lengths

MIN_CHANCE = 0.003
"""Probability above which a difference may be chance: three standard deviations of a normal error."""
MAX_CHANCE_SIGMAS = 3.0
"""A difference of up to this many of its own standard deviations may be chance."""

_GRID = 4
_NEWTON_STEPS = 10
_STEP_MM = 1e-3
_DECIMALS = 6  # a nanometre, a millionth of a degree or a percent: smaller values are rounding errors


def expected_error(
    solution: Solution, observations: Observations, /, *, noise_px: float | None = None
) -> ExpectedError:
    """Estimate the error of a scan with this calibration in the volume in which the board was held.

    noise_px : standard deviation of the light coordinate of one point of a scan: of its projector coordinate in
    projector pixels, or without a projector of its stripe's position across it in camera pixels. The default is that of
    the board's paper, without the noisier light on ink, after a surface fit. Without observed light, the figures that
    need it are NaN; for a single camera, lengths too.

    Raises
    ------
    CalibrationError
        The board was not held in a volume that the devices see together.
    """
    calibration = solution.calibration
    volume_mm, points = sample_volume(solution, observations)
    sensitivity = _calibration_sensitivity(calibration, points)
    fields = project_out_rigid_motion(points, sensitivity.by_parameter @ covariance_modes(solution.covariance))
    point_mm = projected_deviation(sensitivity.projection, fields)
    if noise_px is None:
        noise_px = _light_sigma_px(observations, calibration)
    noise_mm = _rms(noise_px * projected_deviation(sensitivity.projection, sensitivity.by_noise))
    calibration_mm = _rms(point_mm)
    scale = solution.size.scale_sigma * scale_mode(calibration)
    scale_field = project_out_rigid_motion(points, sensitivity.by_parameter @ scale[:, None])
    board_mm = _rms(projected_deviation(sensitivity.projection, scale_field))
    diagonal_mm = float(np.linalg.norm(volume_mm[1] - volume_mm[0]))
    length_share = _relative_length_error(points, fields, diagonal_mm) if calibration.can_triangulate else float("nan")
    return ExpectedError(
        volume_mm=volume_mm,
        point_mm=calibration_mm,
        noise_mm=noise_mm,
        total_mm=float(np.hypot(calibration_mm, noise_mm)),
        length_share=length_share,
        grid_mm=points,
        grid_point_mm=point_mm,
        across=not calibration.can_triangulate,
        board_mm=board_mm,
    )


def sample_volume(solution: Solution, observations: Observations, /) -> tuple[FloatArray, FloatArray]:
    """The box of all corners of the board in the world, (2, 3) mm, and evenly spaced points in it, (n, 3).

    The points are in the convex hull of the corners and visible to the first camera and the projector; without a
    projector to two cameras, or to a single one.

    Raises CalibrationError if there are too few such points, or the corners are in one plane.
    """
    # Imported here: the service imports the classes of this module and calls none of its functions.
    from scipy.spatial import Delaunay, QhullError

    corners = _board_corners(solution, observations)
    volume_mm = np.stack([corners.min(axis=0), corners.max(axis=0)])
    extent = volume_mm[1] - volume_mm[0]
    try:
        hull = Delaunay(corners)
    except QhullError as cause:
        message = (
            f"expected the board in poses that span a volume, found all corners of {len(solution.poses)} poses in one "
            f"plane, in a box of {_format_box(extent)}; tilt the board, and hold it nearer and farther away"
        )
        raise CalibrationError(message) from cause
    wanted = _TARGET_POINTS
    while True:
        step = max(float(np.cbrt(extent.prod() / wanted)), float(extent.max()) / _MAX_STEPS)
        counts = np.maximum(np.ceil(extent / step).astype(int), 1)
        nodes = cell_centres(volume_mm, counts.tolist())
        nodes = nodes[hull.find_simplex(nodes) >= 0]
        points = nodes[_visible(solution.calibration, nodes)] if len(nodes) else nodes
        if len(points) >= _TARGET_POINTS // 3 or wanted > _MAX_NODES:
            break
        wanted *= 4
    if len(points) < _MIN_POINTS:
        other = "the projector" if solution.calibration.projector else "another camera"
        together = f" together with {other}" if solution.calibration.can_triangulate else ""
        message = (
            f"expected points in the box of {_format_box(extent)} in which the board was held that the first camera "
            f"sees{together}, found {len(points)} of {counts.prod()}; hold the board where all of it is in view"
        )
        raise CalibrationError(message)
    return volume_mm, points


def _calibration_sensitivity(calibration: Calibration, points_mm: FloatArray) -> PointSensitivity:
    return point_sensitivity(list(calibration.cameras.values()), calibration.projector, points_mm)


def _visible(calibration: Calibration, points_mm: FloatArray) -> NDArray[np.bool_]:
    visible = _calibration_sensitivity(calibration, points_mm).visible
    if calibration.projector is None:
        return visible
    first = next(iter(calibration.cameras.values()))
    return visible & _calibration_sensitivity(Calibration({"first": first}, calibration.projector), points_mm).visible


def _board_corners(solution: Solution, observations: Observations) -> FloatArray:
    """(n, 3) float64: all corners of the board in all used poses, in the world."""
    board = observations.board.points_mm
    if solution.board_shape_mm is not None:
        board = board + solution.board_shape_mm
    return np.concatenate([pose.to_world(board) for pose in solution.poses.values()])


def _light_sigma_px(observations: Observations, calibration: Calibration) -> float:
    """Deviation of a scanned point's light on the board's paper, along the axis of triangulation."""
    if calibration.projector is None:
        return float("nan")
    axis = triangulated_axis(list(calibration.cameras.values()), calibration.projector)
    number = COLUMN if axis is Axis.COLUMN else ROW
    parts = [
        light.sigma_px[light.axis == number] for pose in observations.poses for light in pose.correspondences.values()
    ]
    sigma = np.concatenate([np.zeros(0), *parts])
    return _SURFACE_FIT_FACTOR * float(np.quantile(sigma, _PAPER_QUANTILE)) if len(sigma) else float("nan")


def _relative_length_error(points: FloatArray, fields: FloatArray, diagonal_mm: float) -> float:
    """Relative deviation of lengths, rms over many pairs of points that are half a diagonal apart."""
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MAX_PAIRED_POINTS)).astype(int))
    first, second = (chosen[index] for index in np.triu_indices(len(chosen), 1))
    length = np.linalg.norm(points[second] - points[first], axis=1)
    suitable = np.abs(length / (diagonal_mm / 2) - 1) <= _LENGTH_TOLERANCE
    if not suitable.any():
        return float("nan")
    first, second, length = first[suitable], second[suitable], length[suitable]
    chosen = np.unique(np.linspace(0, len(first) - 1, min(len(first), _MAX_LENGTHS)).astype(int))
    first, second, length = first[chosen], second[chosen], length[chosen]
    direction = (points[second] - points[first]) / length[:, None]
    changes = np.einsum("ni,nik->nk", direction, fields[second] - fields[first])
    return _rms(np.sqrt((changes**2).sum(axis=1)) / length)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _format_box(extent: FloatArray) -> str:
    return " x ".join(f"{side:.0f}" for side in extent) + " mm"


@dataclass(frozen=True, slots=True)
class OddEven:
    """Difference between the points of two calibrations, from the odd and from the even poses.

    poses : their numbers. difference_mm : rms over the volume, along the first camera's viewing ray, of a single camera
    across it. stated_mm : its standard deviation according to the two halves. chance : probability of a difference at
    least as large, if that deviation is right. motion : the rigid motion that was removed before.
    """

    poses: tuple[int, int]
    difference_mm: float
    stated_mm: float
    chance: float
    motion: RigidMotion

    @property
    def ratio(self) -> float:
        """Difference over its stated deviation, about 1 if stated errors are right."""
        return self.difference_mm / self.stated_mm

    @property
    def fits(self) -> bool:
        """True if the difference may be chance."""
        return self.chance >= MIN_CHANCE

    @property
    def words(self) -> str:
        """The difference, and the remedy if it does not fit."""
        difference = (
            f"odd and even poses, solved separately, differ by {self.difference_mm:.2g} mm at a point, "
            f"{self.ratio:.2g} × the stated deviation"
        )
        if self.fits:
            return f"{difference} (without {self.motion.description})"
        return (
            f"{difference}, more than chance: expect an error of {self.difference_mm / 2:.2g} mm at a point, plus that "
            "of the board's size; check that the board is stiff, and that devices, focus and temperature do not change "
            "between poses; shoot more poses, all over the volume"
        )


def compare_halves(solution: Solution, points_mm: FloatArray, /) -> OddEven | None:
    """Compare the halves of a solution at points (n, 3) in its volume; None if it has none."""
    if len(solution.halves) < 2:
        return None
    odd, even = solution.halves
    calibration = solution.calibration
    sensitivity = point_sensitivity(list(calibration.cameras.values()), calibration.projector, points_mm)
    moves = sensitivity.by_parameter @ (odd.change - even.change)
    _, motion = remove_rigid_motion(points_mm, points_mm + moves)
    modes = np.concatenate([covariance_modes(odd.covariance), covariance_modes(even.covariance)], axis=1)
    difference, fields = (
        sensitivity.projection @ project_out_rigid_motion(points_mm, each)
        for each in (moves[:, :, None], sensitivity.by_parameter @ modes)
    )
    # The mean square over the volume is a quadratic form of independent modes; approximate its distribution by χ².
    flat = fields.reshape(-1, fields.shape[2]) / np.sqrt(len(points_mm))
    form = flat.T @ flat
    square, variance = float((difference**2).sum()) / len(points_mm), float(np.trace(form))
    freedom = variance**2 / float((form**2).sum())
    return OddEven(
        poses=(len(odd.poses), len(even.poses)),
        difference_mm=float(np.sqrt(square)),
        stated_mm=float(np.sqrt(variance)),
        chance=_chi_square_tail(freedom * square / variance, freedom),
        motion=motion,
    )


def _chi_square_tail(value: float, freedom: float) -> float:
    """Probability that χ² with this number of degrees of freedom is larger."""
    # Imported here: the service imports the classes of this module and calls none of its functions.
    from scipy.special import chdtrc

    return float(chdtrc(freedom, value))


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of one figure of a device, second minus first. sigma : its standard deviation from both solves, NaN
    if either states no error. words : a sentence about it.
    """

    value: float
    sigma: float
    words: str

    @property
    def sigmas(self) -> float:
        """Absolute difference over its σ; NaN if that is unknown."""
        return abs(self.value) / self.sigma if self.sigma > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class DeviceDifference:
    """Changes of one device, with the first camera's frame as the world of both calibrations.

    focal_percent : mean of fx and fy. principal_px : distance of the principal points. rotation_deg : angle between the
    two orientations, baseline_mm : change of the distance from the first camera; both None for the first camera itself.
    """

    focal_percent: Difference
    principal_px: Difference
    rotation_deg: Difference | None
    baseline_mm: Difference | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two calibrations. devices : those that both have. missing : those that only one has.

    moved_rms_mm, moved_max_mm : rms and maximum displacement of points in the volume that are measured from the same
    pixels with the second instead of the first, without their common rigid motion: turn_deg about the volume's centre
    and shift_mm of it. All NaN if neither states a volume, or they have only one device in common. words : sentences,
    the displacements first.
    """

    devices: Mapping[str, DeviceDifference]
    missing: tuple[str, ...]
    moved_rms_mm: float
    moved_max_mm: float
    turn_deg: float
    shift_mm: float
    words: tuple[str, ...]


def compare_calibrations(first: Calibration, second: Calibration) -> Comparison:
    """Compare a second calibration with the first.

    Raises
    ------
    CalibrationError
        They have no camera in common, or a device has different sizes: they are of two rigs.
    """
    _refuse_other_rigs(first, second)
    names = [name for name in devices_by_name(first) if name in devices_by_name(second)]
    origin = names[0]
    first_devices, second_devices = _relative_to(first, origin), _relative_to(second, origin)
    devices = {}
    for name in names:
        covariance = _stated_covariance(first, name) + _stated_covariance(second, name)
        is_origin = name == origin
        devices[name] = _compare_device(name, first_devices[name], second_devices[name], covariance, is_origin)
    moves_mm, motion = _point_moves(first_devices, second_devices, names, _volume_grid(first, second, origin))
    rms, most = (float(np.sqrt((moves_mm**2).mean())), float(moves_mm.max())) if len(moves_mm) else (np.nan, np.nan)
    rms, most = _round_off(rms), _round_off(most)
    missing = tuple(sorted(set(devices_by_name(first)) ^ set(devices_by_name(second))))
    words = [_describe_moves(rms, most, motion, shared=len(names))]
    words += [f"Only one calibration has {name}; it is not compared." for name in missing]
    for each in devices.values():
        parts = (each.focal_percent, each.principal_px, each.rotation_deg, each.baseline_mm)
        words += [part.words for part in parts if part is not None]
    return Comparison(devices, missing, rms, most, *motion, tuple(words))


def _refuse_other_rigs(first: Calibration, second: Calibration) -> None:
    first_devices, second_devices = devices_by_name(first), devices_by_name(second)
    faults = [
        f"{name} has {first_devices[name].size} pixels in one and {second_devices[name].size} in the other"
        for name in first_devices
        if name in second_devices and first_devices[name].size != second_devices[name].size
    ]
    if not set(first.cameras) & set(second.cameras):
        faults = [f"one has {', '.join(first.cameras)}, the other {', '.join(second.cameras)}"]
    if faults:
        message = f"the calibrations are of two rigs: {'; '.join(faults)}; compare two of one rig"
        raise CalibrationError(message)


def _relative_to(calibration: Calibration, origin: str) -> dict[str, Pinhole]:
    """All devices, with the frame of one camera as the world."""
    base = calibration.cameras[origin]
    devices = {}
    for name, device in devices_by_name(calibration).items():
        rotation = device.rotation @ base.rotation.T
        translation_mm = device.translation_mm - rotation @ base.translation_mm
        devices[name] = replace(device, rotation=rotation, translation_mm=translation_mm)
    return devices


def _stated_covariance(calibration: Calibration, name: str) -> FloatArray:
    """(15, 15) float64: covariance of one device, NaN if the calibration states none."""
    return np.where(calibration.solved is None, np.nan, device_covariance(calibration, name))


def _compare_device(
    name: str, first: Pinhole, second: Pinhole, covariance: FloatArray, is_origin: bool
) -> DeviceDifference:
    title = device_title(name)
    first_focal, second_focal = (float(each.matrix[[0, 1], [0, 1]].mean()) for each in (first, second))
    percent = 100 / first_focal
    focal = _difference(
        percent * (second_focal - first_focal),
        percent * _deviation(covariance[:2, :2], np.array([0.5, 0.5])),
        f"{title}: the focal length differs by {{value:+.3g}} %",
    )
    offset = second.matrix[:2, 2] - first.matrix[:2, 2]
    principal = _difference(
        float(np.linalg.norm(offset)),
        _deviation(covariance[2:4, 2:4], _direction(offset)),
        f"{title}: the principal point differs by {{value:.3g}} px",
    )
    if is_origin:
        return DeviceDifference(focal, principal, None, None)
    # Imported here: the service imports the classes of this module and calls none of its functions.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    rotation = _difference(
        float(np.degrees(np.linalg.norm(turn))),
        float(np.degrees(_deviation(covariance[9:12, 9:12], _direction(turn)))),
        f"{title}: the orientation differs by {{value:.3g}}°",
    )
    lengths = [float(np.linalg.norm(each.translation_mm)) for each in (first, second)]
    baseline = _difference(
        lengths[1] - lengths[0],
        _deviation(covariance[12:15, 12:15], _direction(first.translation_mm)),
        f"{title}: the distance from the first camera differs by {{value:+.3g}} mm",
    )
    return DeviceDifference(focal, principal, rotation, baseline)


def _difference(value: float, sigma: float, text: str) -> Difference:
    value = _round_off(value)
    text = text.format(value=value)
    if not sigma > 0:
        return Difference(value, sigma, f"{text}; its standard deviation is not known.")
    sigmas = abs(value) / sigma
    conclusion = "no more than chance" if sigmas <= MAX_CHANCE_SIGMAS else "a real change"
    return Difference(value, sigma, f"{text}, {sigmas:.1f} σ: {conclusion}.")


def _round_off(value: float) -> float:
    """Remove rounding errors of the computation. Zero has no sign."""
    return round(value, _DECIMALS) + 0.0


def _direction(vector: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    # Without a direction, all are equivalent: take the mean of them.
    return vector / length if length > 0 else np.full(len(vector), 1 / np.sqrt(len(vector)))


def _deviation(covariance: FloatArray, along: FloatArray) -> float:
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0))) if np.isfinite(covariance).all() else np.nan


def _volume_grid(first: Calibration, second: Calibration, origin: str) -> FloatArray:
    """(n, 3) float64: points in the volume of the first, else of the second, in the first camera's frame, mm."""
    for calibration in (first, second):
        if calibration.solved is not None:
            least, most = np.sort(calibration.solved.volume_mm, axis=0)
            axes = [np.linspace(low, high, _GRID) for low, high in zip(least, most, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            base = calibration.cameras[origin]
            return np.asarray(grid @ base.rotation.T + base.translation_mm, dtype=np.float64)
    return np.zeros((0, 3))


def _point_moves(
    first: Mapping[str, Pinhole], second: Mapping[str, Pinhole], names: list[str], points_mm: FloatArray
) -> tuple[FloatArray, RigidMotion]:
    """Displacement of points measured from the same pixels with other devices, (m,) float64 mm, beyond their common
    rigid motion; and that motion.

    Points are measured as by a scan: by both coordinates of each camera and the column of the projector.
    """
    unknown = RigidMotion(np.nan, np.nan)
    if not len(points_mm) or len(names) < 2:
        return np.zeros(0), unknown
    measured = _measure(first, names, points_mm)
    inside = np.isfinite(measured).all(axis=1)
    if not inside.any():
        return np.zeros(0), unknown
    points_mm, measured = points_mm[inside], measured[inside]
    found = points_mm.copy()
    for _ in range(_NEWTON_STEPS):
        residual = measured - _measure(second, names, found)
        steps = [_measure(second, names, found + _STEP_MM * axis) for axis in np.eye(3)]
        jacobian = np.stack([(step - _measure(second, names, found)) / _STEP_MM for step in steps], axis=-1)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        found = found + np.linalg.solve(normal, (jacobian.transpose(0, 2, 1) @ residual[..., None]))[..., 0]
    if not np.isfinite(found).all():
        return np.full(len(found), np.nan), unknown
    rest, motion = remove_rigid_motion(points_mm, found)
    return np.asarray(np.linalg.norm(rest, axis=1), dtype=np.float64), RigidMotion(*map(_round_off, motion))


def _measure(devices: Mapping[str, Pinhole], names: list[str], points_mm: FloatArray) -> FloatArray:
    """(n, k) float64: coordinates of points as the devices measure them; NaN behind a device."""
    parts = []
    for name in names:
        device = devices[name]
        in_device = points_mm @ device.rotation.T + device.translation_mm
        pixels, _ = cv2.projectPoints(in_device, np.zeros(3), np.zeros(3), device.matrix, device.distortion)
        in_front = np.where(in_device[:, 2:] > 0, pixels.reshape(-1, 2), np.nan)
        parts.append(in_front[:, :1] if name == PROJECTOR else in_front)
    return np.concatenate(parts, axis=1)


def _describe_moves(rms_mm: float, most_mm: float, motion: RigidMotion, *, shared: int) -> str:
    if shared < 2:
        return "The displacement of points is unknown: the calibrations have only one device in common."
    if not np.isfinite(rms_mm):
        return "The displacement of points is unknown: neither calibration states a working volume."
    return (
        f"Points in the working volume move by {rms_mm:.3g} mm rms and at most {most_mm:.3g} mm, in addition to "
        f"{motion.description} of all of them, which change no shape."
    )

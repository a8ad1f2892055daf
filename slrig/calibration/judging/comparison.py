"""Comparison of two calibrations: changes of each device in σ, the error that follows, and expected errors.

Points move together, as one rigid body, and each by itself. Only the second changes what is measured of a shape, so
that both are told apart (`slrig.calibration.displacement.without_rigid_motion`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from slrig.calibration.displacement import (
    Moved,
    RigidMotion,
    cell_centres,
    modes_of,
    moved_points,
    rigid_free,
    stated_deviation,
    without_rigid_motion,
)
from slrig.calibration.observations import COLUMN, ROW, Observations
from slrig.calibration.solution import (
    PROJECTOR,
    ExpectedError,
    Solution,
    covariance_of,
    device_title,
    devices_of,
    scale_mode,
)
from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, Pinhole, triangulated_axis

_PLACES = 1500  # wanted in the volume
_FEWEST_PLACES = 60
_MOST_NODES = 50_000
_MOST_STEPS = 150  # along the longest side
_LENGTHS = 4000
_PAPER = 0.05  # of the board's light comes from bright paper at the very least
_FITTED = 0.4675  # deviation of a quadratic surface, weighted by a Gaussian of 1.1 px, in the middle of 5 x 5 pixels
_LENGTH_TOLERANCE = 0.05
_MOST_PAIRED = 900  # places that are paired for lengths


def expected_error(
    solution: Solution, observations: Observations, /, *, noise_px: float | None = None
) -> ExpectedError:
    """Say what a scan with this calibration may be wrong by in the volume in which the board was held.

    noise_px : standard deviation of the light coordinate of one point of a scan: of its projector coordinate in
    projector pixels, or without a projector of its stripe's place across it in camera pixels. Unless it is given, it is
    that of the board's paper: of one pixel's light the 5 % quantile (ink is many times darker, and its light known as
    much worse), times 0.4675, because a scan finds a point by a small surface that it fits to 5 x 5 pixels. Where no
    light was observed, what rests on it is NaN; and for one camera alone, lengths too.

    Raises
    ------
    CalibrationError
        The board was not held in a volume that the devices see together.
    """
    calibration = solution.calibration
    volume_mm, places = volume_of(solution, observations)
    moved = _moved(calibration, places)
    fields = rigid_free(places, moved.by_parameter @ modes_of(solution.covariance))
    point_mm = stated_deviation(moved.stated, fields)
    if noise_px is None:
        noise_px = _light_sigma_px(observations, calibration)
    noise_mm = _rms(noise_px * stated_deviation(moved.stated, moved.by_noise))
    calibration_mm = _rms(point_mm)
    scale = solution.size.scale_sigma * scale_mode(calibration)
    board_mm = _rms(stated_deviation(moved.stated, rigid_free(places, moved.by_parameter @ scale[:, None])))
    diagonal_mm = float(np.linalg.norm(volume_mm[1] - volume_mm[0]))
    length_share = _length_share(places, fields, diagonal_mm) if calibration.can_triangulate else float("nan")
    return ExpectedError(
        volume_mm=volume_mm,
        point_mm=calibration_mm,
        noise_mm=noise_mm,
        total_mm=float(np.hypot(calibration_mm, noise_mm)),
        length_share=length_share,
        grid_mm=places,
        grid_point_mm=point_mm,
        across=not calibration.can_triangulate,
        board_mm=board_mm,
    )


def volume_of(solution: Solution, observations: Observations, /) -> tuple[FloatArray, FloatArray]:
    """The box of all corners of the board in the world, (2, 3) mm; and places in it, (n, 3), evenly spaced.

    The places lie in the convex hull of the corners, and where the first camera and the projector see them, or without
    a projector two cameras, or the one that there is.

    Raises CalibrationError where there is no such place, or the corners lie in one plane.
    """
    corners = _board_corners(solution, observations)
    volume_mm = np.stack([corners.min(axis=0), corners.max(axis=0)])
    extent = volume_mm[1] - volume_mm[0]
    try:
        hull = Delaunay(corners)
    except QhullError as cause:
        message = (
            f"expected the board in poses that span a volume, found all corners of {len(solution.poses)} poses in one "
            f"plane, in a box of {_words(extent)}; tilt the board, and hold it nearer and further away"
        )
        raise CalibrationError(message) from cause
    wanted = _PLACES
    while True:
        step = max(float(np.cbrt(extent.prod() / wanted)), float(extent.max()) / _MOST_STEPS)
        counts = np.maximum(np.ceil(extent / step).astype(int), 1)
        nodes = cell_centres(volume_mm, counts.tolist())
        nodes = nodes[hull.find_simplex(nodes) >= 0]
        places = nodes[_seen(solution.calibration, nodes)] if len(nodes) else nodes
        if len(places) >= _PLACES // 3 or wanted > _MOST_NODES:
            break
        wanted *= 4
    if len(places) < _FEWEST_PLACES:
        other = "the projector" if solution.calibration.projector else "another camera"
        whose = f" together with {other}" if solution.calibration.can_triangulate else ""
        message = (
            f"expected places in the box of {_words(extent)} in which the board was held that the first camera sees"
            f"{whose}, found {len(places)} of {counts.prod()}; hold the board where all of it is in view"
        )
        raise CalibrationError(message)
    return volume_mm, places


def _moved(calibration: Calibration, places: FloatArray) -> Moved:
    return moved_points(list(calibration.cameras.values()), calibration.projector, places)


def _seen(calibration: Calibration, nodes: FloatArray) -> NDArray[np.bool_]:
    seen = _moved(calibration, nodes).seen
    if calibration.projector is None:
        return seen
    first = next(iter(calibration.cameras.values()))
    return seen & _moved(Calibration({"first": first}, calibration.projector), nodes).seen


def _board_corners(solution: Solution, observations: Observations) -> FloatArray:
    """(n, 3) float64: every corner of the board in every pose that was used, in the world."""
    board = observations.board.points_mm
    if solution.board_shape_mm is not None:
        board = board + solution.board_shape_mm
    return np.concatenate([pose.placed(board) for pose in solution.poses.values()])


def _light_sigma_px(observations: Observations, calibration: Calibration) -> float:
    """What a scan makes of the light of the board's paper, along the axis that it triangulates by."""
    if calibration.projector is None:
        return float("nan")
    axis = triangulated_axis(list(calibration.cameras.values()), calibration.projector)
    wanted = COLUMN if axis is Axis.COLUMN else ROW
    found = [
        light.sigma_px[light.axis == wanted] for pose in observations.poses for light in pose.correspondences.values()
    ]
    sigma = np.concatenate([np.zeros(0), *found])
    return _FITTED * float(np.quantile(sigma, _PAPER)) if len(sigma) else float("nan")


def _length_share(places: FloatArray, fields: FloatArray, diagonal_mm: float) -> float:
    """Root mean square over many pairs of places, half a diagonal apart, of a length's deviation over that length."""
    paired = np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_PAIRED)).astype(int))
    first, second = (paired[index] for index in np.triu_indices(len(paired), 1))
    length = np.linalg.norm(places[second] - places[first], axis=1)
    right = np.abs(length / (diagonal_mm / 2) - 1) <= _LENGTH_TOLERANCE
    if not right.any():
        return float("nan")
    first, second, length = first[right], second[right], length[right]
    taken = np.unique(np.linspace(0, len(first) - 1, min(len(first), _LENGTHS)).astype(int))
    first, second, length = first[taken], second[taken], length[taken]
    direction = (places[second] - places[first]) / length[:, None]
    changes = np.einsum("ni,nik->nk", direction, fields[second] - fields[first])
    return _rms(np.sqrt((changes**2).sum(axis=1)) / length)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _words(extent: FloatArray) -> str:
    return " x ".join(f"{side:.0f}" for side in extent) + " mm"


LEAST_CHANCE = 0.003
"""Of a difference that is put down to chance: what lies beyond three standard deviations of a normal error."""


@dataclass(frozen=True, slots=True)
class OddEven:
    """How far two halves of the poses, solved apart, put points in the volume from one another.

    poses : how many each half has. difference_mm : root mean square over the volume, along the first camera's viewing
    ray, of one camera alone across it. stated_mm : what the two halves state for it, one standard deviation. chance :
    of a difference at least as large, if what is stated holds. motion : the rigid motion that was taken out before.
    """

    poses: tuple[int, int]
    difference_mm: float
    stated_mm: float
    chance: float
    motion: RigidMotion

    @property
    def ratio(self) -> float:
        """The difference over what is stated for it: about 1 where stated errors hold."""
        return self.difference_mm / self.stated_mm

    @property
    def fits(self) -> bool:
        """Whether the difference may be chance."""
        return self.chance >= LEAST_CHANCE

    @property
    def words(self) -> str:
        """What was found, and what to do where it does not fit."""
        told = (
            f"odd and even poses, solved apart, differ by {self.difference_mm:.2g} mm at a point, "
            f"{self.ratio:.2g} × what is stated for two halves"
        )
        if self.fits:
            return f"{told} ({self.motion.words} taken out)"
        return (
            f"{told}, more than chance: reckon with {self.difference_mm / 2:.2g} mm for the error of a point, besides "
            "what the board's size makes of it; see that the board is stiff, and that devices, focus and temperature "
            "stay as they are from pose to pose; shoot more poses, all over the volume"
        )


def odd_even(solution: Solution, places_mm: FloatArray, /) -> OddEven | None:
    """Compare the halves of a solution at places (n, 3) in its volume; None where it has none."""
    if len(solution.halves) < 2:
        return None
    odd, even = solution.halves
    calibration = solution.calibration
    moved = moved_points(list(calibration.cameras.values()), calibration.projector, places_mm)
    moves = moved.by_parameter @ (odd.change - even.change)
    _, motion = without_rigid_motion(places_mm, places_mm + moves)
    modes = np.concatenate([modes_of(odd.covariance), modes_of(even.covariance)], axis=1)
    off, fields = (
        moved.stated @ rigid_free(places_mm, each) for each in (moves[:, :, None], moved.by_parameter @ modes)
    )
    # Of the mean square over the volume: Σ over places of the stated parts, as a quadratic form of independent modes.
    flat = fields.reshape(-1, fields.shape[2]) / np.sqrt(len(places_mm))
    form = flat.T @ flat
    square, variance = float((off**2).sum()) / len(places_mm), float(np.trace(form))
    freedom = variance**2 / float((form**2).sum())
    return OddEven(
        poses=(len(odd.poses), len(even.poses)),
        difference_mm=float(np.sqrt(square)),
        stated_mm=float(np.sqrt(variance)),
        chance=_beyond(freedom * square / variance, freedom),
        motion=motion,
    )


def _beyond(value: float, freedom: float) -> float:
    """The chance that χ² with this freedom is larger."""
    # Late: the service knows the values of this module, and computes none of them.
    from scipy.special import chdtrc

    return float(chdtrc(freedom, value))


SAME_SIGMA = 3.0
"""A difference of up to so many of its own standard deviations may be chance."""

_GRID = 4
_TURNS = 10
_STEP_MM = 1e-3
_DECIMALS = 6  # a nanometre, a millionth of a degree or a percent: what is less is rounding, and told as 0


@dataclass(frozen=True, slots=True)
class Difference:
    """One figure of a device: second minus first, its standard deviation from both solves (NaN where either says
    nothing of its own error), and the sentence that tells it.
    """

    value: float
    sigma: float
    words: str

    @property
    def sigmas(self) -> float:
        """The size of the difference in its σ; NaN where that is not known."""
        return abs(self.value) / self.sigma if self.sigma > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class DeviceDifference:
    """What changed of one device, the first camera's frame being the world of both.

    focal_percent : mean of fx and fy. principal_px : distance of the principal points. rotation_deg : angle between the
    two orientations, baseline_mm : change of the distance from the first camera; both None of the first camera itself.
    """

    focal_percent: Difference
    principal_px: Difference
    rotation_deg: Difference | None
    baseline_mm: Difference | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two calibrations, compared. devices : those that both have. missing : those that only one has.

    moved_rms_mm, moved_most_mm : by how much points in the volume move that are measured with the second in place of
    the first, from the same pixels, once the rigid motion that they have in common is taken out: turn_deg about the
    volume's middle, and shift_mm of it. All NaN where neither names a volume, or they have but one device in common.
    words : one sentence each, the moves first.
    """

    devices: Mapping[str, DeviceDifference]
    missing: tuple[str, ...]
    moved_rms_mm: float
    moved_most_mm: float
    turn_deg: float
    shift_mm: float
    words: tuple[str, ...]


def comparison(first: Calibration, second: Calibration) -> Comparison:
    """Return what the second calibration says otherwise than the first.

    Raises
    ------
    CalibrationError
        They have no camera in common, or a device of another size: they are of two rigs.
    """
    _refuse_other_rigs(first, second)
    names = [name for name in devices_of(first) if name in devices_of(second)]
    origin = names[0]
    here, there = _seen_from(first, origin), _seen_from(second, origin)
    devices = {
        name: _device(name, here[name], there[name], _spread(first, name) + _spread(second, name), name == origin)
        for name in names
    }
    moved_mm, motion = _moves(here, there, names, _volume(first, second, origin))
    rms, most = (float(np.sqrt((moved_mm**2).mean())), float(moved_mm.max())) if len(moved_mm) else (np.nan, np.nan)
    rms, most = _told(rms), _told(most)
    missing = tuple(sorted(set(devices_of(first)) ^ set(devices_of(second))))
    words = [_move_words(rms, most, motion, shared=len(names))]
    words += [f"Only one of them has {name}; it is not compared." for name in missing]
    for each in devices.values():
        parts = (each.focal_percent, each.principal_px, each.rotation_deg, each.baseline_mm)
        words += [part.words for part in parts if part is not None]
    return Comparison(devices, missing, rms, most, *motion, tuple(words))


def _refuse_other_rigs(first: Calibration, second: Calibration) -> None:
    here, there = devices_of(first), devices_of(second)
    faults = [
        f"{name} has {here[name].size} pixels in one and {there[name].size} in the other"
        for name in here
        if name in there and here[name].size != there[name].size
    ]
    if not set(first.cameras) & set(second.cameras):
        faults = [f"one has {', '.join(first.cameras)}, the other {', '.join(second.cameras)}"]
    if faults:
        message = f"the calibrations are of two rigs: {'; '.join(faults)}; compare two of one rig"
        raise CalibrationError(message)


def _seen_from(calibration: Calibration, origin: str) -> dict[str, Pinhole]:
    """Every device with the frame of one camera as the world."""
    base = calibration.cameras[origin]
    found = {}
    for name, device in devices_of(calibration).items():
        rotation = device.rotation @ base.rotation.T
        shift = device.translation_mm - rotation @ base.translation_mm
        found[name] = replace(device, rotation=rotation, translation_mm=shift)
    return found


def _spread(calibration: Calibration, name: str) -> FloatArray:
    """(15, 15) float64: the covariance of one device, NaN where the calibration says nothing of its own error."""
    return np.where(calibration.solved is None, np.nan, covariance_of(calibration, name))


def _device(name: str, here: Pinhole, there: Pinhole, spread: FloatArray, is_origin: bool) -> DeviceDifference:
    title = device_title(name)
    focal_here, focal_there = (float(each.matrix[[0, 1], [0, 1]].mean()) for each in (here, there))
    share = 100 / focal_here
    focal = _difference(
        share * (focal_there - focal_here),
        share * _deviation(spread[:2, :2], np.array([0.5, 0.5])),
        f"{title}: the focal length differs by {{value:+.3g}} %",
    )
    offset = there.matrix[:2, 2] - here.matrix[:2, 2]
    principal = _difference(
        float(np.linalg.norm(offset)),
        _deviation(spread[2:4, 2:4], _direction(offset)),
        f"{title}: the principal point lies {{value:.3g}} px away",
    )
    if is_origin:
        return DeviceDifference(focal, principal, None, None)
    # Late: the service knows the values of this module, and computes none of them.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(there.rotation @ here.rotation.T).as_rotvec()
    rotation = _difference(
        float(np.degrees(np.linalg.norm(turn))),
        float(np.degrees(_deviation(spread[9:12, 9:12], _direction(turn)))),
        f"{title}: it is turned by {{value:.3g}}°",
    )
    lengths = [float(np.linalg.norm(each.translation_mm)) for each in (here, there)]
    baseline = _difference(
        lengths[1] - lengths[0],
        _deviation(spread[12:15, 12:15], _direction(here.translation_mm)),
        f"{title}: its distance from the first camera differs by {{value:+.3g}} mm",
    )
    return DeviceDifference(focal, principal, rotation, baseline)


def _difference(value: float, sigma: float, text: str) -> Difference:
    value = _told(value)
    told = text.format(value=value)
    if not sigma > 0:
        return Difference(value, sigma, f"{told}; how sure that is, is not known.")
    sigmas = abs(value) / sigma
    judged = "no more than chance" if sigmas <= SAME_SIGMA else "a real change"
    return Difference(value, sigma, f"{told}, {sigmas:.1f} σ: {judged}.")


def _told(value: float) -> float:
    """A figure without the rounding of its computation. Zero has no sign."""
    return round(value, _DECIMALS) + 0.0


def _direction(vector: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    # Without a direction every one is as good: the mean over all of them.
    return vector / length if length > 0 else np.full(len(vector), 1 / np.sqrt(len(vector)))


def _deviation(covariance: FloatArray, along: FloatArray) -> float:
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0))) if np.isfinite(covariance).all() else np.nan


def _volume(first: Calibration, second: Calibration, origin: str) -> FloatArray:
    """(n, 3) float64: places in the volume of the first, else of the second, in the first camera's frame; mm."""
    for calibration in (first, second):
        if calibration.solved is not None:
            least, most = np.sort(calibration.solved.volume_mm, axis=0)
            axes = [np.linspace(low, high, _GRID) for low, high in zip(least, most, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            base = calibration.cameras[origin]
            return np.asarray(grid @ base.rotation.T + base.translation_mm, dtype=np.float64)
    return np.zeros((0, 3))


def _moves(
    here: Mapping[str, Pinhole], there: Mapping[str, Pinhole], names: list[str], points_mm: FloatArray
) -> tuple[FloatArray, RigidMotion]:
    """(m,) float64: how far each point moves that is measured with other devices from the same pixels, mm, beyond the
    rigid motion of them all; and that motion.

    A point is measured as a scan does: by both coordinates of each camera and the column of the projector.
    """
    nowhere = RigidMotion(np.nan, np.nan)
    if not len(points_mm) or len(names) < 2:
        return np.zeros(0), nowhere
    measured = _pixels(here, names, points_mm)
    inside = np.isfinite(measured).all(axis=1)
    if not inside.any():
        return np.zeros(0), nowhere
    points_mm, measured = points_mm[inside], measured[inside]
    found = points_mm.copy()
    for _ in range(_TURNS):
        off = measured - _pixels(there, names, found)
        steps = [_pixels(there, names, found + _STEP_MM * axis) for axis in np.eye(3)]
        jacobian = np.stack([(step - _pixels(there, names, found)) / _STEP_MM for step in steps], axis=-1)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        found = found + np.linalg.solve(normal, (jacobian.transpose(0, 2, 1) @ off[..., None]))[..., 0]
    if not np.isfinite(found).all():
        return np.full(len(found), np.nan), nowhere
    left, motion = without_rigid_motion(points_mm, found)
    return np.asarray(np.linalg.norm(left, axis=1), dtype=np.float64), RigidMotion(*map(_told, motion))


def _pixels(devices: Mapping[str, Pinhole], names: list[str], points_mm: FloatArray) -> FloatArray:
    """(n, k) float64: what the devices measure of points; NaN behind one of them."""
    found = []
    for name in names:
        device = devices[name]
        turned = points_mm @ device.rotation.T + device.translation_mm
        pixels, _ = cv2.projectPoints(turned, np.zeros(3), np.zeros(3), device.matrix, device.distortion)
        seen = np.where(turned[:, 2:] > 0, pixels.reshape(-1, 2), np.nan)
        found.append(seen[:, :1] if name == PROJECTOR else seen)
    return np.concatenate(found, axis=1)


def _move_words(rms_mm: float, most_mm: float, motion: RigidMotion, *, shared: int) -> str:
    if shared < 2:
        return "By how much points move is not known: they have one device in common, and a point takes two."
    if not np.isfinite(rms_mm):
        return "By how much points move is not known: neither calibration names a working volume."
    return (
        f"Points in the working volume move by {rms_mm:.3g} mm rms, by {most_mm:.3g} mm at most, besides "
        f"{motion.words} that all of them share, which change no shape."
    )

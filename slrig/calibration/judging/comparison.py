"""Two calibrations of one rig, compared: what changed of each device, in its σ, and by how much points move for it.

Points move together, as one rigid body, and each by itself. Only the second changes what is measured of a shape, so
that both are told apart (`slrig.calibration.displacement.without_rigid_motion`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slrig.calibration.displacement import RigidMotion, without_rigid_motion
from slrig.calibration.solution import PROJECTOR, covariance_of, device_title, devices_of
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, Pinhole

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

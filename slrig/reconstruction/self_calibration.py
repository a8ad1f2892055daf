"""Calibration from the correspondences of scans alone, without a board.

A pixel of a camera and the pixel of the projector that shows the same point fulfil one equation: the projector pixel is
on the epipolar line of the camera pixel. One scan by columns and rows has 10^5 of them. They determine the relative
pose except for the length of the baseline, and, with prior knowledge of focal lengths and principal points, the lenses
(Hartley and Zisserman, Multiple View Geometry, 2004, chapters 9 and 19).

`self_calibrate` minimises Σ ρ((r / σ)²) / e + zᵀ z: r the distance from the epipolar line, projector pixels; ρ(x) =
2 √(1 + x) − 2; z the change of all parameters in standard deviations of the prior knowledge (a prior of mean 0 and
covariance L Lᵀ, change = L z). Parameters without prior variance stay. The same function therefore starts from rough
guesses of a new rig, and improves a calibration that a board gave.

Residuals of neighbours are alike, because no lens follows its model exactly. e is the design effect of that, and the
covariance is (1 + Jᵀ W J)⁻¹ with it. It determines the error of shape: the rms by which points move when the parameters
are drawn from it, after the best similarity, over the size of the scene. It is large, and the result is refused, for
views from one place and focal lengths that are hardly known. A flat scene has two solutions
(Longuet-Higgins 1986), and is refused as such.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slrig.errors import SolveRefusedError
from slrig.model import DEVICE_PARAMETERS, Calibration, FloatArray, Pinhole, Size
from slrig.model.lens import distort, distortion_by_terms
from slrig.reconstruction.calibration_check import PixelPairs, epipolar_residual_px, image_cells, share_in_front
from slrig.reconstruction.triangulation import pixel_rays

MAX_SHAPE_ERROR = 0.0015
"""Largest stated error of shape, over the size of the scene, of a calibration that is returned."""

_POINTS = 20_000  # of all pairs in a solve
_TRIAL_POINTS = 2000
_MIN_PAIRS = 500
_MAX_STEPS, _STEPS_PER_SIGMA, _LEAST_GAIN, _SAME_SIGMA = 100, 3, 0.01, 0.99
_MOST_SIGMA = 100.0  # in stated deviations, of a start
_MOST_DAMPING, _PROBE, _MOST_BEND = 1e9, 0.1, 0.75
_PIXEL_SIGMA_PX = 0.05  # of the coordinate that numbers the stripes
_LOSS_SCALE = 2.0  # of soft L1, in standard deviations
_CELLS, _LENS_CELLS = 8, 3  # along each side of the image
_LENS_FLOOR_PX, _FLOOR_RATIO = 0.005, 3.0  # no lens follows its model exactly
_MIN_IN_CELL = 20
_USUAL_EFFECT = 30.0  # design effect before there is an estimate
_MIN_IN_FRONT = 0.95
_DRAWS = 24
_SHAPE_POINTS = 400
_FLAT, _NARROW_DEG = 0.02, 1.5  # thickness of a scene over its extent; angle between rays
_SAME_PX, _MIN_SHARED = 2.0, 100  # places of the projector's image that two cameras see
_WIDE_TURN_RAD = 0.6  # of a pose that was found from the pairs: no knowledge from before


@dataclass(frozen=True, slots=True)
class DeviceGuess:
    """Prior knowledge of a device, before it is calibrated.

    focal_px : focal length; focal_sigma : its relative standard deviation. shift_px : place of the principal point from
    the middle of the image, (x, y). shift_sigma_px : its standard deviations.
    """

    size: Size
    focal_px: float
    focal_sigma: float
    shift_px: tuple[float, float] = (0.0, 0.0)
    shift_sigma_px: tuple[float, float] | None = None


_ASPECT_SIGMA = 0.001  # pixels are square
_CAMERA_SHIFT, _PROJECTOR_SHIFT, _LENS_SHIFT = 0.015, 0.015, 0.35  # of width, width and height
_LENS_SIGMAS = (0.15, 0.10, 5e-4, 5e-4, 0.0)  # k1, k2, p1, p2, k3


def guessed_calibration(
    cameras: Mapping[str, DeviceGuess], projector: DeviceGuess, /
) -> tuple[Calibration, FloatArray]:
    """Devices as guessed, all in one place, and the covariance of their lenses, (15 d, 15 d) float64; poses are open.

    A principal point that is not given is near the middle: to 1.5 % of the width, that of a projector along its rows to
    35 % of the height, for projectors shift their image up.
    """
    pinholes, blocks = [], []
    for is_projector, guess in [*((False, each) for each in cameras.values()), (True, projector)]:
        size, focal = guess.size, guess.focal_px
        middle = (np.array([size.width_px, size.height_px]) - 1) / 2 + guess.shift_px
        matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
        pinholes.append(Pinhole(size, matrix, np.zeros(5), np.eye(3), np.zeros(3)))
        width, height = size.width_px, size.height_px
        usual = (_PROJECTOR_SHIFT * width, _LENS_SHIFT * height) if is_projector else (_CAMERA_SHIFT * width,) * 2
        sigma = np.array([*(guess.shift_sigma_px or usual), *_LENS_SIGMAS])
        block = np.zeros((DEVICE_PARAMETERS,) * 2)
        block[:2, :2] = (focal * guess.focal_sigma) ** 2 + np.diag([(focal * _ASPECT_SIGMA) ** 2] * 2) / 2
        block[2:9, 2:9] = np.diag(sigma**2)
        blocks.append(block)
    covariance = np.zeros((DEVICE_PARAMETERS * len(blocks),) * 2)
    for index, block in enumerate(blocks):
        own = slice(DEVICE_PARAMETERS * index, DEVICE_PARAMETERS * (index + 1))
        covariance[own, own] = block
    return Calibration(dict(zip(cameras, pinholes, strict=False)), pinholes[-1]), covariance


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """A calibration from the pairs of scans.

    calibration : without its record of a solve; the first camera's frame is the world. covariance : (15 d, 15 d)
    float64, of cameras in order, then the projector. shape_error : stated error of the shape of the scene over its
    size, one standard deviation. size_mm : diagonal of the box around the scene. volume_mm : (2, 3) float64, that box.
    error_mm : shape_error as a length. pairs : number used. residual_px : robust standard deviation of the distances
    from epipolar lines. changes : of each device, relative change of the focal length and shift of the principal point
    in px, (3,) float64. contradiction : robust standard deviation of the distances from the prior's epipolar lines,
    over that which the prior covariance and the noise explain: about 1 where these hold.
    """

    calibration: Calibration
    covariance: FloatArray
    shape_error: float
    size_mm: float
    volume_mm: FloatArray
    pairs: int
    residual_px: float
    changes: Mapping[str, FloatArray]
    contradiction: float

    @property
    def error_mm(self) -> float:
        """Stated error of the shape, mm."""
        return self.shape_error * self.size_mm


def self_calibrate(
    prior: Calibration,
    covariance: FloatArray,
    scans: Sequence[Mapping[str, PixelPairs]],
    /,
    *,
    baseline_mm: float | None = None,
    most_error: float = MAX_SHAPE_ERROR,
) -> SelfCalibration:
    """Calibrate cameras and projector from the pairs of one or more scans.

    prior, covariance : prior knowledge, (15 d, 15 d). scans : of each, the pairs of its cameras by name.
    baseline_mm : distance of the first camera from the projector; where it is given, the poses of `prior` are ignored
    and found from the pairs. most_error : stated error of shape beyond which the result is refused.

    Raises
    ------
    SolveRefusedError
        There are too few pairs, none of the starts brings points in front of both devices, or the pairs leave the shape
        open.
    """
    problem = without_poses = _Problem.build(prior, covariance, scans)
    start = np.zeros(problem.free)
    if baseline_mm is not None:
        problem, start = _from_nothing(problem, baseline_mm)
    solved = problem.solve(_POINTS, start, _USUAL_EFFECT)
    # Once: a large effect moves the solution towards the prior, and larger residuals would increase it further.
    effect, contradiction, start = problem.design_effect(solved), problem.contradiction(solved), solved.z
    if baseline_mm is not None:
        # About the poses that were found, the baseline has the given length.
        lenses = start[: without_poses.free]
        problem, start = without_poses.at_poses(problem.devices(start), lenses, baseline_mm)
    solved = problem.solve(_POINTS, start, effect)
    devices = problem.devices(solved.z)
    share = problem.share_in_front(devices)
    if share < _MIN_IN_FRONT:
        message = (
            f"the pixels that camera and projector share fit no two devices: only {share:.0%} of the points would lie "
            "in front of both. The likeliest cause is a picture that is mirrored or turned, or a focal length that is "
            "far from its guess"
        )
        raise SolveRefusedError(message)
    found = problem.result(prior, solved, contradiction)
    # A plane has two solutions, and the covariance of one does not contain the other.
    if found.shape_error <= most_error and not (baseline_mm is not None and problem.thickness(devices) < _FLAT):
        return found
    raise SolveRefusedError(_explain_open_shape(problem, devices, found, most_error))


@dataclass(frozen=True, slots=True)
class _Solved:
    """z : (p,) float64, the change in standard deviations of the prior; cost : Σ ρ / effect + zᵀ z; sigma : scale of
    the residuals; effect : design effect; blocks : the pairs that were used.
    """

    z: FloatArray
    cost: float
    sigma: float
    effect: float
    blocks: list[tuple[int, PixelPairs]]


@dataclass(frozen=True, slots=True)
class _Problem:
    """Pairs of scans and the devices before the solve. blocks : index of a camera, and its pairs in one scan.

    root : (15 d, p) float64, L of the module's description.
    """

    before: tuple[Pinhole, ...]
    root: FloatArray
    blocks: list[tuple[int, PixelPairs]]

    @classmethod
    def build(cls, prior: Calibration, covariance: FloatArray, scans: Sequence[Mapping[str, PixelPairs]]) -> _Problem:
        if prior.projector is None:
            message = "a calibration without a projector has no pairs of both axes; calibrate the projector, too"
            raise SolveRefusedError(message)
        order = list(prior.cameras)
        blocks = [(order.index(name), _usable(pairs)) for scan in scans for name, pairs in scan.items()]
        usable = {index for index, pairs in blocks if len(pairs) >= _MIN_PAIRS}
        if len(usable) < len(order):
            missing = [name for index, name in enumerate(order) if index not in usable]
            most = max([len(pairs) for index, pairs in blocks if index not in usable], default=0)
            message = (
                f"camera {', '.join(map(repr, missing))}: expected at least {_MIN_PAIRS} pixels at which columns and "
                f"rows were decoded, found {most}; play both axes, and light more of the camera's view"
            )
            raise SolveRefusedError(message)
        return cls((*prior.cameras.values(), prior.projector), _root(covariance), blocks)

    @property
    def free(self) -> int:
        """Number of parameters."""
        return int(self.root.shape[1])

    def devices(self, z: FloatArray) -> tuple[Pinhole, ...]:
        changes = (self.root @ z).reshape(-1, DEVICE_PARAMETERS)
        return tuple(_changed(device, change) for device, change in zip(self.before, changes, strict=True))

    def at_poses(self, posed: Sequence[Pinhole], lenses: FloatArray, baseline_mm: float) -> tuple[_Problem, FloatArray]:
        """The problem about poses that have no prior but the length of the first baseline, and a start of its z.

        posed : devices with those poses; the lenses keep their priors about their guesses. lenses : z of these.
        """
        projector = posed[-1]
        scale = baseline_mm / float(np.linalg.norm(projector.centre_mm - posed[0].centre_mm))
        largest = {index: max((p for at, p in self.blocks if at == index), key=len) for index, _ in self.blocks}
        before = []
        for index, (guess, device) in enumerate(zip(self.before, posed, strict=True)):
            centre = device.centre_mm
            if 0 < index < len(posed) - 1:
                # Equations of two devices leave the length of each baseline open: depths of both cameras agree.
                ratio = _depth_ratio((posed[0], largest[0]), (device, largest[index]), projector)
                centre = projector.centre_mm + ratio * (centre - projector.centre_mm)
            before.append(replace(guess, rotation=device.rotation, translation_mm=-device.rotation @ centre * scale))
        poses = np.zeros((DEVICE_PARAMETERS * len(before),) * 2)
        for index, device in enumerate(before[1:], 1):
            at = DEVICE_PARAMETERS * index
            poses[at + 9 : at + 12, at + 9 : at + 12] = np.eye(3) * _WIDE_TURN_RAD**2
            other = before[-1] if index < len(before) - 1 else before[0]
            along = device.rotation @ (other.centre_mm - device.centre_mm)
            along /= np.linalg.norm(along)
            poses[at + 12 : at + 15, at + 12 : at + 15] = (np.eye(3) - np.outer(along, along)) * baseline_mm**2
        problem = replace(self, before=tuple(before), root=np.hstack([self.root, _root(poses)]))
        return problem, np.pad(lenses, (0, problem.free - self.free))

    def thinned(self, count: int) -> list[tuple[int, PixelPairs]]:
        each = max(_MIN_PAIRS // 4, count // len(self.blocks))
        return [(index, pairs.thinned(each)) for index, pairs in self.blocks]

    def solve(self, count: int, start: FloatArray, design_effect: float) -> _Solved:
        """Levenberg–Marquardt with weights of soft L1 over the design effect; the scale of the residuals is that of
        their median.

        A principal point and a turn explain each other along a curved valley, so each step is bent by the second
        derivative (geodesic acceleration: Transtrum and Sethna 2012).
        """
        blocks = self.thinned(count)
        z = start
        sigma, damping, quiet = _MOST_SIGMA, 1e-3, 0
        for step in range(_MAX_STEPS):
            devices = self.devices(z)
            if step % _STEPS_PER_SIGMA == 0:
                residuals = np.concatenate([_residuals(devices, index, pairs) for index, pairs in blocks])
                before = sigma
                sigma = min(sigma, float(np.clip(_scatter(residuals), 0.02, _MOST_SIGMA)))
                quiet = quiet if sigma > _SAME_SIGMA * before else 0
                cost = self._cost(z, blocks, sigma, design_effect)
            parts = [(*self._slopes(z, index, pairs), index, pairs) for index, pairs in blocks]
            weights = [_weights(residual / sigma) / sigma**2 / design_effect for residual, *_ in parts]
            matrix, gradient = np.eye(self.free), z.copy()
            for (residual, slopes, *_), weight in zip(parts, weights, strict=True):
                matrix += slopes.T @ (slopes * weight[:, None])
                gradient += slopes.T @ (weight * residual)
            tried = np.inf
            while damping < _MOST_DAMPING:
                damped = matrix + damping * np.diag(np.diagonal(matrix))
                change = -np.linalg.solve(damped, gradient)
                probe = self.devices(z + _PROBE * change)
                bend = np.zeros(self.free)
                for (residual, slopes, index, pairs), weight in zip(parts, weights, strict=True):
                    along = (_residuals(probe, index, pairs) - residual) / _PROBE
                    bend += slopes.T @ (weight * np.clip(2 / _PROBE * (along - slopes @ change), -1e6, 1e6))
                second = -0.5 * np.linalg.solve(damped, bend)
                if 2 * np.linalg.norm(second) <= _MOST_BEND * np.linalg.norm(change):
                    tried = self._cost(z + change + second, blocks, sigma, design_effect)
                    if tried < cost:
                        break
                damping *= 4
            if not tried < cost:
                break
            gain, z, cost, damping = cost - tried, z + change + second, tried, max(damping / 6, 1e-9)
            quiet = quiet + 1 if gain < _LEAST_GAIN else 0
            if quiet > _STEPS_PER_SIGMA:
                break
        return _Solved(z, cost, sigma, design_effect, blocks)

    def _cost(self, z: FloatArray, blocks: list[tuple[int, PixelPairs]], sigma: float, effect: float) -> float:
        """Σ ρ / effect + zᵀ z."""
        devices = self.devices(z)
        squares = [(_residuals(devices, index, pairs) / sigma / _LOSS_SCALE) ** 2 for index, pairs in blocks]
        loss = 2 * _LOSS_SCALE**2 * float(np.sum(np.sqrt(1 + np.concatenate(squares)) - 1))
        return loss / effect + float(z @ z)

    def _slopes(self, z: FloatArray, index: int, pairs: PixelPairs) -> tuple[FloatArray, FloatArray]:
        """Residuals (n,), in their stated deviations, and their derivatives by z, (n, p)."""
        devices, changes = self.devices(z), (self.root @ z).reshape(-1, DEVICE_PARAMETERS)
        camera, projector = devices[index], devices[-1]
        residual = _residuals(devices, index, pairs)
        a, of_camera, moves_camera = _ray_slopes(camera, pairs.camera_px)
        b, of_projector, moves_projector = _ray_slopes(projector, pairs.projector_px)
        base = projector.centre_mm - camera.centre_mm
        line = np.cross(base, a)
        # r = f n / l, with n = (base × a) · b, and l the length of the line's normal in the projector's image.
        normal = line @ projector.rotation.T
        with np.errstate(invalid="ignore", divide="ignore"):
            square = (normal[:, :2] ** 2).sum(axis=1, keepdims=True)
            scale = np.sqrt(projector.matrix[0, 0] * projector.matrix[1, 1] / square) / _sigma_px(pairs)[:, None]
            unit = np.column_stack([normal[:, :2] / square, np.zeros(len(normal))]) * residual[:, None]
        turned = unit @ projector.rotation
        by_base = scale * np.cross(a, b) - np.cross(a, turned)
        by_a = scale * np.cross(b, base) - np.cross(turned, base)
        slopes = np.zeros((len(a), DEVICE_PARAMETERS * len(devices)))
        own = DEVICE_PARAMETERS * index
        slopes[:, own : own + DEVICE_PARAMETERS] = np.einsum("ni,nij->nj", by_a, of_camera) - by_base @ moves_camera
        of_light = slopes[:, -DEVICE_PARAMETERS:]
        of_light += np.einsum("ni,nij->nj", scale * line, of_projector) + by_base @ moves_projector
        of_light[:, 9:12] -= np.cross(normal, unit)
        of_light[:, :2] += residual[:, None] / (2 * np.diagonal(projector.matrix)[:2])
        for at in (own, slopes.shape[1] - DEVICE_PARAMETERS):
            device, first = (devices[at // DEVICE_PARAMETERS], self.before[at // DEVICE_PARAMETERS])
            slopes[:, at] *= device.matrix[0, 0] / first.matrix[0, 0]
            slopes[:, at + 1] *= device.matrix[1, 1] / first.matrix[1, 1]
            turn = changes[at // DEVICE_PARAMETERS, 9:12]
            slopes[:, at + 9 : at + 12] = slopes[:, at + 9 : at + 12] @ _left_jacobian(turn)
        slopes = np.nan_to_num(slopes) @ self.root
        slopes[np.abs(residual) >= _LOST] = 0.0
        return residual, slopes

    def share_in_front(self, devices: Sequence[Pinhole]) -> float:
        return min(share_in_front(devices[index], devices[-1], pairs) for index, pairs in self.thinned(_TRIAL_POINTS))

    def design_effect(self, solved: _Solved) -> float:
        """Variance of sums of residuals over parts of the images, over that of independent ones.

        Residuals of neighbours are alike where a lens does not follow its model, or the code errs. A fit hides most of
        it; three times the rest in 8 x 8 cells is taken for that of 3 x 3 parts.
        """
        devices, effects = self.devices(solved.z), []
        for index, pairs in solved.blocks:
            residual = _residuals(devices, index, pairs)
            residual = np.clip(residual, -4 * _scatter(residual), 4 * _scatter(residual))
            stated = float(np.median(_sigma_px(pairs)))
            for device, pixels in ((devices[index], pairs.camera_px), (devices[-1], pairs.projector_px)):
                cell = image_cells(pixels, device.size, _CELLS)
                counts = np.bincount(cell, minlength=_CELLS**2)
                enough = counts >= _MIN_IN_CELL
                means = np.bincount(cell, residual, _CELLS**2)[enough] / counts[enough]
                square = float(np.mean(residual**2))
                left = float(np.mean(means**2 - square / counts[enough])) if enough.any() else 0.0
                floor = max(_LENS_FLOOR_PX / stated, _FLOOR_RATIO * np.sqrt(max(left, 0.0)))
                parts = np.bincount(image_cells(pixels, device.size, _LENS_CELLS))
                effects.append(1 + float(np.average(parts, weights=parts)) * floor**2 / square)
        return float(max(effects))

    def covariance(self, solved: _Solved) -> FloatArray:
        """(p, p): of z, with the prior."""
        matrix = np.eye(self.free)
        for index, pairs in solved.blocks:
            residual, slopes = self._slopes(solved.z, index, pairs)
            weight = _weights(residual / solved.sigma) / solved.sigma**2 / solved.effect
            matrix += slopes.T @ (slopes * weight[:, None])
        return np.asarray(np.linalg.inv(matrix))

    def contradiction(self, solved: _Solved) -> float:
        """Scatter of the residuals without a change, over what the prior and the residuals of the fit explain."""
        devices, unchanged = self.devices(solved.z), np.zeros(self.free)
        left = _scatter(np.concatenate([_residuals(devices, index, pairs) for index, pairs in solved.blocks]))
        ratios = []
        for index, pairs in solved.blocks:
            residual, slopes = self._slopes(unchanged, index, pairs)
            ratios.append(residual / np.sqrt(left**2 + (slopes**2).sum(axis=1)))
        return _scatter(np.concatenate(ratios))

    def thickness(self, devices: Sequence[Pinhole]) -> float:
        """Least extent of the scene over its largest."""
        points = self.points(devices, self.thinned(_TRIAL_POINTS))
        points = points[np.isfinite(points).all(axis=1)]
        extents = np.linalg.svd(points - np.median(points, axis=0), compute_uv=False)
        return float(extents[2] / extents[0])

    def points(self, devices: Sequence[Pinhole], pairs: Sequence[tuple[int, PixelPairs]]) -> FloatArray:
        return np.concatenate([triangulate(devices[index], devices[-1], each) for index, each in pairs])

    def result(self, prior: Calibration, solved: _Solved, contradiction: float) -> SelfCalibration:
        names, devices = [*prior.cameras, "projector"], self.devices(solved.z)
        covariance = self.covariance(solved)
        sample = self.thinned(_SHAPE_POINTS * len(self.blocks))
        here = self.points(devices, sample)
        known = np.isfinite(here).all(axis=1)
        low, high = np.percentile(here[known], (1, 99), axis=0)
        size_mm = float(np.linalg.norm(high - low))
        inside = known & (here >= low - 0.2 * size_mm).all(axis=1) & (here <= high + 0.2 * size_mm).all(axis=1)
        # The scale between cameras is that of depths which they share, and not in the covariance.
        camera = np.concatenate([np.full(len(pairs), index) for index, pairs in sample])
        parts = [inside & (camera == index) for index in range(len(devices) - 1)]
        values, directions = np.linalg.eigh(covariance)
        root = directions * np.sqrt(np.maximum(values, 0))
        squares = []
        for draw in np.random.default_rng(1).standard_normal((_DRAWS, self.free)):
            for sign in (-1.0, 1.0):
                moved = self.points(self.devices(solved.z + sign * (root @ draw)), sample)
                squares += [similarity_rms(here[part], moved[part]) ** 2 for part in parts]
        whole = self.root @ covariance @ self.root.T
        changes = {
            name: np.array([after.matrix[0, 0] / before.matrix[0, 0] - 1, *(after.matrix - before.matrix)[:2, 2]])
            for name, after, before in zip(names, devices, self.before, strict=True)
        }
        residuals = [epipolar_residual_px(devices[at], devices[-1], pairs) for at, pairs in solved.blocks]
        return SelfCalibration(
            replace(prior, cameras=dict(zip(prior.cameras, devices, strict=False)), projector=devices[-1], solved=None),
            (whole + whole.T) / 2,
            float(np.sqrt(np.mean(squares))) / size_mm,
            size_mm,
            np.stack([low, high]),
            sum(len(each) for _, each in solved.blocks),
            _scatter(np.concatenate(residuals)),
            changes,
            contradiction,
        )


_LOST = 1e6  # residual of a pixel that a lens does not image


def _residuals(devices: Sequence[Pinhole], index: int, pairs: PixelPairs) -> FloatArray:
    """(n,): distance from the epipolar line over its stated deviation."""
    distance = epipolar_residual_px(devices[index], devices[-1], pairs) / _sigma_px(pairs)
    return np.asarray(np.clip(np.nan_to_num(distance, nan=_LOST, posinf=_LOST, neginf=-_LOST), -_LOST, _LOST))


def _weights(residual: FloatArray) -> FloatArray:
    return np.asarray(1 / np.sqrt(1 + (residual / _LOSS_SCALE) ** 2))


def _ray_slopes(device: Pinhole, pixels_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """World rays of pixels (n, 3), at depth 1 in the device; their derivatives by its 15 parameters (n, 3, 15); and
    those of its centre (3, 15).
    """
    rays = pixel_rays(device, pixels_px)
    x, y = (rays @ device.rotation.T)[:, :2].T
    matrix, back = device.matrix, device.rotation.T
    xd, yd, xx, xy, yy = distort(device.distortion, x, y)
    terms = [np.stack(distortion_by_terms(*one, x, y)) for one in ((1.0, 0.0), (0.0, 1.0))]
    # distort(x, y) = ((u - cx) / fx, (v - cy) / fy) for every parameter.
    right = np.zeros((len(rays), 2, 9))
    right[:, 0, 0], right[:, 1, 1] = -xd / matrix[0, 0], -yd / matrix[1, 1]
    right[:, 0, 2], right[:, 1, 3] = -1 / matrix[0, 0], -1 / matrix[1, 1]
    right[:, 0, 4:], right[:, 1, 4:] = -terms[0].T, -terms[1].T
    with np.errstate(invalid="ignore", divide="ignore"):
        low = xx * yy - xy * xy
        inverse = np.stack([np.stack([yy, -xy], 1), np.stack([-xy, xx], 1)], 1) / low[:, None, None]
    plane = inverse @ right
    slopes = np.zeros((len(rays), 3, DEVICE_PARAMETERS))
    slopes[:, :, :9] = back[:, :2] @ plane
    # R' = exp([w]x) R: the ray Rᵀ d turns by -Rᵀ (w × d), the centre -Rᵀ t by Rᵀ (w × t).
    along = np.column_stack([x, y, np.ones(len(x))])
    slopes[:, :, 9:12] = back @ _cross_matrix(along)
    centre = np.zeros((3, DEVICE_PARAMETERS))
    centre[:, 9:12] = -back @ _cross_matrix(device.translation_mm[None])[0]
    centre[:, 12:] = -back
    return rays, slopes, centre


def _cross_matrix(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3): [v]x with [v]x w = v × w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack(row, 1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], 1)


def _left_jacobian(turn: FloatArray) -> FloatArray:
    """(3, 3): J with exp([turn + e]x) = exp([J e]x) exp([turn]x) for a small e."""
    angle = max(float(np.linalg.norm(turn)), 1e-9)
    cross = _cross_matrix(turn[None])[0]
    half = (1 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + half * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross)


def _usable(pairs: PixelPairs) -> PixelPairs:
    known = np.isfinite(np.column_stack([pairs.projector_px, pairs.camera_px])).all(axis=1)
    return pairs.take(np.flatnonzero(known))


def _sigma_px(pairs: PixelPairs) -> FloatArray:
    return np.hypot(pairs.sigma_px, _PIXEL_SIGMA_PX)


def _scatter(values: FloatArray) -> float:
    """Robust standard deviation about 0."""
    return 1.4826 * float(np.nanmedian(np.abs(values)))


def _root(covariance: FloatArray) -> FloatArray:
    """(n, p): L with L Lᵀ the covariance, without directions of no variance."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    scale[scale == 0] = 1.0
    values, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-9
    return np.asarray(scale[:, None] * directions[:, kept] * np.sqrt(values[kept]))


def _changed(device: Pinhole, change: FloatArray) -> Pinhole:
    """The device with a change (15,) of its parameters, in the order of `SolveRecord`."""
    matrix = device.matrix.copy()
    # An exponential, so that no step makes a focal length negative.
    matrix[0, 0] *= np.exp(np.clip(change[0] / device.matrix[0, 0], -2, 2))
    matrix[1, 1] *= np.exp(np.clip(change[1] / device.matrix[1, 1], -2, 2))
    matrix[:2, 2] += change[2:4]
    rotation = np.asarray(cv2.Rodrigues(change[9:12])[0]) @ device.rotation
    return Pinhole(device.size, matrix, device.distortion + change[4:9], rotation, device.translation_mm + change[12:])


def triangulate(camera: Pinhole, projector: Pinhole, pairs: PixelPairs, /) -> FloatArray:
    """(n, 3) float64, mm: the middle of the shortest line between the rays of both pixels; NaN for parallel rays."""
    a, b = pixel_rays(camera, pairs.camera_px), pixel_rays(projector, pairs.projector_px)
    base = projector.centre_mm - camera.centre_mm
    aa, ab, bb, ac, bc = ((p * q).sum(axis=1) for p, q in ((a, a), (a, b), (b, b), (a, base), (b, base)))
    with np.errstate(invalid="ignore", divide="ignore"):
        low = aa * bb - ab * ab
        s, t = (bb * ac - ab * bc) / low, (ab * ac - aa * bc) / low
    return np.asarray((camera.centre_mm + s[:, None] * a + projector.centre_mm + t[:, None] * b) / 2)


def similarity_rms(first: FloatArray, second: FloatArray, /) -> float:
    """Rms distance of points (n, 3) from others after the best similarity, in the unit of the first (Umeyama 1991)."""
    good = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    first, second = first[good], second[good]
    a, b = first - first.mean(axis=0), second - second.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * sign).sum() / np.maximum((b**2).sum(), 1e-300))
    return float(np.sqrt(((a - scale * b @ (u * sign @ vt).T) ** 2).sum(axis=1).mean()))


def _from_nothing(problem: _Problem, baseline_mm: float) -> tuple[_Problem, FloatArray]:
    """The problem about poses that the pairs give, which have no prior but the length of the first baseline.

    The pose of every camera to the projector starts from the essential matrix (Nistér 2004), for several shifts of the
    projector's lens.
    """
    best: list[tuple[float, float, _Problem, FloatArray]] = []
    height = problem.before[-1].size.height_px
    for shift in (0.0, 0.25, -0.25, 0.5, -0.5):
        poses = _start_poses(problem, shift * height, baseline_mm)
        if poses is None:
            continue
        lenses = np.asarray(np.linalg.pinv(problem.root) @ _lens_change(problem, shift * height))
        trial, start = problem.at_poses(poses, lenses, baseline_mm)
        solved = trial.solve(_TRIAL_POINTS, start, _USUAL_EFFECT)
        found = trial.devices(solved.z)
        if trial.share_in_front(found) >= _MIN_IN_FRONT:
            # Once more, about the pose that was found: the directions without a prior are those of that pose.
            best.append((solved.cost, solved.sigma, *problem.at_poses(found, solved.z[: problem.free], baseline_mm)))
    if not best:
        message = (
            "no pose of camera and projector explains the pixels that they share. The likeliest causes: camera and "
            "projector have almost one position, a picture is mirrored, or a focal length is far from its guess"
        )
        raise SolveRefusedError(message)
    _, _, nearest, start = min(best, key=lambda each: (each[1] > 2 * min(one[1] for one in best), each[0]))
    return nearest, start


def _lens_change(problem: _Problem, shift_px: float) -> FloatArray:
    """(15 d,): change of the projector's lens shift alone."""
    change = np.zeros(len(problem.root))
    change[-DEVICE_PARAMETERS + 3] = shift_px
    return change


def _start_poses(problem: _Problem, shift_px: float, baseline_mm: float) -> Sequence[Pinhole] | None:
    """The devices with a pose each; None where the pairs of a camera give none."""
    projector = problem.before[-1]
    matrix = projector.matrix.copy()
    matrix[1, 2] += shift_px
    shifted = replace(projector, matrix=matrix)
    relative: list[tuple[FloatArray, FloatArray]] = []
    for index in range(len(problem.before) - 1):
        pairs = max((pairs for at, pairs in problem.blocks if at == index), key=len).thinned(2 * _TRIAL_POINTS)
        camera = problem.before[index]
        here, there = (pixel_rays(each, px)[:, :2] for each, px in (
            (replace(camera, rotation=np.eye(3), translation_mm=np.zeros(3)), pairs.camera_px),
            (replace(shifted, rotation=np.eye(3), translation_mm=np.zeros(3)), pairs.projector_px),
        ))  # fmt: skip
        essential, mask = cv2.findEssentialMat(
            here, there, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=3.0 / projector.matrix[0, 0], maxIters=500
        )
        if essential is None or essential.shape != (3, 3):
            return None
        _, rotation, shift, _ = cv2.recoverPose(essential, here, there, np.eye(3), mask=mask)
        relative.append((rotation, shift.ravel()))
    rotation, direction = relative[0]
    posed = [replace(problem.before[0], rotation=np.eye(3), translation_mm=np.zeros(3))]
    pose = replace(shifted, rotation=rotation, translation_mm=direction * baseline_mm)
    for index, (turn, shift) in enumerate(relative[1:], 1):
        # x_p = R₀ x₀ + t₀ = R x + t, with lengths of all baselines alike so far; see `_Problem.at_poses`.
        posed.append(
            replace(problem.before[index], rotation=turn.T @ rotation,
                    translation_mm=turn.T @ (direction - shift) * baseline_mm)
        )  # fmt: skip
    return [*posed, pose]


def _depth_ratio(camera: tuple[Pinhole, PixelPairs], other: tuple[Pinhole, PixelPairs], projector: Pinhole) -> float:
    """Median ratio of the depths along the same pixels of the projector, by one camera and by another one.

    Raises SolveRefusedError: the cameras share too few of them.
    """
    depths, places = [], []
    for device, pairs in (camera, other):
        points = triangulate(device, projector, pairs)
        depths.append(points @ projector.rotation[2] + projector.translation_mm[2])
        column, row = np.rint(pairs.projector_px / _SAME_PX).astype(np.int64).T
        places.append(row * 100_000 + column)
    _, one, two = np.intersect1d(*places, return_indices=True)
    if len(one) < _MIN_SHARED:
        message = (
            f"expected at least {_MIN_SHARED} places of the projected image that two cameras see, to find their "
            f"relative pose, found {len(one)}; put something before the rig that both see, or scan with one"
        )
        raise SolveRefusedError(message)
    return float(np.nanmedian(depths[0][one] / depths[1][two]))


def _explain_open_shape(problem: _Problem, devices: Sequence[Pinhole], found: SelfCalibration, most: float) -> str:
    """Explain why the pairs leave the shape open, and what to do."""
    index, pairs = max(problem.blocks, key=lambda each: len(each[1]))
    points = triangulate(devices[index], devices[-1], pairs.thinned(_POINTS))
    points = points[np.isfinite(points).all(axis=1)]
    rays = [points - device.centre_mm for device in (devices[index], devices[-1])]
    a, b = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays)
    angle = float(np.degrees(np.median(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))))
    stated = f"the scan determines the shape to {found.shape_error:.2%} of its size only, and {most:.2%} are allowed"
    if angle < _NARROW_DEG:
        return (
            f"{stated}: camera and projector see the scene from nearly the same place ({angle:.1g}° apart). Move them "
            "apart, by a third of the distance to the object"
        )
    if problem.thickness(devices) < _FLAT:
        return (
            "the scene is flat, and a plane fits many lenses and two poses. Put something with depth "
            "before the rig: a box with a corner towards it, or several things one behind the other"
        )
    lens = max(found.changes, key=lambda name: _focal_sigma(found, name))
    return (
        f"{stated}: the scene has too little depth for lenses that are known so roughly ({_device(lens)}: focal length "
        f"to {_focal_sigma(found, lens):.1%}). Show more depth, state the focal length from the data sheet more "
        "closely, or allow a larger error"
    )


def _device(name: str) -> str:
    return "the projector" if name == "projector" else f"camera '{name}'"


def _focal_sigma(found: SelfCalibration, name: str) -> float:
    """Relative standard deviation of a device's focal length."""
    devices = {**found.calibration.cameras, "projector": found.calibration.projector}
    at = DEVICE_PARAMETERS * list(devices).index(name)
    device = devices[name]
    return 0.0 if device is None else float(np.sqrt(found.covariance[at, at]) / device.matrix[0, 0])

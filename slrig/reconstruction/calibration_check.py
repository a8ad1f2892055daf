"""Test of a calibration by light of both axes.

A camera pixel with a decoded column c and row r gives two rays. For the right calibration they intersect, which is one
equation more than the three unknowns of the point: the projector pixel (c, r) is on the epipolar line of the camera
pixel. The distance from that line is the residual, in projector pixels.

The residuals determine five of the six parameters of the relative pose (not the length of the baseline), so that they
show errors of depth, too: `fit_calibration` searches the smallest change of pose and lenses that explains them, and
`CalibrationFit.displacement_mm` is its effect on each point. If the residuals are larger than any small change,
`explain_residuals` tries mistakes that people and programs make, and names the one that brings agreement.

Two cameras that decode both axes test their calibration in the same way without that of the projector: pixels that show
one projector pixel are on each other's epipolar lines. The second camera takes the place of the projector then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy import linalg
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, Gray, LineShift, Pinhole, Size, from_gray, to_gray
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.phase import has_phase
from slrig.reconstruction.second_axis import AxisPositions, SecondAxis, find_crossings
from slrig.reconstruction.stripes import sample_image
from slrig.reconstruction.triangulation import pixel_rays, project

_MAX_POINTS = 20_000  # of a check; their mean is known to a hundredth of their scatter
_EDGE_SIGMA_PX = 0.1  # of a code edge along a stripe
_FIT_POINTS = 8_000
_TRIAL_POINTS = 1_000
_MIN_POINTS, _MIN_READ = 200, 0.3  # points, and share of the stripe points whose second code is read
_CELLS = 8  # along each side of the image, for the systematic part of the residuals
_MIN_CELL_POINTS = 30
_LENS_CELLS = 3  # along each side: errors of lenses are smooth
_MIN_FLOOR_PX, _FLOOR_RATIO = 0.01, 3.0  # of such errors, relative to what a fit leaves
_MIN_IN_FRONT = 0.9  # share of points in front of both devices, for a calibration that can be right
_AGREES_PX = 0.5  # median residual of a right calibration with code cells of one pixel is 0.15 px
_REFUTED_PX, _REFUTED_SIGMA = 5.0, 20.0
_MAX_SYSTEMATIC_PX = 0.1  # of a right calibration
_SIGNIFICANT_CHI2 = 10.0  # for each parameter of a fit: by chance once in 10^8 scans
_MANY_FAR, _FEW_FAR = 0.1, 0.2  # share of points that are far off; of those, without a mistake
_MIN_DETERMINED = 2.0  # standard deviations of an implied error of the coded position
_PRIOR_FOCAL, _PRIOR_CENTRE, _PRIOR_K1 = 0.03, 0.03, 0.05  # relative to focal length and width; radial distortion
_MAX_LOG_SCALE, _MAX_SHIFT = np.log(4), 1.0  # of a picture; the shift relative to its width
_SCALES = [np.array([each]) for each in np.linspace(-1.3, 1.3, 57)]
_OUTLIER_SIGMA = 3.0  # scale of the robust loss
_MAX_CAUSES, _AS_SIMPLE = 2, 4  # causes to name, and free parameters between equally likely ones
_IMPROVED = 0.7  # ratio of a cause's residual to that of the stated calibration
_SIMPLER = 1.5  # a cause without free parameters is preferred up to this ratio of residuals
_MAX_LENS_PX = 2.0  # residual of the best pose beyond which no small change of a lens helps
_MAX_TURN_DEG = 20.0  # more is not a device that moved a little
_STRIPE_SIGMA_PX = 0.1  # of a stripe point
_LENS_PX = 1.0  # residual that lens models of two cameras may leave
_MAX_STEP_PX = 4.0  # between neighbouring points of a stripe, to interpolate between them


@dataclass(frozen=True, slots=True)
class PixelPairs:
    """Pixels of a camera and of the projector that show the same point.

    camera_px, projector_px : (n, 2) float64, (column, row); sigma_px : (n,) float64, standard deviation of the
    coordinate of the second axis; axis : the one that numbers the stripes, whose coordinate is exact. period_px : the
    second coordinate may be off by multiples of it; infinite if it is known.
    """

    camera_px: FloatArray
    projector_px: FloatArray
    sigma_px: FloatArray
    axis: Axis
    period_px: float = np.inf

    def __len__(self) -> int:
        return len(self.camera_px)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> PixelPairs:
        """Select some."""
        return replace(
            self,
            camera_px=self.camera_px[index],
            projector_px=self.projector_px[index],
            sigma_px=self.sigma_px[index],
        )

    def thinned(self, count: int) -> PixelPairs:
        """At most about `count`, evenly from all."""
        return self.take(slice(None, None, max(1, len(self) // count)))


def find_correspondences(ensemble: StripeEnsemble, second: SecondAxis, axis: Axis) -> PixelPairs:
    """Projector pixels of stripe points: by phase at up to 20 000 points, otherwise where stripes cross code edges.

    axis : the one that numbers the stripes. None are returned where the second code is read at few of the points: it
    may be noise.
    """
    points = ensemble.points_px
    coded = np.repeat(ensemble.position_px, np.diff(ensemble.offsets))
    if len(points) == 0 or np.isfinite(second.positions.sample(points)[0]).mean() < _MIN_READ:
        return PixelPairs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), axis)
    if has_phase(second.frames):
        return read_pairs(ensemble, second.positions, axis, step=max(1, len(points) // _MAX_POINTS))
    index, share, other = second.edges(points, ensemble.ends)
    points = points[index] + share[:, None] * (points[index + 1] - points[index])
    return _make_pairs(points, coded[index], other, np.full(len(index), _EDGE_SIGMA_PX), axis)


def read_pairs(ensemble: StripeEnsemble, positions: AxisPositions, axis: Axis, *, step: int = 1) -> PixelPairs:
    """Projector pixels of every `step`-th stripe point at which the second axis is read, between code edges, too.

    axis : the one that numbers the stripes.
    """
    points = ensemble.points_px[::step]
    coded = np.repeat(ensemble.position_px, np.diff(ensemble.offsets))[::step]
    other, sigma = positions.sample(points)
    return _make_pairs(points, coded, other, sigma, axis).take(np.isfinite(other))


def _make_pairs(points: FloatArray, coded: FloatArray, other: FloatArray, sigma: FloatArray, axis: Axis) -> PixelPairs:
    """coded, other : positions along the axis that numbers the stripes, and along the second one."""
    pair = (coded, other) if axis is Axis.COLUMN else (other, coded)
    return PixelPairs(points, np.column_stack(pair), sigma, axis)


def find_cross_line_pairs(
    ensemble: StripeEnsemble, difference: NDArray[np.float32], lines: LineShift, camera: Pinhole, projector: Pinhole, /,
    *, origin_px: tuple[int, int] = (0, 0),
) -> PixelPairs:  # fmt: skip
    """Projector pixels where stripes cross the edges of half-lit lines along the other axis, played once.

    difference : (H, W), light of that frame minus the middle of white and black. Which of the edges a crossing belongs
    to is not known: it gets the one nearest to the calibration's prediction. origin_px : pixel of the camera at the
    first pixel of `difference` and of the stripes.
    """
    axis = lines.axis.other
    index, share = find_crossings(ensemble.points_px, ensemble.ends, sample_image(difference, ensemble.points_px))
    points = ensemble.points_px[index]
    points = points + share[:, None] * (ensemble.points_px[index + 1] - points) + np.array(origin_px)
    coded = np.repeat(ensemble.position_px, np.diff(ensemble.offsets))[index]
    along = 1 if axis is Axis.COLUMN else 0
    middle_px = np.full(len(index), (projector.size.along(lines.axis) - 1) / 2)
    pair = np.column_stack((coded, middle_px) if along else (middle_px, coded))
    pairs = PixelPairs(points, pair, np.full(len(index), _EDGE_SIGMA_PX), axis, float(lines.line_width_px))
    depth = coded_depth_mm(camera, projector, pairs)[:, None]
    predicted = project(projector, camera.centre_mm + depth * pixel_rays(camera, points))[:, along]
    first_px = lines.shift - 0.5
    steps = np.rint((np.where(np.isfinite(predicted), predicted, middle_px) - first_px) / lines.line_width_px)
    numbered = pair.copy()
    numbered[:, along] = first_px + steps * lines.line_width_px
    return replace(pairs, projector_px=numbered)


def find_camera_pairs(first: PixelPairs, second: PixelPairs, cameras: tuple[Pinhole, Pinhole], /) -> PixelPairs:
    """Pixels of two cameras that show the same projector pixel; those of the second are in `projector_px`.

    first, second : camera and projector pixels of each camera. A projector pixel of the first is looked up on the
    stripe of the second that has its position: at a point, or between two that are at most 4 px apart. The axis is that
    of the second camera's image along which the baseline lies.
    """
    along = 0 if first.axis is Axis.COLUMN else 1
    baseline = cameras[1].rotation @ (cameras[0].centre_mm - cameras[1].centre_mm)
    axis = Axis.COLUMN if abs(baseline[0]) >= abs(baseline[1]) else Axis.ROW
    # Complex numbers are in the order of their real parts, the position of the stripe, and then of the others.
    wanted, keys = (each.projector_px[:, along] + 1j * each.projector_px[:, 1 - along] for each in (first, second))
    if len(second) < 2:
        return PixelPairs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), axis)
    order = np.argsort(keys, kind="stable")
    keys, pixels = keys[order], second.camera_px[order]
    step, apart = np.diff(keys), np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    joined = (step.real == 0) & (apart <= _MAX_STEP_PX)
    after = np.clip(np.searchsorted(keys, wanted), 1, len(keys) - 1)
    same = keys[after] == wanted
    between = joined[after - 1] & (keys[after].real == wanted.real) & (keys[after - 1].real == wanted.real)
    moved = joined & (step.imag > 0)
    scale = float(np.median(apart[moved] / step.imag[moved])) if moved.any() else 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(same, 1.0, (wanted - keys[after - 1]).imag / step.imag[after - 1])
    found = pixels[after - 1] + share[:, None] * (pixels[after] - pixels[after - 1])
    sigma = np.hypot(scale * np.hypot(first.sigma_px, float(np.median(second.sigma_px))), _STRIPE_SIGMA_PX)
    known = (same | between) & np.isfinite(found).all(axis=1)
    return PixelPairs(first.camera_px, found, sigma, axis).take(known)


@dataclass(frozen=True, slots=True)
class DeviceNames:
    """Names in messages of the two devices that are tested, and of the image that each makes.

    is_pair : True if the second is a camera, too.
    """

    camera: str = "camera"
    projector: str = "projector"
    picture: str = "camera's picture"
    image: str = "projected image"
    code: str = "projected code"
    is_pair: bool = False

    @classmethod
    def of_cameras(cls, first: str, second: str) -> DeviceNames:
        """Those of two cameras, by their names."""
        one, other = f"camera '{first}'", f"camera '{second}'"
        return cls(one, other, f"picture of {one}", f"picture of {other}", f"picture of {other}", is_pair=True)

    def the(self, device: str) -> str:
        """A device in a sentence."""
        return device if self.is_pair else f"the {device}"


_CAMERA_AND_PROJECTOR = DeviceNames()


@dataclass(frozen=True, slots=True)
class _RayPairs:
    """Rays of both devices in the world, (n, 3) each, and the geometry for the epipolar distance."""

    camera: FloatArray
    projector: FloatArray
    baseline_mm: FloatArray
    rotation: FloatArray
    focal_px: float
    along: int
    period_px: float

    @classmethod
    def from_devices(cls, camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> _RayPairs:
        return cls(
            pixel_rays(camera, pairs.camera_px),
            pixel_rays(projector, pairs.projector_px),
            projector.centre_mm - camera.centre_mm,
            projector.rotation,
            float(np.sqrt(projector.matrix[0, 0] * projector.matrix[1, 1])),
            1 if pairs.axis is Axis.COLUMN else 0,
            pairs.period_px,
        )

    def residual_px(self) -> FloatArray:
        """(n,) distance of each projector pixel from its epipolar line; NaN where a lens images no such pixel."""
        line = np.cross(self.baseline_mm, self.camera) @ self.rotation.T
        pixel = self.projector @ self.rotation.T
        with np.errstate(invalid="ignore", divide="ignore"):
            length = np.hypot(line[:, 0], line[:, 1])
            distance = (line * pixel).sum(axis=1) / pixel[:, 2] / length * self.focal_px
            if np.isfinite(self.period_px):
                period = self.period_px * np.abs(line[:, self.along]) / length
                distance -= period * np.rint(distance / period)
        return np.asarray(distance)

    def in_front(self) -> float:
        """Share of the points in front of both devices."""
        cc, cp, pp = ((a * b).sum(axis=1) for a, b in (
            (self.camera, self.camera), (self.camera, self.projector), (self.projector, self.projector)
        ))  # fmt: skip
        cb, pb = self.camera @ self.baseline_mm, self.projector @ self.baseline_mm
        with np.errstate(invalid="ignore"):
            return float(np.mean((pp * cb - cp * pb > 0) & (cp * cb - cc * pb > 0)))


def epipolar_residual_px(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> FloatArray:
    """(n,) float64: distance of each projector pixel from the epipolar line of its camera pixel."""
    return _RayPairs.from_devices(camera, projector, pairs).residual_px()


def disagreement_px(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> float:
    """Median distance from the epipolar line; infinite if points are behind a device or lenses image no such pixels."""
    rays = _RayPairs.from_devices(camera, projector, pairs)
    distance = np.abs(rays.residual_px())
    if np.isfinite(distance).mean() < _MIN_IN_FRONT or rays.in_front() < _MIN_IN_FRONT:
        return float("inf")
    return float(np.nanmedian(distance))


def share_in_front(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> float:
    """Share of the points of the coded position alone that lie in front of both devices."""
    # The other coordinate does not matter: where it is unknown, the middle of the image gives the same sheet of light.
    middle = (np.array([projector.size.width_px, projector.size.height_px]) - 1) / 2
    known = np.where(np.isfinite(pairs.projector_px), pairs.projector_px, middle)
    depth = coded_depth_mm(camera, projector, replace(pairs, projector_px=known))
    points = camera.centre_mm + depth[:, None] * pixel_rays(camera, pairs.camera_px)
    ahead = points @ projector.rotation[2] + projector.translation_mm[2]
    return float(np.mean((depth > 0) & (ahead > 0)))


def coded_depth_mm(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> FloatArray:
    """(n,) depth along each camera ray at which it meets the light sheet of the coded position."""
    along = 1 if pairs.axis is Axis.COLUMN else 0
    step = np.zeros(2)
    step[along] = 1.0
    ends = [pixel_rays(projector, pairs.projector_px + sign * step) for sign in (-1, 1)]
    normal = np.cross(ends[0], ends[1])
    rays = pixel_rays(camera, pairs.camera_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(normal @ (projector.centre_mm - camera.centre_mm) / (normal * rays).sum(axis=1))


@dataclass(frozen=True, slots=True)
class CalibrationFit:
    """Smallest change of the calibration that explains the residuals of both axes.

    camera, projector : as fitted, with the length of the baseline as it was; stated : the devices before. turned_deg,
    shifted_mm : motion of the projector relative to the camera. residual_px : median absolute residual afterwards.
    coded_error_px, coded_sigma_px : median error of the coded position by the stated calibration, and its standard
    deviation. is_significant : True if the change is larger than noise makes.
    """

    stated: tuple[Pinhole, Pinhole]
    camera: Pinhole
    projector: Pinhole
    turned_deg: float
    shifted_mm: float
    residual_px: float
    coded_error_px: float
    coded_sigma_px: float
    is_significant: bool

    def displacement_mm(self, points_mm: FloatArray, axis: Axis) -> FloatArray:
        """(n, 3) float64: points by the fitted calibration minus those by the stated one.

        Both have the camera pixel of the point and its position along `axis`.
        """
        camera, projector = self.stated
        pairs = PixelPairs(project(camera, points_mm), project(projector, points_mm), np.zeros(0), axis)
        ray = pixel_rays(self.camera, pairs.camera_px)
        depth = coded_depth_mm(self.camera, self.projector, pairs)
        return np.asarray(self.camera.centre_mm + depth[:, None] * ray - points_mm)


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """Residuals of both axes of one camera, and their explanation.

    devices : camera and projector; axis : the one whose position gives the depth; pairs : number of points compared;
    sigma_px : median standard deviation of a residual by noise and resolution; median_px : median absolute residual;
    systematic_px : rms of the means over the 8 x 8 cells of the image, less the noise. cause : mistake that
    explains residuals that refute the calibration, empty if none is found or needed.
    """

    devices: tuple[Pinhole, Pinhole]
    axis: Axis
    pairs: int
    median_px: float
    systematic_px: float
    sigma_px: float
    fit: CalibrationFit | None
    cause: str = ""

    @property
    def is_refuted(self) -> bool:
        """True if the calibration cannot be that of these frames.

        Residuals or the errors that they imply are beyond 5 px, or beyond 20 standard deviations where no small change
        of the calibration explains them.
        """
        limit_px = (
            _REFUTED_PX if self.explained else min(_REFUTED_PX, max(self.limit_px, _REFUTED_SIGMA * self.sigma_px))
        )
        # Residuals of real lenses may imply any error where light sheets hardly cross the baseline.
        is_large = self.systematic_px > _MAX_SYSTEMATIC_PX or self.median_px > 2 * max(
            self.sigma_px, _MAX_SYSTEMATIC_PX
        )
        implied_px = self.coded_error_px if is_large else 0.0
        return bool(self.cause) or not max(self.median_px, implied_px) <= limit_px

    def error_mm(self, points_mm: FloatArray, normals: FloatArray) -> FloatArray:
        """(n,) float64: error along the normals (n, 3) that the residuals imply, as a standard deviation.

        That of the fit, with its own standard deviation; for a fit that is not significant, its standard deviation
        alone; without one that explains the residuals and determines the coded positions, the effect of their median on
        these.
        """
        fit = self.explained if self._is_determined else None
        camera, projector = self.devices
        pairs = PixelPairs(project(camera, points_mm), project(projector, points_mm), np.zeros(0), self.axis)
        uncertain_px = self.median_px
        if fit is not None:
            uncertain_px = fit.coded_sigma_px
            if self.is_significant:
                uncertain_px = min(uncertain_px, max(fit.coded_error_px, self.median_px))
        pairs.projector_px[:, 0 if self.axis is Axis.COLUMN else 1] += uncertain_px
        depth = coded_depth_mm(camera, projector, pairs)
        shifted = camera.centre_mm + depth[:, None] * pixel_rays(camera, pairs.camera_px) - points_mm
        error = np.abs((shifted * normals).sum(axis=1))
        if fit is not None and self.is_significant:
            error = np.hypot(error, (fit.displacement_mm(points_mm, self.axis) * normals).sum(axis=1))
        return np.asarray(error)

    @property
    def coded_error_px(self) -> float:
        """Median error of the coded position that the residuals imply: that of a fit, 0 if it is not significant; their
        median if they do not determine it.
        """
        fit = self.explained if self._is_determined else None
        return self.median_px if fit is None else fit.coded_error_px if self.is_significant else 0.0

    @property
    def _is_determined(self) -> bool:
        """False if the residuals show an error, but hardly how much the coded positions are off."""
        fit = self.explained
        return fit is None or not self.is_significant or fit.coded_error_px > _MIN_DETERMINED * fit.coded_sigma_px

    @property
    def is_significant(self) -> bool:
        """True if the residuals show an error of the calibration rather than noise."""
        fit = self.explained
        return fit is None or fit.is_significant or self.systematic_px > _MAX_SYSTEMATIC_PX

    @property
    def limit_px(self) -> float:
        """Largest median residual that noise and resolution explain."""
        return _AGREES_PX + 2 * self.sigma_px

    @property
    def explained(self) -> CalibrationFit | None:
        """The fit, if it leaves no more than noise and resolution."""
        return self.fit if self.fit is not None and self.fit.residual_px <= self.limit_px else None


def check_calibration(
    camera: Pinhole,
    projector: Pinhole,
    pairs: PixelPairs,
    code: tuple[Gray, ...],
    /,
    *,
    names: DeviceNames = _CAMERA_AND_PROJECTOR,
) -> CalibrationCheck | None:
    """Test the calibration of a camera and the projector, or of two cameras; None for fewer than 200 correspondences.

    code : Gray codes of the axes, to try exchanged bits; none for two cameras.
    """
    if len(pairs) < _MIN_POINTS:
        return None
    devices = camera, projector
    median, sigma = disagreement_px(*devices, pairs), float(np.median(pairs.sigma_px))
    # Cameras side by side hardly show how they are turned towards each other: a fit would explain the residuals of
    # lenses by a turn of much larger effect.
    is_small = names.is_pair and median <= _LENS_PX
    fit = fit_calibration(*devices, pairs) if median <= 4 * _REFUTED_PX and not is_small else None
    systematic = _systematic_px(*devices, pairs) if fit is not None else median
    mistake = _code_mistake(*devices, pairs, code)
    check = CalibrationCheck(devices, pairs.axis, len(pairs), median, systematic, sigma, fit, mistake)
    if mistake or not check.is_refuted:
        return check
    return replace(check, cause=explain_residuals(*devices, pairs, code, names))


def _code_mistake(camera: Pinhole, projector: Pinhole, pairs: PixelPairs, code: tuple[Gray, ...]) -> str:
    """Name the exchanged or inverted bits without which hardly any of many points are far from where they belong; empty
    if there are none.

    A mistake of the code displaces some points by much, and others not at all: their median may be small.
    """
    pairs = pairs.thinned(_TRIAL_POINTS)

    def far(each: PixelPairs) -> float:
        return float(np.mean(~(np.abs(epipolar_residual_px(camera, projector, each)) <= _REFUTED_PX)))

    stated = far(pairs)
    if not code or stated < _MANY_FAR:
        return ""
    left, cause = min((far(trial.pairs), trial.cause) for trial in _exchanged_bits(camera, projector, pairs, code))
    if left > _FEW_FAR * stated:
        return ""
    return f"{cause} (without it {left:.1%} of the points are more than {_REFUTED_PX:g} px off, with it {stated:.0%})"


def image_cells(pixels_px: FloatArray, size: Size, count: int) -> NDArray[np.intp]:
    """(n,) index of the cell of each pixel, of count x count over the image."""
    scale = count / np.array([size.width_px, size.height_px])
    column, row = np.clip((pixels_px + 0.5) * scale, 0, count - 1).astype(np.intp).T
    return np.asarray(row * count + column)


def _systematic_px(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> float:
    """Rms of the mean residuals of image cells, less their noise."""
    residual = epipolar_residual_px(camera, projector, pairs)
    limit = 5 * np.nanmedian(np.abs(residual))
    used = np.abs(residual) <= limit
    cell, residual = image_cells(pairs.camera_px[used], camera.size, _CELLS), residual[used]
    count = np.bincount(cell, minlength=_CELLS**2)
    enough = count >= _MIN_CELL_POINTS
    if not enough.any():
        return float(np.sqrt(np.mean(residual**2)))
    total, square = (np.bincount(cell, weights=each, minlength=_CELLS**2)[enough] for each in (residual, residual**2))
    count = count[enough]
    mean = total / count
    noise = (square / count - mean**2) / count
    return float(np.sqrt(max(0.0, np.average(mean**2 - noise, weights=count))))


def _turn_projector(projector: Pinhole, camera: Pinhole, turn: FloatArray, aside: FloatArray) -> Pinhole:
    """The projector turned about its centre (rotation vector, rad), its baseline turned by two angles."""
    baseline = projector.centre_mm - camera.centre_mm
    length = linalg.norm(baseline)
    # Two directions across the baseline, in the frame of the camera.
    _, _, across = linalg.svd(baseline[None])
    moved = baseline / length + aside @ across[1:]
    centre = camera.centre_mm + length * moved / linalg.norm(moved)
    rotation = np.asarray(cv2.Rodrigues(turn)[0]) @ projector.rotation
    return replace(projector, rotation=rotation, translation_mm=-rotation @ centre)


def _with_lens(device: Pinhole, change: FloatArray) -> Pinhole:
    """A device with another focal length, principal point and k1. change : (4,), in units of their priors."""
    matrix, distortion = device.matrix.copy(), device.distortion.copy()
    matrix[:2, :2] *= np.exp(np.clip(_PRIOR_FOCAL * change[0], -1, 1))
    matrix[:2, 2] += _PRIOR_CENTRE * device.size.width_px * change[1:3]
    distortion[0] += _PRIOR_K1 * change[3]
    return replace(device, matrix=matrix, distortion=distortion)


def _change_devices(camera: Pinhole, projector: Pinhole, x: FloatArray) -> tuple[Pinhole, Pinhole]:
    """Both devices with a change: (5,) of the pose, or (13,) with the lenses of both."""
    moved = _turn_projector(projector, camera, x[:3], x[3:5])
    return (camera, moved) if len(x) == 5 else (_with_lens(camera, x[5:9]), _with_lens(moved, x[9:]))


def fit_calibration(camera: Pinhole, projector: Pinhole, pairs: PixelPairs, /) -> CalibrationFit | None:
    """Fit the pose of the projector, then also both lenses if the pose alone leaves a systematic residual.

    None if no small change brings the points in front of both devices.
    """
    # Half a second to load, and few scans need it.
    from scipy.optimize import least_squares

    pairs = pairs.thinned(_FIT_POINTS)
    scale = _OUTLIER_SIGMA * max(0.1, float(np.median(pairs.sigma_px)))
    found = None
    for count in (5, 13):

        def error(x: FloatArray) -> FloatArray:
            residual = epipolar_residual_px(*_change_devices(camera, projector, x), pairs) / scale
            # The priors of the lenses weigh as much as one point each.
            return np.concatenate([np.nan_to_num(residual, nan=1e3), x[5:]])

        solved = least_squares(error, np.zeros(count), loss="soft_l1", x_scale="jac", max_nfev=60)
        fitted = _change_devices(camera, projector, solved.x)
        median = disagreement_px(*fitted, pairs)
        if not np.isfinite(median):
            break
        turned = float(np.degrees(linalg.norm(solved.x[:3])))
        if found is None or median < 0.9 * found.residual_px:
            floor_px = max(_MIN_FLOOR_PX, _FLOOR_RATIO * _systematic_px(*fitted, pairs))
            covariance = _covariance(np.asarray(solved.jac), solved.fun, pairs.camera_px, camera.size, floor_px / scale)
            error_px, sigma_px = _coded_error_px((camera, projector), solved.x, covariance, pairs)
            chi2 = float(solved.x @ linalg.pinv(covariance) @ solved.x)
            shifted = float(linalg.norm(fitted[1].centre_mm - projector.centre_mm))
            significant = chi2 > _SIGNIFICANT_CHI2 * count
            found = CalibrationFit(
                (camera, projector), *fitted, turned, shifted, median, error_px, sigma_px, significant
            )  # fmt: skip
        is_hopeless = median > _MAX_LENS_PX or turned > _MAX_TURN_DEG
        if is_hopeless or _systematic_px(found.camera, found.projector, pairs) < 0.1:
            break
    return found


def _covariance(
    jacobian: FloatArray, residual: FloatArray, pixels_px: FloatArray, size: Size, floor: float
) -> FloatArray:
    """Covariance of fitted parameters whose residuals are correlated in the image.

    H⁻¹ S H⁻¹ with H = JᵀJ and S the sum of gᵀg over image cells, g = Σ Jᵀr of a cell (Huber 1967, with clusters), and
    of the same for a residual of `floor` in all points of each of 3 x 3 parts of the image: no lens follows its
    model exactly. The residuals after the first n are independent priors.
    """
    count = len(pixels_px)
    cell = image_cells(pixels_px, size, _CELLS)
    scores = [np.zeros((_CELLS**2, jacobian.shape[1])), np.zeros((_LENS_CELLS**2, jacobian.shape[1]))]
    np.add.at(scores[0], cell, jacobian[:count] * residual[:count, None])
    np.add.at(scores[1], image_cells(pixels_px, size, _LENS_CELLS), jacobian[:count] * floor)
    scores.append(jacobian[count:] * residual[count:, None])
    score, inverse = np.concatenate(scores), linalg.pinv(jacobian.T @ jacobian)
    return np.asarray(inverse @ score.T @ score @ inverse)


def _coded_error_px(
    stated: tuple[Pinhole, Pinhole], x: FloatArray, covariance: FloatArray, pairs: PixelPairs
) -> tuple[float, float]:
    """Median error of the coded position that a fit x implies, and its median standard deviation."""
    camera, projector = stated
    axis = 0 if pairs.axis is Axis.COLUMN else 1

    def error(at: FloatArray) -> FloatArray:
        devices = _change_devices(camera, projector, at)
        ray = pixel_rays(devices[0], pairs.camera_px)
        points = devices[0].centre_mm + coded_depth_mm(*devices, pairs)[:, None] * ray
        return np.asarray(project(projector, points)[:, axis] - pairs.projector_px[:, axis])

    here = error(x)
    values, directions = linalg.eigh(covariance)
    steps = np.sqrt(np.maximum(values, 0.0))[:, None] * directions.T
    sigma = np.sqrt(np.sum([(error(x + step) - here) ** 2 for step in steps], axis=0))
    known = np.isfinite(here + sigma)
    if not known.any():
        return 0.0, float("inf")
    return float(np.median(np.abs(here[known]))), float(np.median(sigma[known]))


@dataclass(frozen=True, slots=True)
class _Mistake:
    """A mistake, and the devices and correspondences without it. free : number of parameters that were fitted."""

    cause: str
    camera: Pinhole
    projector: Pinhole
    pairs: PixelPairs
    free: int = 0


def explain_residuals(
    camera: Pinhole, projector: Pinhole, pairs: PixelPairs, code: tuple[Gray, ...], names: DeviceNames, /
) -> str:
    """Name the mistake that brings the two axes into agreement, with the residual that it leaves; empty if none does.

    Of several, the one with fewest free parameters, unless its residual is 1.5 times that of another.
    code : Gray codes of the axes.
    """
    pairs = pairs.thinned(_TRIAL_POINTS)
    limit = _AGREES_PX + float(np.median(pairs.sigma_px))
    fit = fit_calibration(camera, projector, pairs)
    if fit is not None:
        limit = min(limit, _SIMPLER * fit.residual_px + 0.05)
    stated = disagreement_px(camera, projector, pairs)
    agreeing: list[tuple[float, _Mistake]] = []
    for trial in _trials(camera, projector, pairs, code, fit, names):
        if trial.free > 0 and agreeing and agreeing[0][1].free == 0:
            break  # fitting takes seconds, and could explain the same by a coincidence
        left = disagreement_px(trial.camera, trial.projector, trial.pairs)
        if left <= limit and left < _IMPROVED * stated:
            agreeing.append((left, trial))
    if not agreeing:
        return ""
    best = min(left for left, _ in agreeing)
    likely = [found for found in agreeing if found[0] <= _SIMPLER * best + 0.02]
    likely.sort(key=lambda found: (found[1].free, found[0]))
    left = max(likely[0][0], 0.01)
    causes = " or ".join(
        trial.cause for _, trial in likely[:_MAX_CAUSES] if trial.free <= likely[0][1].free + _AS_SIMPLE
    )
    agree = "the cameras" if names.is_pair else "both axes"
    return f"{causes} ({agree} then agree to {left:.2f} px)"


def _trials(
    camera: Pinhole,
    projector: Pinhole,
    pairs: PixelPairs,
    code: tuple[Gray, ...],
    fit: CalibrationFit | None,
    names: DeviceNames,
) -> Iterator[_Mistake]:
    """Mistakes to try, from those without a free parameter to the general ones."""
    for name, moved in _other_poses(camera, projector, names):
        yield _Mistake(f"the calibration holds {name}", camera, moved, pairs)
    lenses = _with_lens_of(camera, projector), _with_lens_of(projector, camera)
    both = f"{names.camera} and {names.projector}"
    yield _Mistake(f"the lenses of {both} are exchanged in the calibration", *lenses, pairs)
    for name, moved in _other_poses(*lenses, names):
        yield _Mistake(f"{both} are exchanged in the calibration, which holds {name}", lenses[0], moved, pairs)
    for name, transformed in _other_images(pairs.camera_px, camera.size):
        yield _Mistake(f"the {names.picture} is {name}", camera, projector, replace(pairs, camera_px=transformed))
    for name, transformed in _other_images(pairs.projector_px, projector.size):
        yield _Mistake(f"the {names.image} is {name}", camera, projector, replace(pairs, projector_px=transformed))
    yield from _exchanged_bits(camera, projector, pairs, code)
    yield from _other_focal_lengths(camera, projector, pairs, names)
    yield from _scaled_pictures(camera, projector, pairs, names.picture, of_camera=True)
    yield from _scaled_pictures(camera, projector, pairs, names.code, of_camera=False, is_picture=names.is_pair)
    if fit is not None and fit.turned_deg < _MAX_TURN_DEG:
        cause = (
            f"{names.the(names.projector)} has another pose relative to {names.the(names.camera)} than in the "
            f"calibration: turned by {fit.turned_deg:.2f}° and shifted by {fit.shifted_mm:.1f} mm"
            + ("" if names.is_pair else " (a keystone correction has the same effect)")
        )
        yield _Mistake(cause, fit.camera, fit.projector, pairs, 2)


def _with_lens_of(device: Pinhole, other: Pinhole) -> Pinhole:
    """A device with the matrix and distortion of another one."""
    return replace(device, matrix=other.matrix, distortion=other.distortion)


def _other_poses(camera: Pinhole, projector: Pinhole, names: DeviceNames) -> Iterator[tuple[str, Pinhole]]:
    """Poses of the projector relative to the camera that differ by a convention."""
    rotation = projector.rotation @ camera.rotation.T
    translation = projector.translation_mm - rotation @ camera.translation_mm
    for name, other, shift in (
        (
            f"the inverse pose (rotation and translation from {names.projector} to {names.camera})",
            rotation.T,
            -rotation.T @ translation,
        ),
        ("the rotation of the inverse direction", rotation.T, translation),
        ("the translation of the inverse direction", rotation, -translation),
        (f"the centre of {names.the(names.projector)} in place of its translation", rotation, -rotation @ translation),
        (
            f"the inverse rotation with the centre of {names.the(names.projector)}",
            rotation.T,
            -rotation.T @ -translation,
        ),
    ):
        yield (
            name,
            replace(projector, rotation=other @ camera.rotation, translation_mm=other @ camera.translation_mm + shift),
        )


def _other_images(pixels: FloatArray, size: Size) -> Iterator[tuple[str, FloatArray]]:
    """Pixels (n, 2) of a picture that was mirrored or turned before it was stored."""
    right, bottom = size.width_px - 1, size.height_px - 1
    x, y = pixels.T
    yield "mirrored left to right", np.column_stack([right - x, y])
    yield "mirrored top to bottom", np.column_stack([x, bottom - y])
    yield "turned by 180°", np.column_stack([right - x, bottom - y])
    # A picture turned by 90° has its extents exchanged; the stored one has the stated size.
    yield "turned by 90°", np.column_stack([y, bottom - x])
    yield "turned by 270°", np.column_stack([right - y, x])
    yield "mirrored and turned by 90°", np.column_stack([y, x])


def _exchanged_bits(
    camera: Pinhole, projector: Pinhole, pairs: PixelPairs, code: tuple[Gray, ...]
) -> Iterator[_Mistake]:
    """Two bits of the code exchanged, or one inverted."""
    for gray in code:
        column = 0 if gray.axis is Axis.COLUMN else 1
        position = pairs.projector_px[:, column]
        cell = np.floor((position + 0.5 + gray.offset_px) / gray.cell_px).astype(np.int64)
        word = np.asarray(to_gray(np.clip(cell, 0, 2**gray.bits - 1)), dtype=np.int64)
        within = position - (cell * gray.cell_px - gray.offset_px)
        # A point on the edge of a cell belongs to either cell; the middle is wrong by half a cell at the most.
        within = np.where(within < 0, (gray.cell_px - 1) / 2, within)
        place = [1 << (gray.bits - 1 - bit) for bit in range(gray.bits)]
        of_code = f"of {gray.bits} of the {gray.axis} code"
        changes = [(f"bit {bit + 1} {of_code} is inverted", word ^ place[bit]) for bit in range(gray.bits)]
        for i, j in combinations(range(gray.bits), 2):
            differ = (word & place[i] > 0) != (word & place[j] > 0)
            exchanged = np.where(differ, word ^ (place[i] | place[j]), word)
            changes.append((f"bits {i + 1} and {j + 1} {of_code} are exchanged", exchanged))
        for name, changed in changes:
            moved = pairs.projector_px.copy()
            moved[:, column] = from_gray(changed) * gray.cell_px - gray.offset_px + within
            yield _Mistake(name, camera, projector, replace(pairs, projector_px=moved))


def _other_focal_lengths(
    camera: Pinhole, projector: Pinhole, pairs: PixelPairs, names: DeviceNames
) -> Iterator[_Mistake]:
    """Another focal length of one device."""
    for name, of_camera in ((names.camera, True), (names.projector, False)):

        def changed(x: FloatArray, of_camera: bool = of_camera) -> tuple[Pinhole, Pinhole]:
            device = camera if of_camera else projector
            matrix = device.matrix.copy()
            matrix[:2, :2] *= np.exp(x[0])
            other = replace(device, matrix=matrix)
            return (other, projector) if of_camera else (camera, other)

        def residual(x: FloatArray, changed: Callable[..., tuple[Pinhole, Pinhole]] = changed) -> FloatArray:
            return epipolar_residual_px(*changed(x), pairs)

        found = _minimise(residual, _SCALES)
        cause = f"the focal length of {names.the(name)} is × {np.exp(found[0]):.3f} that of the calibration"
        yield _Mistake(cause, *changed(found), pairs, 1)


def _minimise(residual: Callable[[FloatArray], FloatArray], starts: Sequence[FloatArray]) -> FloatArray:
    """The parameters of the least robust sum, from the three best of several starts."""
    # Half a second to load, and few scans need it.
    from scipy.optimize import least_squares

    def error(x: FloatArray) -> FloatArray:
        return np.concatenate([np.nan_to_num(residual(x), nan=1e3), 1e-3 * x])

    coarse = sorted(starts, key=lambda x: float(np.median(np.abs(error(x)))))[:3]
    solved = [least_squares(error, x, loss="soft_l1", max_nfev=40) for x in coarse]
    return np.asarray(min(solved, key=lambda each: each.cost).x)


def _scaled_pictures(
    camera: Pinhole, projector: Pinhole, pairs: PixelPairs, name: str, *, of_camera: bool, is_picture: bool = True
) -> Iterator[_Mistake]:
    """A picture of another resolution, zoomed, shifted, or both: p' = s (p + ½) - ½ + shift."""
    pixels = pairs.camera_px if of_camera else pairs.projector_px
    size = camera.size if of_camera else projector.size
    extent, middle = float(size.width_px), np.array([size.width_px, size.height_px]) / 2

    def transformed(scale: float, shift: FloatArray) -> PixelPairs:
        moved = (pixels + 0.5) * scale - 0.5 + shift
        return replace(pairs, camera_px=moved) if of_camera else replace(pairs, projector_px=moved)

    def fit(
        parts: Callable[[FloatArray], tuple[float, FloatArray]], starts: Sequence[FloatArray]
    ) -> tuple[float, FloatArray]:
        def residual(x: FloatArray) -> FloatArray:
            scale, shift = parts(x)
            # Without limits, everything shrinks to a point on its own epipolar line.
            if abs(np.log(scale)) > _MAX_LOG_SCALE or np.abs(shift).max() > _MAX_SHIFT * extent:
                return np.full(len(pixels), 1e3)
            return epipolar_residual_px(camera, projector, transformed(scale, shift))

        return parts(_minimise(residual, starts))

    shifts = [np.array([x, y]) for x in np.linspace(-0.5, 0.5, 9) for y in np.linspace(-0.5, 0.5, 9)]
    scale, shift = fit(lambda x: (float(np.exp(x[0])), np.zeros(2)), _SCALES)
    what = f"of another resolution than its matrix: × {1 / scale:.3f}"
    yield _Mistake(f"the {name} is {what}", camera, projector, transformed(scale, shift), 1)
    scale, shift = fit(lambda x: (float(np.exp(x[0])), (1 - float(np.exp(x[0]))) * middle), _SCALES)
    what = f"the {name} is zoomed about its middle: × {1 / scale:.3f}"
    if not is_picture:
        what = f"the projector shows its picture × {scale:.3f} as large about its middle: overscan or digital zoom"
    yield _Mistake(what, camera, projector, transformed(scale, shift), 1)
    scale, shift = fit(lambda x: (1.0, extent * x), shifts)
    what = f"shifted by {-shift[0]:.0f}, {-shift[1]:.0f} px: another region, crop or offset"
    yield _Mistake(f"the {name} is {what}", camera, projector, transformed(scale, shift), 2)
    scale, shift = fit(lambda x: (float(np.exp(x[0])), extent * x[1:]), [np.zeros(3)])
    what = f"zoomed × {1 / scale:.3f} and shifted by {-shift[0]:.0f}, {-shift[1]:.0f} px"
    yield _Mistake(f"the {name} is {what}", camera, projector, transformed(scale, shift), 9)

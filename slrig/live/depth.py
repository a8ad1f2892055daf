"""Depth images from the newest frame of each pattern, with their standard deviation and what contradicts them.

The fine patterns give the phase θ = arg Σ I_k exp(iα_k), the coarse ones or the code the number of its period, and the
ray of each pixel meets the sheet of light of that projector position at 1/z = (w₀ + p v)/(1 + q v), v = u − u₀. A pixel
whose light changed from one cycle to the next, by more than noise explains, is marked as moved: its frames do not show
one surface.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.live.plan import STEPS, LivePlan
from slrig.model import Axis, Calibration, Gray, Pinhole, Pixels, Region
from slrig.reconstruction import ImagePart, part_of_region, project

Float32 = NDArray[np.float32]

_NODES = (0.1, 0.5, 0.9)
"""Of the projector's extent: where each ray's depth is computed. A fractional linear function goes through them, which
without distortion is exact."""
_BETWEEN = (0.3, 0.7)

NEAREST, FARTHEST = 0.2, 5.0
"""Depths that are looked for, over that at which the axes of camera and projector meet."""

_SAMPLED = 5  # of rows and columns, by which noise and order are judged
_LIT = 8.0  # standard deviations of noise that a pixel's modulation must have
_LEAST_MODULATION = 0.012  # of full scale; as the contrast that a scan asks for
_WRONG_PERIOD = 0.35  # of a period: further from a whole number of periods, its number is uncertain
_CELLS_APART = 0.45  # the same by a code, whose cells are half a period
_RANDOM, _RANDOM_CELLS = 0.15, 0.2
"""Mean distances from a whole number of periods, by a coarse sinusoid and by a code, above which frames do not belong
together: 0.25 by chance; noise alone makes 0.14 at most, and the cells of a code 0.125."""

_MOST_UNCERTAIN = 0.17  # of a period: more noise of the coarse position than this, and numbers are guesses
_MOVED = 50.0  # sum of squared changes over their variances: phases three standard deviations off give above 120
_SAME = 9.0  # a change of light that noise explains, squared, over its variance
_SAME_SHARE = 0.5  # of the lit pixels that must be as one cycle before, for a frame to show that pattern
_MOST_LEFT_OUT = 2  # frames of one pattern in a row: the scene may look like another pattern for one, not for three
_BORDER_PX = 3.0  # of the projector's image, where blur mixes light with darkness
_UNITS = 4  # in which squared changes over their variances are counted
_NEIGHBOUR = 0.15  # of a period: a step in position that is no surface between neighbours
_BINS = 16
_LEAST_IN_BIN = 60
_ROUNDING = 1 / 12  # variance of a value that is rounded, DN²
_MEMORY = 0.8  # share of the noise of the frames before


class PixelState(IntEnum):
    """What is known of a pixel of a depth image."""

    MEASURED = 0
    MOVED = 1
    SATURATED = 2
    DARK = 3
    UNCLEAR = 4
    UNSEEN = 5
    OUTSIDE = 6


class RayTable(NamedTuple):
    """Where rays meet sheets of light: 1/z = (inverse + rise v)/(1 + bend v), v = u − middle + cubic Π (u − n_i), z in
    mm along the camera's axis, u in projector px, n_i the nodes.

    middle, inverse, rise, bend, cubic : (h, w) float32, NaN where the lens images nothing. directions : (h, w, 2)
    float32, x/z and y/z of each ray in the camera. depth_mm : at which the axes of camera and projector meet.
    """

    middle: Float32
    inverse: Float32
    rise: Float32
    bend: Float32
    cubic: Float32
    nodes: tuple[float, float, float]
    directions: Float32
    depth_mm: float

    def every(self, step: int) -> RayTable:
        """The table of every `step`-th of its pixels along rows and columns."""
        maps: dict[str, Any] = {
            name: np.ascontiguousarray(each[::step, ::step])
            for name, each in self._asdict().items()
            if isinstance(each, np.ndarray)
        }
        return self._replace(**maps)


def ray_table(camera: Pinhole, projector: Pinhole, axis: Axis, part: ImagePart) -> RayTable:
    """Compute the table of all pixels of a part of the camera's image."""
    rays, shape = part.rays(camera), part.mask.shape
    along = 0 if axis is Axis.COLUMN else 1
    depth_mm = _meeting_distance_mm(camera, projector)
    # Of a projector without distortion, u (q₂ + t₂ w) = f (q₀ + t₀ w) + s … with w = 1/z: three depths of each ray
    # within its image.
    towards = rays @ projector.rotation.T @ projector.matrix.T
    offset = projector.matrix @ (projector.rotation @ camera.centre_mm + projector.translation_mm)
    inverses, positions = [], []
    extent_px = projector.size.along(axis)
    nodes = [share * extent_px for share in _NODES]
    for share in (*_NODES, *_BETWEEN):
        at_px = share * extent_px
        with np.errstate(all="ignore"):
            inverse = (towards[:, along] - at_px * towards[:, 2]) / (at_px * offset[2] - offset[along])
        spread = 1 + 0.02 * (share - 0.5)  # keeps depths apart that the limits make equal
        inverse = np.clip(inverse, spread / (FARTHEST * depth_mm), spread / (NEAREST * depth_mm))
        inverses.append(inverse)
        positions.append(project(projector, camera.centre_mm + rays / inverse[:, None])[:, along])
    first, middle, last, *between = positions
    # From w (1 + q v) = w₀ + p v at both ends: p − q w = (w − w₀)/v.
    with np.errstate(all="ignore"):
        before = (inverses[0] - inverses[1]) / (first - middle)
        after = (inverses[2] - inverses[1]) / (last - middle)
        bend = (before - after) / (inverses[2] - inverses[0])
        rise = before + bend * inverses[0]
        # What lens distortion adds is a third power: by how much the function is off half-way between the nodes.
        off = []
        for inverse, position in zip(inverses[3:], between, strict=True):
            exact = (inverse - inverses[1]) / (rise - bend * inverse) + middle
            off.append((exact - position) / np.prod([position - node for node in nodes], axis=0))
        cubic = np.nan_to_num(np.mean(off, axis=0))
    in_camera = rays @ camera.rotation.T
    maps = np.array([middle, inverses[1], rise, bend, cubic], np.float32).reshape(5, *shape)
    directions = (in_camera[:, :2] / in_camera[:, 2:]).reshape(*shape, 2).astype(np.float32)
    return RayTable(
        maps[0], maps[1], maps[2], maps[3], maps[4], (nodes[0], nodes[1], nodes[2]), directions, depth_mm
    )  # fmt: skip


def _meeting_distance_mm(camera: Pinhole, projector: Pinhole) -> float:
    """Depth in the camera of the point of its axis that is nearest to the projector's axis; the baseline if they do not
    meet in front of it.
    """
    towards, other = camera.rotation[2], projector.rotation[2]
    between = projector.centre_mm - camera.centre_mm
    normal = np.cross(towards, other)
    squared = float(normal @ normal)
    found = float(np.cross(between, other) @ normal) / squared if squared > 1e-6 else 0.0
    baseline_mm = float(np.linalg.norm(between))
    return found if found > 0.3 * baseline_mm else baseline_mm


@dataclass(frozen=True, slots=True, eq=False)
class DepthImage:
    """One depth image. depth_mm, sigma_mm : (h, w) float32, along the camera's axis, NaN unless measured or moved;
    grey : (h, w) uint8, mean light; state : (h, w) uint8, of `PixelState`.

    time_s, window_s : end of the newest frame in the rig's clock, and time from the begin of the oldest one. moved_mm :
    median change of depth of the moved pixels since one cycle before; None if none can tell. blur_px : standard
    deviation, projector px, of the blur that explains the fine modulation; None with a code.
    """

    depth_mm: Float32
    sigma_mm: Float32
    grey: NDArray[np.uint8]
    state: NDArray[np.uint8]
    time_s: float
    window_s: float
    moved_mm: float | None
    blur_px: float | None


class LiveView:
    """What of a camera's images is decoded, and where its rays meet the light.

    Raises ConfigError: nothing of the region is in the camera's image, or it names another extent.
    """

    def __init__(self, calibration: Calibration, camera: str, axis: Axis, region: Region | None = None) -> None:
        if calibration.projector is None:
            message = "live depth needs a calibrated projector"
            raise ValueError(message)
        self.camera, self.projector = calibration.cameras[camera], calibration.projector
        self.solved, self.region = calibration.solved, region or Region()
        self.part = part_of_region(self.region, camera, self.camera.size, self.camera)
        self.table = ray_table(self.camera, self.projector, axis, self.part)
        self.extent_px = float(self.projector.size.along(axis))

    def limits_mm(self, step: int) -> tuple[Float32, Float32] | None:
        """(h, w) float32 each: nearest and furthest depth of each ray within the region, the nearest not the smaller
        one where it is outside of it; None where nothing is limited.
        """
        part, region = self.part, self.region
        if part.depths_mm is None and region.max_sigma_mm is None and part.mask.all():
            return None
        near, far = part.depths_mm or (np.zeros(part.mask.shape), np.full(part.mask.shape, np.inf))
        few = np.s_[::step, ::step]
        mask = part.mask[few]
        return tuple(  # type: ignore[return-value] # two of them
            np.where(mask, each[few], beyond).astype(np.float32) for each, beyond in ((near, np.inf), (far, -np.inf))
        )


class LiveDecoder:
    """Takes frames of a live sequence, and makes depth images of the newest ones. For one thread.

    seen : what of the camera's images is decoded. step : pixels from ray to ray along rows and columns. clipped_at :
    value from which a sample is saturated.
    """

    def __init__(self, plan: LivePlan, seen: LiveView, *, step: int, clipped_at: float, full_scale: float) -> None:
        self.plan, self.seen = plan, seen
        self.table = seen.table.every(step)
        self._limits, self._most_sigma_mm = seen.limits_mm(step), np.float32(seen.region.max_sigma_mm or np.inf)
        # A sinusoid that is in focus has half of what white has above black.
        self._least = np.float32(max(_LEAST_MODULATION, (seen.region.min_contrast or 0.0) / 2) * full_scale)
        self._extent_px = seen.extent_px
        self.contradiction: str | None = None
        self.step = step
        self._clipped_at, self._full_scale = clipped_at, full_scale
        count, shape = len(plan.patterns), self.table.middle.shape
        self._frames: NDArray[Any] | None = None
        self._times: list[tuple[float, float] | None] = [None] * count
        self._seen = np.zeros(count, np.int64)
        self._refused_in_a_row = np.zeros(count, np.int64)
        self._noise: tuple[float, float] | None = None
        self._spatial = _ROUNDING
        self._left, self._third = 1.0, 0.0
        # Sums over the newest frames, which a new frame changes by what it differs from the one before.
        self._total, self._real, self._imaginary, self._coarse_real, self._coarse_imaginary = np.zeros(
            (5, *shape), np.float32
        )
        self._changes = np.zeros((count, *shape), np.uint8)
        self._changed, self._clipped = np.zeros((2, *shape), np.uint16)
        self._scratch = np.zeros((4, *shape), np.float32)
        self._floats, self._bytes = np.zeros((2, 2, *shape), np.float32), np.zeros((2, 2, *shape), np.uint8)
        self._made = 0
        self._earlier: deque[Float32] = deque(maxlen=count)

    def add(self, pattern: int, image: Pixels, begin_s: float, end_s: float) -> str | None:
        """Take the newest frame of a pattern, or that part of it which is `seen`, copied; return why it is left out,
        None if it counts.
        """
        lattice = image[:: self.step, :: self.step]
        if self._frames is None:
            self._frames = np.zeros((len(self.plan.patterns), *lattice.shape), image.dtype)
            self._few = np.ascontiguousarray(self._frames[:, ::_SAMPLED, ::_SAMPLED])
            self._lit = np.zeros(self._few.shape[1:], np.bool_)
        cause = self._fault(pattern, lattice)
        if cause is not None and self._refused_in_a_row[pattern] < _MOST_LEFT_OUT:
            self._refused_in_a_row[pattern] += 1
            return cause
        self._refused_in_a_row[pattern] = 0
        plan = self.plan
        summed = pattern in plan.fine or pattern in plan.coarse
        angle = plan.angle(pattern) if summed else 0.0
        sums = (self._coarse_real, self._coarse_imaginary) if pattern in plan.coarse else (self._real, self._imaginary)
        weights = (
            (1.0, math.cos(angle), math.sin(angle)) if pattern in plan.fine else (0.0, math.cos(angle), math.sin(angle))
        )
        in_bands(
            _take_kernel, len(lattice), np.ascontiguousarray(lattice), self._frames[pattern], self._changes[pattern],
            self._changed, self._clipped, *(np.float32(each) for each in self._noise or (self._spatial, 0.0)),
            np.float32(self._clipped_at),
            summed, *(np.float32(each) for each in weights), self._total, *sums,
        )  # fmt: skip
        self._few[pattern] = lattice[::_SAMPLED, ::_SAMPLED]
        self._times[pattern] = begin_s, end_s
        self._seen[pattern] += 1
        if pattern == plan.fine[-1]:
            self._third = self._harmonic()
        return None

    def depth(self) -> DepthImage | None:
        """Return the depth image of the newest frames, which holds until the next but one is made; None until each
        pattern has come twice, and where they contradict one another, as `contradiction` says.
        """
        if self._frames is None or self._noise is None or self._seen.min() < 2:
            return None
        plan, shape = self.plan, self.table.middle.shape
        raw, rough, uncertain, reach = self._scratch
        self._made = 1 - self._made
        depth, sigma = self._floats[self._made]
        grey, state = self._bytes[self._made]
        harmonic = np.float32(self._third)
        read, slope = (np.float32(each) for each in self._noise)
        code = plan.patterns[plan.bits[0]] if plan.bits else None
        if isinstance(code, Gray):
            level, share = self._total, 1 / len(plan.fine)
            if plan.levels:
                level, share = self._frames[list(plan.levels)].sum(axis=0, dtype=np.float32), 0.5
            in_bands(
                _code_kernel, shape[0], self._frames[list(plan.bits)], level, np.float32(share),
                np.float32(code.cell_px), np.float32((code.cell_px - 1) / 2 - code.offset_px), rough, uncertain,
            )  # fmt: skip
        else:
            per_turn, steps = np.float32(plan.coarse_px), np.float32(len(plan.coarse))
            in_bands(
                _coarse_kernel, shape[0], self._coarse_real, self._coarse_imaginary, self._total, harmonic, per_turn,
                steps, np.float32(len(plan.fine)), read, slope, rough, uncertain,
            )  # fmt: skip
        table = self.table
        in_bands(
            _depth_kernel, shape[0], self._real, self._imaginary, self._total, self._changed, self._clipped, rough,
            uncertain, np.float32(len(plan.fine)), np.float32(plan.fine_px), np.float32(self._extent_px),
            np.float32(_CELLS_APART if plan.bits else _WRONG_PERIOD), harmonic, read, slope,
            self._least, np.float32(255 / self._full_scale), table.middle,
            table.inverse, table.rise, table.bend, table.cubic, *(np.float32(each) for each in table.nodes),
            np.float32(table.depth_mm), raw, sigma, grey, state, reach, depth,
        )  # fmt: skip
        few, half = np.s_[::_SAMPLED, ::_SAMPLED], np.s_[::2, ::2]
        lit = (state[half] == PixelState.MEASURED) | (state[half] == PixelState.UNCLEAR)
        self.contradiction = None
        if lit.sum() > _LEAST_IN_BIN and float(rough[half][lit].mean()) > (_RANDOM_CELLS if plan.bits else _RANDOM):
            self.contradiction = "fine and coarse patterns contradict one another: frames may be one pattern late"
            return None
        in_bands(_alone_kernel, shape[0], raw, reach, state, depth, sigma)
        if self._limits is not None:
            in_bands(_limit_kernel, shape[0], *self._limits, self._most_sigma_mm, depth, sigma, state, grey)
        moved_mm = None
        if self._earlier:
            change = np.abs(depth[few] - self._earlier[0])[state[few] == PixelState.MOVED]
            change = change[np.isfinite(change)]
            moved_mm = float(np.median(change)) if len(change) else None
        self._earlier.append(depth[few].copy())
        times = [each for each in self._times if each is not None]
        end_s, begin_s = max(end for _, end in times), min(begin for begin, _ in times)
        return DepthImage(depth, sigma, grey, state, end_s, end_s - begin_s, moved_mm, self._blur_px())

    def forget(self) -> None:
        """Count no frame that has come so far. Sums stay, as the frames that they are of do."""
        self._seen[:], self._refused_in_a_row[:] = 0, 0
        self._times = [None] * len(self._times)
        self._noise = None
        self._earlier.clear()

    def share_in_volume(self, points: NDArray[np.float64]) -> float | None:
        """Return the share of points (n, 3), mm in the camera's frame, within the volume that was calibrated; None if
        that is unknown.
        """
        solved, camera = self.seen.solved, self.seen.camera
        if solved is None:
            return None
        world = (points - camera.translation_mm) @ camera.rotation
        low, high = solved.volume_mm.min(axis=0), solved.volume_mm.max(axis=0)
        return round(float(np.mean(((world >= low) & (world <= high)).all(axis=1))), 4)

    def _fault(self, pattern: int, lattice: Pixels) -> str | None:
        """Return why a frame cannot show this pattern, None if nothing speaks against it. Updates the noise."""
        few = np.ascontiguousarray(lattice[::_SAMPLED, ::_SAMPLED])
        seen = np.flatnonzero(self._seen)
        for other in seen:
            if other != pattern and few[0, 0] == self._few[other, 0, 0] and np.array_equal(few, self._few[other]):
                return f"it is the frame of pattern {other + 1} once more: the camera delivered an old one"
        if pattern == 0 or not self._noise:
            self._spatial = _spatial_variance(lattice)
        if not len(seen):
            return None
        if pattern == 0 or not self._noise:
            # Light that differs between patterns.
            stack = self._few[seen]
            self._lit = stack.max(0).astype(np.float32) - stack.min(0) > 2 * _LEAST_MODULATION * self._full_scale
        if not self._seen[pattern]:
            return None
        new, old = few.astype(np.float32), self._few[pattern].astype(np.float32)
        read, slope = self._noise or (self._spatial, 0.0)
        same = _same_share(new, old, self._lit, read, slope)
        if same < _SAME_SHARE:
            others = {
                k: _same_share(new, self._few[k].astype(np.float32), self._lit, read, slope)
                for k in map(int, seen)
                if k != pattern
            }
            nearest = max(others, key=lambda k: others[k], default=pattern)
            if others and others[nearest] > max(_SAME_SHARE, same + 0.2):
                return f"it shows pattern {nearest + 1}: the frames came in another order, or late"
        if pattern == self.plan.fine[0] or self._noise is None:
            self._learn_noise(new, old, self._spatial)
        return None

    def _learn_noise(self, new: Float32, old: Float32, spatial: float) -> None:
        """Fit the variance read + slope · value of a sample to the changes from cycle to cycle.

        Where everything moves they are no noise; what neighbours in one frame differ by bounds it. A recording that is
        repeated does not change at all, and there it is the noise.
        """
        mean, change = (new + old) / 2, new - old
        usable = (mean < self._clipped_at) & (new < self._clipped_at) & (old < self._clipped_at)
        bins = np.clip((mean / self._full_scale * _BINS).astype(np.int64), 0, _BINS - 1)
        at, variances, counts = [], [], []
        for each in range(_BINS):
            inside = usable & (bins == each)
            if inside.sum() < _LEAST_IN_BIN:
                continue
            squared = change[inside] ** 2
            # A quarter that stands still is enough; of noise, it lies below 0.1 of the variance.
            variance = float(np.quantile(squared, 0.25)) / 0.1015
            for _ in range(3):
                variance = float(squared[squared <= 9 * max(variance, 1.0)].mean())
            at.append(float(mean[inside].mean()))
            variances.append(variance / 2)
            counts.append(int(inside.sum()))
        if not at:
            return
        values, found, weights = np.array(at), np.array(variances), np.sqrt(counts) / np.maximum(variances, _ROUNDING)
        slope, read = np.polyfit(values, found, 1, w=weights) if len(at) > 1 else (0.0, found[0])
        if slope < 0:
            slope, read = 0.0, np.average(found, weights=weights**2)
        elif read < _ROUNDING:
            read = _ROUNDING
            slope = max(float(weights**2 @ (values * (found - read)) / (weights**2 @ values**2)), 0.0)
        level = float(read + slope * values.mean())
        if level > 4 * spatial + _ROUNDING:
            read, slope = read * (4 * spatial + _ROUNDING) / level, slope * (4 * spatial + _ROUNDING) / level
        elif level < 0.05 * spatial:
            read, slope = spatial, 0.0
        kept = 0.0 if self._noise is None else _MEMORY
        before = self._noise or (0.0, 0.0)
        self._noise = (
            kept * before[0] + (1 - kept) * max(float(read), _ROUNDING), kept * before[1] + (1 - kept) * float(slope)
        )  # fmt: skip

    def _harmonic(self) -> float:
        """Third harmonic of the fine sinusoid over its first, by which four steps move the phase.

        A projector's gamma, (½ + ½ cos θ)^γ, makes second and third harmonics of (γ − 1)/(γ + 2) and
        (γ − 1)(γ − 2)/((γ + 2)(γ + 3)). Blur that leaves a share g of the first leaves g⁴ and g⁹ of them. The second is
        what the frames half a period apart do not add up by.
        """
        plan, frames = self.plan, self._frames
        if frames is None or len(plan.fine) != STEPS or not plan.coarse:
            return 0.0
        i0, i1, i2, i3 = (self._samples(index) for index in plan.fine)
        real, imaginary = i0 - i2, i1 - i3
        lit = real * real + imaginary * imaginary > (8 * _LEAST_MODULATION * self._full_scale) ** 2
        for each in (i0, i1, i2, i3):
            lit &= each < self._clipped_at
        if lit.sum() < _LEAST_IN_BIN:
            return 0.0
        # Σ ± I = 4 c₂ cos 2θ, and real² − imaginary² = (2 c₁)² cos 2θ.
        real, imaginary, odd = real[lit], imaginary[lit], (i0 - i1 + i2 - i3)[lit]
        amplitude = np.hypot(real, imaginary)
        double = (real * real - imaginary * imaginary) / amplitude
        c0, c1, c2, c3 = (self._samples(index)[lit] for index in plan.coarse)
        self._left = float(np.clip(np.median(amplitude / np.maximum(np.hypot(c0 - c2, c1 - c3), 1)), 0.3, 1.0))
        second = float((odd @ double) / (double @ double)) / 2 / self._left**3
        gamma = float(np.clip((1 + 2 * second) / max(1 - second, 0.1), 0.3, 4.0))
        return (gamma - 1) * (gamma - 2) / ((gamma + 2) * (gamma + 3)) * self._left**8

    def _samples(self, index: int) -> Float32:
        return np.asarray(self._few[index], np.float32)

    def _blur_px(self) -> float | None:
        if not self.plan.coarse:
            return None
        return self.plan.fine_px / (math.pi * math.sqrt(2)) * math.sqrt(-math.log(self._left))


def _same_share(new: Float32, old: Float32, lit: NDArray[np.bool_], read: float, slope: float) -> float:
    """Share of the lit samples whose change noise explains."""
    if not lit.any():
        return 1.0
    change = new[lit] - old[lit]
    return float(np.mean(change * change <= _SAME * 2 * (read + slope * old[lit] + _ROUNDING)))


def _spatial_variance(image: Pixels) -> float:
    """Variance of the noise of one frame by what a second difference along rows and columns leaves of it, DN².

    Immerkær's operator (1996) has a gain of 36, and leaves nothing of what varies along one axis only.
    """
    middle = len(image) // 2
    part = np.ascontiguousarray(image[max(middle - 64, 0) : middle + 64], np.float32)
    operator = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
    left = cv2.filter2D(part, -1, operator)[1:-1, 1:-1]
    return float(np.median(np.abs(left[::3, ::3])) / 0.6745) ** 2 / 36 + _ROUNDING


# Loops over few arrays each: with more, the compiler cannot prove that they do not overlap, and does not vectorise.
@kernel(in_every_scan=False)
def _take_kernel(
    first: int, last: int, new: Any, old: Any, changes: Any, changed: Any, clipped: Any, read: Any, slope: Any,
    clipped_at: Any, summed: bool, in_total: Any, in_real: Any, in_imaginary: Any, total: Any, real: Any,
    imaginary: Any,
) -> None:  # fmt: skip
    """Put a frame in place of the one before."""
    columns = new.shape[1]
    difference = np.zeros(columns, np.float32)
    over = np.zeros(columns, np.uint8)
    for y in range(first, last):
        for x in range(columns):
            difference[x] = np.float32(new[y, x]) - np.float32(old[y, x])
        for x in range(columns):
            variance = read + slope * np.float32(new[y, x])
            over[x] = np.uint8(min(difference[x] * difference[x] * np.float32(_UNITS / 2) / variance, np.float32(255)))
        for x in range(columns):
            changed[y, x] += np.uint16(over[x]) - np.uint16(changes[y, x])
        for x in range(columns):
            changes[y, x] = over[x]
        for x in range(columns):
            clipped[y, x] += np.uint16(np.float32(new[y, x]) >= clipped_at) - np.uint16(
                np.float32(old[y, x]) >= clipped_at
            )
        for x in range(columns):
            old[y, x] = new[y, x]
        if summed:
            for x in range(columns):
                total[y, x] += in_total * difference[x]
            for x in range(columns):
                real[y, x] += in_real * difference[x]
            for x in range(columns):
                imaginary[y, x] += in_imaginary * difference[x]


@kernel_part(inline="always")
def _angle(y: Any, x: Any) -> Any:
    """arctan2(y, x) without branches, to 2e-6 rad (minimax polynomial of Abramowitz and Stegun, 4.4.49)."""
    across, up = abs(x), abs(y)
    steep = up > across
    low, high = (across, up) if steep else (up, across)
    t = low / max(high, np.float32(1e-20))
    s = t * t
    series = np.float32(0.0028662257) * s + np.float32(-0.0161657367)
    series = series * s + np.float32(0.0429096138)
    series = series * s + np.float32(-0.0752896400)
    series = series * s + np.float32(0.1065626393)
    series = series * s + np.float32(-0.1420889944)
    series = series * s + np.float32(0.1999355085)
    series = series * s + np.float32(-0.3333314528)
    series = series * s + np.float32(1.0)
    angle = series * t
    angle = np.float32(np.pi / 2) - angle if steep else angle
    angle = np.float32(np.pi) - angle if x < 0 else angle
    return -angle if y < 0 else angle


@kernel(in_every_scan=False)
def _code_kernel(
    first: int, last: int, bits: Any, level: Any, share: Any, cell_px: Any, offset_px: Any, rough: Any, uncertain: Any
) -> None:
    """Fill in the middle of the Gray cell of each pixel; a bit is lit if it is brighter than a share of `level`."""
    for y in range(first, last):
        for x in range(rough.shape[1]):
            mean = level[y, x] * share
            cell, lit = 0, 0
            for k in range(len(bits)):
                lit ^= 1 if np.float32(bits[k, y, x]) > mean else 0
                cell = 2 * cell + lit
            rough[y, x] = np.float32(cell) * cell_px + offset_px
            uncertain[y, x] = np.float32(0)


@kernel(in_every_scan=False)
def _coarse_kernel(
    first: int, last: int, real: Any, imaginary: Any, total: Any, harmonic: Any, period_px: Any, steps: Any,
    fine_steps: Any, read: Any, slope: Any, rough: Any, uncertain: Any,
) -> None:  # fmt: skip
    """Fill in the position by the coarse phase, and its standard deviation, projector px."""
    per_radian = period_px / np.float32(2 * np.pi)
    for y in range(first, last):
        for x in range(rough.shape[1]):
            c, s = real[y, x], imaginary[y, x]
            squared = max(c * c + s * s, np.float32(1e-6))
            angle = _angle(s, c) + harmonic * np.float32(4) * s * c * (c * c - s * s) / (squared * squared)
            angle = angle + np.float32(2 * np.pi) if angle < 0 else angle
            rough[y, x] = angle * per_radian
        for x in range(rough.shape[1]):
            c, s = real[y, x], imaginary[y, x]
            squared = max(c * c + s * s, np.float32(1e-6))
            variance = (read + slope * total[y, x] / fine_steps) * steps * np.float32(0.5)
            uncertain[y, x] = per_radian * np.sqrt(variance / squared)


@kernel(in_every_scan=False)
def _depth_kernel(
    first: int, last: int, real: Any, imaginary: Any, total: Any, changed: Any, clipped: Any, rough: Any,
    uncertain: Any, steps: Any, period_px: Any, extent_px: Any, apart: Any, harmonic: Any, read: Any, slope: Any,
    least: Any, scale: Any, middle: Any, inverse: Any, rise: Any, bend: Any, cubic: Any, near: Any, half: Any,
    far: Any, depth_mm: Any, depth: Any, sigma: Any, grey: Any, state: Any, reach: Any, found: Any,
) -> None:  # fmt: skip
    columns = depth.shape[1]
    per_radian = period_px / np.float32(2 * np.pi)
    least_squared = (least * steps / 2) ** 2
    near_mm, far_mm = np.float32(NEAREST) * depth_mm, np.float32(FARTHEST) * depth_mm
    position, deviation, numbered = np.zeros((3, columns), np.float32)
    for y in range(first, last):
        for x in range(columns):
            c, s = real[y, x], imaginary[y, x]
            squared = max(c * c + s * s, np.float32(1e-6))
            angle = _angle(s, c) + harmonic * np.float32(4) * s * c * (c * c - s * s) / (squared * squared)
            position[x] = angle * per_radian
        for x in range(columns):
            # ∂θ/∂I_k = (sin α_k cos θ − cos α_k sin θ)/|Z|: the mean of its square is half.
            c, s = real[y, x], imaginary[y, x]
            variance = (read + slope * total[y, x] / steps) * steps * np.float32(0.5)
            deviation[x] = per_radian * np.sqrt(variance / max(c * c + s * s, np.float32(1e-6)))
        for x in range(columns):
            turns = (rough[y, x] - position[x]) / period_px
            whole = np.rint(turns)
            numbered[x] = abs(turns - whole)
            position[x] += whole * period_px
        for x in range(columns):
            rough[y, x] = numbered[x]
        for x in range(columns):
            u = position[x]
            depth[y, x] = u - middle[y, x] + cubic[y, x] * ((u - near) * (u - half) * (u - far))
        for x in range(columns):
            reach[y, x] = np.float32(1) + bend[y, x] * depth[y, x]
        for x in range(columns):
            depth[y, x] = reach[y, x] / (inverse[y, x] + rise[y, x] * depth[y, x])
        for x in range(columns):
            # Depth per projector pixel.
            z_over = depth[y, x] / reach[y, x]
            reach[y, x] = z_over * z_over * abs(rise[y, x] - bend[y, x] * inverse[y, x])
        for x in range(columns):
            sigma[y, x] = reach[y, x] * deviation[x]
        for x in range(columns):
            reach[y, x] *= np.float32(_NEIGHBOUR) * period_px
        for x in range(columns):
            grey[y, x] = np.uint8(min(max(total[y, x] * scale / steps, np.float32(0)), np.float32(255)))
        for x in range(columns):
            c, s = real[y, x], imaginary[y, x]
            squared = c * c + s * s
            noise = (read + slope * total[y, x] / steps) * (np.float32(_LIT) * steps / 2) ** 2
            dark = (
                squared < least_squared or squared < noise or uncertain[y, x] > np.float32(_MOST_UNCERTAIN) * period_px
            )
            outside = position[x] < np.float32(_BORDER_PX) or position[x] > extent_px - np.float32(_BORDER_PX)
            z = depth[y, x]
            moved = changed[y, x] > np.uint16(_MOVED * _UNITS)
            if clipped[y, x] > 0:
                state[y, x] = 2
            elif dark:
                state[y, x] = 3
            elif np.isnan(z):
                state[y, x] = 5
            elif numbered[x] > apart or not near_mm < z < far_mm:
                state[y, x] = 4
            elif outside:
                state[y, x] = 5
            else:
                state[y, x] = 0
            found[y, x] = z if moved and state[y, x] == 0 else np.float32(np.nan)
            if moved and state[y, x] != 2:
                # Light that changes may cancel itself: it is not dark there.
                state[y, x] = 1
            if state[y, x] > 0:
                depth[y, x] = np.float32(np.nan)


@kernel(in_every_scan=False)
def _alone_kernel(first: int, last: int, raw: Any, reach: Any, state: Any, depth: Any, sigma: Any) -> None:
    """Refuse a pixel with fewer than three measured neighbours at nearly its depth: at steps light of two surfaces
    mixes, and among moved ones it agrees by chance. Fills in depth and σ.
    """
    rows, columns = raw.shape
    beside = np.zeros(columns, np.int32)
    for y in range(first, last):
        beside[:] = 0
        for row in range(max(y - 1, 0), min(y + 2, rows)):
            for x in range(columns):
                beside[x] += np.int32(abs(raw[row, x] - raw[y, x]) <= reach[y, x])
            for x in range(1, columns):
                beside[x] += np.int32(abs(raw[row, x - 1] - raw[y, x]) <= reach[y, x])
            for x in range(columns - 1):
                beside[x] += np.int32(abs(raw[row, x + 1] - raw[y, x]) <= reach[y, x])
        for x in range(columns):
            # It counts itself.
            if state[y, x] == 0 and beside[x] < 4:
                state[y, x] = 4
        for x in range(columns):
            depth[y, x] = raw[y, x] if state[y, x] == 0 else depth[y, x]
        for x in range(columns):
            sigma[y, x] = np.float32(np.nan) if np.isnan(depth[y, x]) else sigma[y, x]


@kernel(in_every_scan=False)
def _limit_kernel(
    first: int, last: int, near: Any, far: Any, most_sigma: Any, depth: Any, sigma: Any, state: Any, grey: Any
) -> None:
    """Take away what is outside of the region: depths beyond its limits, and everything where it is not seen."""
    for y in range(first, last):
        for x in range(depth.shape[1]):
            if near[y, x] >= far[y, x]:
                grey[y, x] = 0
            elif not (depth[y, x] < near[y, x] or depth[y, x] > far[y, x] or sigma[y, x] > most_sigma):
                continue
            state[y, x] = 6
            depth[y, x] = np.float32(np.nan)
            sigma[y, x] = np.float32(np.nan)

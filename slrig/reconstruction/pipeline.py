"""Reconstruction pipeline: the steps from the frames of one camera and axis to linked curves.

The steps, in order, by the names under which they are reported:

1. measure noise: estimate noise and gamma of the camera and find the lit pixels (`camera_response`, `decoded_image`);
2. decode: read the Gray code at each pixel (`decoding`);
3. locate stripes: find sub-pixel points of lines or code edges in each frame (`stripes`);
4. refine stripes: align the points by the phase of all line frames (`phase`, `blur`, `refinement`);
5. identify stripes: chain points and look up their projector position (`stripes`, `identification`);
6. link stripes: join the stripes of each position into one curve (`identification`).

With sinusoids, step 2 gives the position at each pixel (`sinusoids`), and step 4 all points, on its levels.

`CameraStream` runs them as frames arrive, `camera_curves` on frames that are all there. The curves of all cameras are
then triangulated (`triangulation`), merged (`merging`) and given standard deviations (`uncertainty`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import FloatArray, IntArray, NoiseModel, Pattern, Refusal
from slrig.reconstruction.bit_agreement import bit_agreement
from slrig.reconstruction.blur import correct_curvature, estimate_blur
from slrig.reconstruction.camera_response import (
    CameraResponse,
    edge_pixel_sum,
    phase_pixel_sum,
    sinusoid_pixel_sum,
)
from slrig.reconstruction.decoded_image import (
    CodeTables,
    DecodedImage,
    ReconstructionLimits,
    cell_width_px,
    code_edge_points,
    light_from_surfaces,
    line_image,
    linearise_frames,
    undecoded_image,
)
from slrig.reconstruction.decoding import (
    CodeMap,
    DecodingLimits,
    RegionMask,
    cells_beyond,
    decode,
    decode_edges,
    lit_pixels,
    refuse_outside_region,
    unresolved_bits,
    unresolved_lines,
)
from slrig.reconstruction.frames import AxisFrames, FrameStacks
from slrig.reconstruction.identification import (
    NumberedStripes,
    StripeEnsemble,
    identify_stripes,
    link_stripes,
    mark_refused_pixels,
)
from slrig.reconstruction.phase import (
    PositionMap,
    asymmetry_sigma_px,
    centroid_residual_px,
    line_step_px,
    near_edges,
    near_shadows_by_blur,
    near_steps,
    position_map,
    resample_to_pixel_centres,
    step_sigma_px,
)
from slrig.reconstruction.refinement import refine_points
from slrig.reconstruction.sinusoids import SinusoidResponse, code_cell_count, decode_sinusoids
from slrig.reconstruction.stripes import LinePoints, StripeLimits, chain_stripes, stripe_points, stripe_width_px

# Chosen: at 0.7 px, narrow stripes are found with three times the error.
_MIN_SCALE_PX = 1.0
_MAX_SCALE_PX = 2.5  # chosen; half and double make no difference to refined points
_REACH_PX = 16  # of the widest filter, 9 px, and of a point's offset from its pixel
_MIN_SAMPLED_POINTS = 4_000  # of a frame: their median is known to a thirtieth of their scatter
_BAND_ROWS, _MAX_BAND_SPACING = 8, 16  # rows of a sampled band; a band in so many at least
_MIN_FILTER_ONLY_PX = 2.0  # a filter so wide sums more pixels than the fit to the phase, and has less noise
# Long periods in little light scatter: most points of a dark surface have a σ of about 1 px, and state it.
_SINUSOID_POINTS = {"start_sigma_px": np.inf, "coarsest_px": 1.0}
_MIN_SMOOTHED_PX = 1.4  # stripe and filter together: see `_matched_scale_px`


@dataclass(frozen=True, slots=True)
class CameraCurves:
    """Linked curves of one camera, and how they were found.

    refusal : (H, W) uint8, `Refusal`; stripe_points, stripe_count : before linking. refined : True if the points are
    those of `refinement.refine_points`; disagreement_px : as in `refinement.Refinement`, empty without phase.
    bits_displaced_px : as in `bit_agreement.BitAgreement`, empty where all points are of lines. unresolved : (H, W)
    uint8, number of finest bits left out at each pixel; None where bits only number lines. unresolved_lines : (H, W)
    bool, where code edges replace lines that the camera does not resolve; None if nowhere. compression_dn : standard
    deviation of white noise that displaces positions as much as the loss by compression; 0 for frames without loss.
    noise_correlation, gamma : as in `camera_response.CameraResponse`. sinusoids : relation of light to the values of
    sinusoids, None without. beyond_pixels : number of pixels whose code names a cell that the projector does not have;
    furthest_cell : of these cells, the one farthest from the projector's that more than a hundredth of the pixels name,
    -1 without any. light_from_surfaces : as `decoded_image.light_from_surfaces` returns it. clipped_white, clipped_code
    : number of lit pixels that are clipped in white, and in a frame of the code. sample_step, full_scale : as in
    `frames.SampleFormat`.
    """

    ensemble: StripeEnsemble
    refusal: NDArray[np.uint8]
    noise: NoiseModel
    scale_px: float
    decoded_pixels: int
    stripe_points: int
    stripe_count: int
    refined: bool
    disagreement_px: FloatArray
    unresolved: NDArray[np.uint8] | None = None
    unresolved_lines: NDArray[np.bool_] | None = None
    compression_dn: float = 0.0
    noise_correlation: float = 1.0
    gamma: float = 1.0
    sinusoids: SinusoidResponse | None = None
    beyond_pixels: int = 0
    furthest_cell: int = -1
    light_from_surfaces: tuple[float, float] = (0.0, 0.0)
    clipped_white: int = 0
    clipped_code: int = 0
    sample_step: float = 1.0
    full_scale: float = 0.0
    bits_displaced_px: FloatArray = field(default_factory=lambda: np.zeros(0))


def camera_curves(
    frames: AxisFrames,
    tables: CodeTables,
    limits: ReconstructionLimits,
    /,
    *,
    report_step: Callable[[str], None],
    noise: NoiseModel | None = None,
    region: RegionMask | None = None,
) -> CameraCurves:
    """Reconstruct the curves of one camera from all its frames; keywords as for `CameraStream`."""
    stacks = FrameStacks.from_frames(frames)
    return CameraStream(stacks, tables, limits, report_step=report_step, noise=noise, region=region).finish()[0]


class CameraStream:
    """Reconstruction of one camera and axis that takes the frames one by one.

    Each step runs as soon as its frames are there: points are located in each line frame once the response of the
    camera is known, and the code is read once its last frame is there. Frames may come in any order, with the same
    result to the bit.

    noise : if it is known; estimated otherwise. report_step : called with the name of each step as it begins.
    region : pixels to reconstruct; None for all.
    """

    def __init__(
        self,
        stacks: FrameStacks,
        tables: CodeTables,
        limits: ReconstructionLimits,
        /,
        *,
        report_step: Callable[[str], None],
        noise: NoiseModel | None = None,
        region: RegionMask | None = None,
    ) -> None:
        self._stacks = stacks
        self._region = region
        self._noise = noise
        self._tables = tables
        self._limits = limits
        self._report_step = report_step
        self._image: DecodedImage | None = None
        self._has_code = False
        self._reference: tuple[NDArray[np.float32], NDArray[np.float32]]
        self._scale: _FilterScale | None = None
        self._points: list[LinePoints] = []
        self._curves: CameraCurves | None = None

    def take(self, pattern: Pattern, image: NDArray[Any]) -> None:
        """Take the (H, W) image of a pattern; of a pattern with repeats, their mean."""
        self._stacks.put(pattern, image)
        self._advance()

    def finish(self) -> tuple[CameraCurves, AxisFrames]:
        """Return the curves and their frames, with white and black as the camera gave them.

        Raises
        ------
        PatternError
            Frames are missing.
        """
        image = self._advance()
        if image is None or self._curves is None:
            missing = sorted(map(repr, self._stacks.missing))
            message = f"{len(missing)} of the frames announced are missing: {'; '.join(missing)}; capture them again"
            raise PatternError(message)
        white, black = self._reference
        return self._curves, replace(image.frames, white=white, black=black)

    def _advance(self) -> DecodedImage | None:
        """Run the steps whose frames are there."""
        image, stacks = self._image, self._stacks
        if image is None and stacks.has_noise_patterns:
            image = self._measure_noise()
        if image is None or self._curves is not None:
            return image
        if not self._has_code and stacks.has_code_patterns:
            image = self._decode(image)
        # The code is needed first where it selects the region, or where its edges replace lines.
        if self._has_code or (stacks.patterns.lines and self._region is None):
            image = self._locate_stripes(image)
        self._image = image
        if self._scale is not None and not stacks.missing:
            self._curves = _refine_identify_link(
                image, self._points, self._scale, self._tables, self._limits, self._report_step, stacks
            )  # fmt: skip
        return image

    def _measure_noise(self) -> DecodedImage:
        """Estimate the response of the camera and find the lit pixels."""
        self._report_step("measure noise")
        frames = self._stacks.frames()
        self._reference = frames.white, frames.black
        if self._noise is None:
            frames, response = linearise_frames(self._stacks, self._limits.decoding)
        else:
            response = CameraResponse(self._noise)
        return undecoded_image(frames, response, self._limits)

    def _decode(self, image: DecodedImage) -> DecodedImage:
        """Read the code and refuse pixels outside the region."""
        self._report_step("decode")
        self._has_code = True
        frames, tables = image.frames, self._tables
        unresolved = None
        given = (
            frames, image.response.noise, tables.index_of_word, len(tables.cell_position), self._limits.decoding
        )  # fmt: skip
        if frames.sine_patterns:
            image = _decode_by_sinusoids(image, tables, self._limits.decoding)
            code = image.code
        elif self._stacks.patterns.lines:
            code = decode(*given)
        else:
            code, unresolved = decode_edges(*given)
        region = None
        if self._region is not None:
            region = self._region.mask(frames, code, tables.cell_position)
            code = refuse_outside_region(code, region)
        return replace(image, code=code, unresolved=unresolved, region=region)

    def _locate_stripes(self, image: DecodedImage) -> DecodedImage:
        """Find the points of the line frames that are there, or of all code edges."""
        if self._stacks.patterns.sines:
            self._scale = _FilterScale(_MIN_SCALE_PX, _MIN_SCALE_PX, sampled=True)
            self._points = [_no_points() for _ in self._tables.position_table]
            return image
        if self._scale is None and not self._stacks.patterns.lines:
            self._report_step("locate stripes")
            scale_px = self._limits.stripes.filter_px or _MIN_SCALE_PX
            self._scale = _FilterScale(scale_px, _MIN_SCALE_PX)
            image = image.with_position_noise(image.frames.bits, edge_pixel_sum(scale_px))
            self._points = code_edge_points(image, self._limits.stripes, scale_px)
        # By shift, in whichever order frames come: the stripes of the first shift set the scale for all.
        for pattern in self._stacks.patterns.lines[len(self._points) :]:
            if not self._stacks.has(pattern):
                break
            self._report_step("locate stripes")
            if self._scale is None:
                image = image.with_position_noise(
                    image.frames.lines[:1], phase_pixel_sum(image.frames, image.search_mask)
                )
                self._scale = self._choose_scale(image)
            scale, rows = self._scale, self._scale.rows
            line, deviation = line_image(image, len(self._points), rows.index)
            lit = image.search_mask[rows.index] & rows.inner
            points = stripe_points(line, deviation, lit, self._limits.stripes, filter_px=scale.filter_px)
            self._points.append(rows.to_image_rows(points))
        return image

    def _choose_scale(self, image: DecodedImage) -> _FilterScale:
        """Measure the width of the stripes and choose the filter for it."""
        phase_suffices = _phase_finds_all_points(image.frames)
        rows = _sampled_rows(image) if phase_suffices else _ALL_ROWS
        line, deviation = line_image(image, 0, rows.index)
        blur_px = stripe_width_px(line, deviation, image.search_mask[rows.index] & rows.inner)
        filter_px = self._limits.stripes.filter_px or _matched_scale_px(blur_px)
        sampled = phase_suffices and filter_px < _MIN_FILTER_ONLY_PX
        return _FilterScale(filter_px, blur_px, sampled, rows if sampled else _ALL_ROWS)


def _decode_by_sinusoids(image: DecodedImage, tables: CodeTables, limits: DecodingLimits) -> DecodedImage:
    """Measure positions by sinusoids, within the cells of the code if there is one."""
    frames, noise = image.frames, image.response.noise
    found = decode_sinusoids(frames, noise, tables.index_of_word, tables.extent_px, limits)
    period_px = frames.phase_frames[2]
    image = replace(image, code=found.code).with_position_noise(
        frames.sinusoids, sinusoid_pixel_sum(found.measured.position, period_px)
    )
    middle = np.asarray(frames.white + frames.black, dtype=np.float32) / np.float32(2)
    wider = np.sqrt(np.divide(image.position_noise.variance(middle), noise.variance(middle)))
    return replace(
        image, sinusoids=found._replace(measured=found.measured._replace(sigma=found.measured.sigma * wider))
    )


def _no_points() -> LinePoints:
    empty = np.zeros((0, 2))
    return LinePoints(empty, empty, np.zeros(0), np.zeros(0, dtype=np.bool_), np.zeros(0))


@dataclass(frozen=True, slots=True)
class AlignedPoints:
    """Points of each line frame, or of each bit, and the code with the causes of refused pixels.

    near_shadow, near_step : (H, W) bool, where no point counts; refined, disagreement_px : as in `CameraCurves`.
    frame_sigma_px : as in `refinement.Refinement`, not yet in the points.
    """

    points: list[LinePoints]
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    near_step: NDArray[np.bool_]
    refined: bool
    disagreement_px: FloatArray
    frame_sigma_px: FloatArray


def align_points(
    image: DecodedImage, found: list[LinePoints], stripe_blur_px: float, tables: CodeTables,
    limits: ReconstructionLimits, release_lines: Callable[[], None], *, sampled: bool,
) -> AlignedPoints:  # fmt: skip
    """Move points to the positions measured by all line frames, if the light was the same in all of them.

    found : is emptied. stripe_blur_px : blur by the width of the stripes, the projector's included. release_lines :
    called when the line images are not needed any more, before the largest allocation. sampled : as for
    `refinement.refine_points`.
    """
    frames, code, disagreement_px, points = image.frames, image.code, np.zeros(0), found
    frame_sigma_px = np.zeros(len(found))
    resolution_px = cell_width_px(image)
    step_px: int | None
    if image.sinusoids is not None:
        position, sigma = image.sinusoids.measured
        measured, step_px = PositionMap(np.where(code.refusal == 0, position, np.float32(np.nan)), sigma), 1
    else:
        measured = position_map(frames, image.position_noise, code, tables.cell_position)
        step_px = line_step_px(frames.line_patterns)
    if step_px is not None:
        resolution_px = 0.0
        _, _, period_px = frames.phase_frames
        blur_px, from_lines = estimate_blur(frames, measured, ~image.near_shadow, limits.camera_blur_px)
        near_shadow = near_shadows_by_blur(blur_px, image.near_shadow, image.unlit, limits.edges)
        prints = None if from_lines else ~near_shadow
        centred = resample_to_pixel_centres(
            measured, frames.contrast, image.contrast_deviation, blur_px, clear=prints
        )  # fmt: skip
        near_step = near_steps(centred, resolution_px, limits.edges)
        usable = np.isfinite(centred.position) & ~near_shadow & ~near_step
        residual_px = centroid_residual_px(measured, centred, usable, blur_px, period_px, near_shadow)
        asymmetry_px = asymmetry_sigma_px(frames, measured, centred, usable, image.position_noise)
        measured = correct_curvature(centred, usable, blur_px**2, period_px)
        extra_sigma_px = np.sqrt(step_sigma_px(near_step) ** 2 + residual_px**2 + asymmetry_px**2)
        del centred, residual_px, asymmetry_px
        marked = mark_refused_pixels(
            code, frames, measured.position, tables.position_table, near_shadow, near_step
        )  # fmt: skip
        refinement = refine_points(
            found, measured, usable, code, tables.position_table, step_px, extra_sigma_px=extra_sigma_px,
            max_disagreement_px=limits.max_disagreement_px, sampled=sampled, release_lines=release_lines,
            **({} if image.sinusoids is None else _SINUSOID_POINTS),
        )  # fmt: skip
        points, disagreement_px, frame_sigma_px = (
            refinement.points, refinement.disagreement_px, refinement.frame_sigma_px
        )  # fmt: skip
        if image.sinusoids is not None:
            # The levels are of all frames together.
            disagreement_px = np.zeros(0)
        if refinement.accepted:
            return AlignedPoints(points, marked, near_shadow, near_step, True, disagreement_px, frame_sigma_px)
    # A fit leaves out pixels of mixed light; the window of a filter has to be clear of them.
    near_shadow, near_step = near_edges(measured, image.unlit, resolution_px, limits.edges.for_filters(stripe_blur_px))
    return AlignedPoints(points, code, near_shadow, near_step, False, disagreement_px, frame_sigma_px)


@dataclass(frozen=True, slots=True)
class _FilterRows:
    """Rows of an image in which a filter searches for points: all, or bands with the margin that its window needs.

    index : (n,) row numbers, or a slice of all; inner : (n, 1) bool, rows to search.
    """

    index: IntArray | slice
    inner: NDArray[np.bool_] | Literal[True]

    def to_image_rows(self, points: LinePoints) -> LinePoints:
        """Convert the points from these rows to the rows of the image."""
        if isinstance(self.index, slice):
            return points
        row = np.rint(points.points_px[:, 1]).astype(np.intp)
        points.points_px[:, 1] += self.index[row] - row
        return points


_ALL_ROWS = _FilterRows(slice(None), inner=True)


@dataclass(frozen=True, slots=True)
class _FilterScale:
    """Scale of the filter and blur by the width of the stripes, px.

    sampled : True if the filter finds only some of the points, as for `refinement.refine_points`; rows : where it
    searches.
    """

    filter_px: float
    blur_px: float
    sampled: bool = False
    rows: _FilterRows = _ALL_ROWS


def _phase_finds_all_points(frames: AxisFrames) -> bool:
    """Return True for lines of half their period, whose phase gives every point.

    Narrow lines light too little for that, and the filter contributes to each point.
    """
    patterns = frames.line_patterns
    return line_step_px(patterns) is not None and patterns[0].is_half_lit


def _sampled_rows(image: DecodedImage) -> _FilterRows:
    """Bands of rows with enough points of each frame for `refinement.refine_points` to check its light."""
    frames = image.frames
    points = int(np.count_nonzero(image.search_mask)) // frames.line_patterns[0].period_px
    spacing = _BAND_ROWS * min(points // _MIN_SAMPLED_POINTS, _MAX_BAND_SPACING)
    if spacing <= _BAND_ROWS + 2 * _REACH_PX:
        return _ALL_ROWS
    row = np.arange(len(frames.white))
    distance = np.abs((row - spacing // 2) % spacing - (_BAND_ROWS - 1) / 2)
    near = (distance < _BAND_ROWS / 2 + _REACH_PX) | (distance > spacing - _BAND_ROWS / 2 - _REACH_PX)
    index = np.flatnonzero(near).astype(np.int32)
    return _FilterRows(index, (distance[index] < _BAND_ROWS / 2)[:, None])


def _refine_identify_link(
    image: DecodedImage,
    found: list[LinePoints],
    scale: _FilterScale,
    tables: CodeTables,
    limits: ReconstructionLimits,
    report_step: Callable[[str], None],
    stacks: FrameStacks,
) -> CameraCurves:
    """Run the steps that need all frames: refine, identify and link.

    Large data are released as soon as they are not needed: `found`, the refined points and the images in `stacks`.
    """
    frames, from_surfaces = image.frames, light_from_surfaces(image)
    beyond = cells_beyond(frames, image.code, tables.index_of_word)
    cell_count, bit_count = len(tables.cell_position), len(frames.bits)
    if frames.sine_patterns:
        cell_count = code_cell_count(frames.gray, tables.extent_px)
    clipped_white, clipped_code = _count_clipped(frames, ~image.unlit)
    report_step("refine stripes")
    aligned = align_points(
        image, found, scale.blur_px, tables, limits, stacks.release_line_images, sampled=scale.sampled
    )  # fmt: skip
    if scale.sampled and not aligned.refined:
        aligned.points[:] = [
            stripe_points(*line_image(image, index), image.search_mask, limits.stripes, filter_px=scale.filter_px)
            for index in range(len(frames.lines))
        ]
    points, code, near_shadow, near_step = aligned.points, aligned.code, aligned.near_shadow, aligned.near_step
    for each, sigma_px in zip(points, aligned.frame_sigma_px, strict=True):
        np.hypot(each.sigma_px, sigma_px, out=each.sigma_px)
    report_step("identify stripes")
    shortest = limits.stripes.shortest_points
    numbered, refusal, point_count = _chain_and_identify(
        points, code, tables.position_table, near_shadow, near_step, shortest
    )  # fmt: skip
    without_lines = None
    if tables.edge_table is not None and frames.line_patterns:
        per_cell = len(points) * frames.gray.cell_px / frames.line_patterns[0].period_px
        clear = ~(near_shadow | near_step) & (True if image.region is None else image.region)
        without_lines = unresolved_lines(numbered.stripes.points_px, image.code, clear, per_cell)
    if without_lines is not None and tables.edge_table is not None:
        # Code edges replace the lines that the camera does not resolve.
        del numbered
        report_step("locate stripes")
        image, code = _decode_fewer_bits(image, code, without_lines, tables, limits)
        middles = position_map(frames, image.position_noise, code, tables.cell_position, by_phase=False)
        shadow, step = near_edges(middles, image.unlit, cell_width_px(image), limits.edges.for_filters(scale.blur_px))
        near_shadow, near_step = np.where(without_lines, shadow, near_shadow), np.where(without_lines, step, near_step)
        del middles, shadow, step
        edges = _locate_edges(image, without_lines, limits.stripes, scale.filter_px)
        stacks.release()
        report_step("identify stripes")
        points[:] = [_points_outside(points.pop(0), without_lines) for _ in range(len(points))] + edges
        del edges
        numbered, refusal, point_count = _chain_and_identify(
            points, code, np.vstack([tables.position_table, tables.edge_table]), near_shadow, near_step, shortest,
            release=True,
        )  # fmt: skip
    points.clear()
    stacks.release()
    bits_displaced_px = np.zeros(0)
    if without_lines is not None or not (frames.line_patterns or frames.sine_patterns):
        bits_displaced_px, sigma_px = bit_agreement(numbered, bit_count, frames.gray.cell_px)
        np.hypot(numbered.stripes.sigma_px, sigma_px, out=numbered.stripes.sigma_px)
    decoded = image.code.refusal == Refusal.NONE
    if image.region is not None:
        decoded &= image.region
        refusal[~image.region] = Refusal.OUTSIDE_REGION
    report_step("link stripes")
    return CameraCurves(
        ensemble=link_stripes(numbered),
        refusal=refusal,
        noise=image.response.noise,
        scale_px=scale.filter_px,
        decoded_pixels=int(decoded.sum()),
        stripe_points=point_count,
        stripe_count=len(numbered.stripes),
        refined=aligned.refined,
        disagreement_px=aligned.disagreement_px,
        bits_displaced_px=bits_displaced_px,
        unresolved=image.unresolved,
        unresolved_lines=without_lines,
        compression_dn=float(np.sqrt(image.response.loss_variance)),
        noise_correlation=image.response.noise_correlation,
        gamma=image.response.gamma,
        sinusoids=None if image.sinusoids is None else image.sinusoids.response,
        beyond_pixels=len(beyond),
        furthest_cell=_furthest_cell(beyond, cell_count),
        light_from_surfaces=from_surfaces,
        clipped_white=clipped_white,
        clipped_code=clipped_code,
        sample_step=frames.sample_step,
        full_scale=frames.full_scale,
    )


def _furthest_cell(beyond: IntArray, cell_count: int) -> int:
    if len(beyond) == 0:
        return -1
    is_after = np.count_nonzero(beyond >= cell_count) >= len(beyond) / 2
    return int(np.percentile(beyond, 99 if is_after else 1, method="nearest"))


def _count_clipped(frames: AxisFrames, lit: NDArray[np.bool_]) -> tuple[int, int]:
    """Number of lit pixels that are clipped in white, and in at least one frame of the code."""
    in_white = lit & (frames.white >= frames.clipped_at)
    count = int(np.count_nonzero(in_white))
    if not count:
        return 0, 0
    in_code = np.zeros_like(lit)
    for each in (*frames.bits, *(frames.inverses or ()), *frames.sinusoids):
        in_code |= each >= frames.clipped_at
    return count, int(np.count_nonzero(in_code & lit))


def _chain_and_identify(
    points: list[LinePoints], code: CodeMap, position_table: FloatArray, near_shadow: NDArray[np.bool_],
    near_step: NDArray[np.bool_], shortest_points: int, *, release: bool = False,
) -> tuple[NumberedStripes, NDArray[np.uint8], int]:  # fmt: skip
    """Return the numbered stripes, the refusals (H, W) and the number of points in chains. release : empty `points`."""
    stripes = chain_stripes(points, code.refusal.shape)
    if release:
        points.clear()
    numbered, refusal = identify_stripes(
        stripes, code, position_table, near_shadow, near_step, shortest_points=shortest_points
    )  # fmt: skip
    return numbered, refusal, len(stripes.points_px)


def _decode_fewer_bits(
    image: DecodedImage,
    code: CodeMap,
    without_lines: NDArray[np.bool_],
    tables: CodeTables,
    limits: ReconstructionLimits,
) -> tuple[DecodedImage, CodeMap]:
    """Decode without unresolved bits where lines are lost. Returns the image and `code`, both with the new cells."""
    frames, noise = image.frames, image.response.noise
    bits = unresolved_bits(frames, lit_pixels(frames, noise, limits.decoding))
    rows, cells = _rows_around(without_lines, 0), len(tables.cell_position)
    inside = without_lines[rows]
    fewer, unread = decode_edges(
        frames.rows(rows), noise.rows(rows), tables.index_of_word, cells, limits.decoding, unresolved=bits[rows]
    )
    bits[rows] = unread
    bits[~without_lines] = 0

    # Elsewhere all bits are read, as before. Both maps have the same cells and differ in the causes alone.
    lowest, highest = code.lowest.copy(), code.highest.copy()
    lowest[rows][inside], highest[rows][inside] = fewer.lowest[inside], fewer.highest[inside]

    def replace_cells(before: CodeMap) -> CodeMap:
        refusal = before.refusal.copy()
        refusal[rows][inside] = fewer.refusal[inside]
        return CodeMap(lowest, highest, refusal)

    return replace(image, code=replace_cells(image.code), unresolved=bits), replace_cells(code)


def _locate_edges(
    image: DecodedImage, without_lines: NDArray[np.bool_], limits: StripeLimits, scale_px: float
) -> list[LinePoints]:
    """Points of code edges where lines are lost."""
    rows = _rows_around(without_lines, _REACH_PX)
    found = code_edge_points(image.rows(rows), limits, scale_px, within=without_lines[rows])
    return [each._replace(points_px=each.points_px + np.array([0.0, rows.start])) for each in found]


def _rows_around(mask: NDArray[np.bool_], reach: int) -> slice:
    """From the first row in which the mask is set to the last, with `reach` more on either side."""
    inside = np.flatnonzero(mask.any(axis=1))
    return slice(max(int(inside[0]) - reach, 0), min(int(inside[-1]) + reach + 1, len(mask)))


def _points_outside(points: LinePoints, mask: NDArray[np.bool_]) -> LinePoints:
    """The points of one frame where lines are resolved."""
    columns, rows = np.rint(points.points_px).astype(np.intp).T
    outside = ~mask[rows, columns]
    return LinePoints(*(each[outside] for each in points))


def _matched_scale_px(stripe_width_px: float) -> float:
    """Scale of the Gaussian for stripes of this width, px.

    The width of the stripe itself is the best scale against noise. Stripes too sharp for the pixels are smoothed more:
    below a total of 1.4 px the sampling itself displaces the centre.
    """
    more = np.sqrt(max(_MIN_SMOOTHED_PX**2 - stripe_width_px**2, 0.0))
    return float(np.clip(max(stripe_width_px, more), _MIN_SCALE_PX, _MAX_SCALE_PX))

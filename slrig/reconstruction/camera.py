"""Reconstruction of one camera and axis, frame by frame: noise, code, stripes, refinement, identity, links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import FloatArray, IntArray, Pattern, Refusal
from slrig.reconstruction.blur import freed_of_curvature, told_blur
from slrig.reconstruction.camera_response import edge_sum, in_light, phase_sum
from slrig.reconstruction.coded import (
    Coded,
    CodeTables,
    Limits,
    cell_width_px,
    code_edge_points,
    line_image,
    not_yet_coded,
)
from slrig.reconstruction.decoding import (
    AskedPixels,
    CodeMap,
    decode,
    lit_pixels,
    lost_lines,
    unresolved_bits,
    without_others,
)
from slrig.reconstruction.frames import AxisFrames, FrameStacks
from slrig.reconstruction.identification import StripeEnsemble, identify, link, with_refused_pixels
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.phase import (
    at_pixel_centres,
    beside_steps_px,
    line_step_px,
    near_edges,
    near_shadows_of,
    near_steps,
    position_map,
    third_order_px,
)
from slrig.reconstruction.refinement import refined
from slrig.reconstruction.stripes import LinePoints, StripeLimits, chained, measured_sigma_px, stripe_points


@dataclass(frozen=True, slots=True)
class Placed:
    """Points of each line frame, or of each bit, at their best places, and the code with the causes of those left out.

    near_shadow, near_step : (H, W) bool, where no point counts; refined, disagreement_px : as in `CameraCurves`.
    """

    points: list[LinePoints]
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    near_step: NDArray[np.bool_]
    refined: bool
    disagreement_px: FloatArray


def placed(
    coded: Coded, found: list[LinePoints], stripe_blur_px: float, tables: CodeTables, limits: Limits,
    lines_used: Callable[[], None], *, sampled: bool,
) -> Placed:  # fmt: skip
    """Put the points that were found where the light of all frames puts them, if it was the same in all.

    found : is given away. stripe_blur_px : the blur that the stripes' width tells, the projector's included.
    lines_used : is called when the images of lines are needed no more, before what takes most memory begins.
    sampled : as of `refinement.refined`.
    """
    frames, code, disagreement_px, points = coded.frames, coded.code, np.zeros(0), found
    seen = position_map(frames, coded.position_noise, code, tables.cell_position)
    resolution_px = cell_width_px(coded)
    step_px = line_step_px(frames.line_patterns)
    if step_px is not None:
        resolution_px = 0.0
        period_px = frames.line_patterns[0].period_px
        blur_px, by_lines = told_blur(frames, seen, ~coded.near_shadow, limits.camera_blur_px)
        near_shadow = near_shadows_of(blur_px, coded.near_shadow, coded.unlit, limits.edges)
        prints = None if by_lines else ~near_shadow
        centred = at_pixel_centres(seen, frames.contrast, coded.contrast_deviation, blur_px, clear=prints)
        near_step = near_steps(centred, resolution_px, limits.edges)
        usable = np.isfinite(centred.position) & ~near_shadow & ~near_step
        beyond_px = third_order_px(seen, centred, usable, blur_px, period_px)
        seen = freed_of_curvature(centred, usable, blur_px**2, period_px)
        displaced_px = np.hypot(beside_steps_px(near_step), beyond_px)
        del centred, beyond_px
        known = with_refused_pixels(code, frames, seen.position, tables.position_of, near_shadow, near_step)
        refinement = refined(
            found, seen, usable, code, tables.position_of, step_px, displaced_px=displaced_px,
            largest_disagreement_px=limits.largest_disagreement_px, sampled=sampled, steady=lines_used,
        )  # fmt: skip
        points, disagreement_px = refinement.points, refinement.disagreement_px
        if refinement.moved:
            return Placed(points, known, near_shadow, near_step, True, disagreement_px)
    # A fit to pixels leaves out those of mixed light; a filter's window has to be clear of them.
    near_shadow, near_step = near_edges(seen, coded.unlit, resolution_px, limits.edges.for_filters(stripe_blur_px))
    return Placed(points, code, near_shadow, near_step, False, disagreement_px)


_FINEST_SCALE_PX = 1.0  # at 0.7 px, stripes of 0.7 px are found to 0.027 px rms, at 1.0 px to 0.008
_COARSEST_SCALE_PX = 2.5  # chosen; half and double give the same figures of a rendered vase, refined by phase
_REACH_PX = 16  # of the widest filter, 9 px, and of what a point may lie beside its pixel
_POINTS_TO_JUDGE = 4_000  # of a frame: their median is known to a thirtieth of their scatter
_BAND_ROWS, _MOST_APART = 8, 16  # of sampled rows; one of so many rows at least
_LEAST_TELLING_PX = 2.0  # a filter so wide sums more pixels than the fit, and a tenth of the error goes (out of focus)
_LEAST_SMOOTHED_PX = 1.4  # stripe and filter together: see `_matched_scale_px`


@dataclass(frozen=True, slots=True)
class CameraCurves:
    """What one camera gives. refusal : (H, W) uint8, `Refusal`; stripe_points, stripe_count : before linking.

    refined : the points are those of `refinement.refined`; disagreement_px : as of `refinement.Refinement`, empty where
    there was no phase. unresolved : (H, W) uint8, how many of the finest bits are left out at each pixel; None where
    bits only number lines. lost_lines : (H, W) bool, where code edges stand for lines that the camera does not resolve;
    None if nowhere. compression_dn : standard deviation of the noise that would err positions by as much as what
    compression took from the frames; 0 for frames without loss. shared_noise : as of `camera_response.shared_noise`.
    gamma : how the camera bent its values, which was taken out.
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
    lost_lines: NDArray[np.bool_] | None = None
    compression_dn: float = 0.0
    shared_noise: float = 1.0
    gamma: float = 1.0


class CameraStream:
    """The reconstruction of one camera and axis, fed frame by frame.

    What a frame allows is done when it comes: stripes are located in each line frame once it is known what the camera
    makes of light, the code is read once its last frame is in, and the rest is done once all are in. Frames may come in
    any order, with the same result to the bit.

    noise : where it is known already; it is estimated otherwise. entered : told the name of each stage as it begins.
    asked : the pixels that count.
    """

    def __init__(
        self,
        stacks: FrameStacks,
        tables: CodeTables,
        limits: Limits,
        /,
        *,
        entered: Callable[[str], None],
        noise: NoiseModel | None = None,
        asked: AskedPixels | None = None,
    ) -> None:
        self._stacks = stacks
        self._asked = asked
        self._noise = noise
        self._tables = tables
        self._limits = limits
        self._entered = entered
        self._coded: Coded | None = None
        self._decoded = False
        self._ends: tuple[NDArray[np.float32], NDArray[np.float32]]
        self._scales: _Scales | None = None
        self._points: list[LinePoints] = []
        self._curves: CameraCurves | None = None

    def take(self, pattern: Pattern, image: NDArray[Any]) -> None:
        """Take the (H, W) image of a pattern. Repeats of one pattern come as their mean."""
        self._stacks.put(pattern, image)
        self._go_on()

    def finish(self) -> tuple[CameraCurves, AxisFrames]:
        """The curves, and of the frames that they were found in white and black, as the camera gave them.

        Raises
        ------
        PatternError
            Frames are missing.
        """
        coded = self._go_on()
        if coded is None or self._curves is None:
            missing = sorted(map(repr, self._stacks.missing))
            message = f"{len(missing)} of the frames announced did not come: {'; '.join(missing)}; capture them again"
            raise PatternError(message)
        white, black = self._ends
        return self._curves, replace(coded.frames, white=white, black=black)

    def _go_on(self) -> Coded | None:
        """Do what the frames so far allow."""
        coded = self._coded
        if coded is None and self._stacks.noise_shown:
            coded = self._with_noise()
        if coded is None or self._curves is not None:
            return coded
        if not self._decoded and self._stacks.coded:
            coded = self._with_code(coded)
        # Where some pixels are asked for the code tells which, and without lines its edges stand for them.
        if self._decoded or (self._stacks.patterns.lines and self._asked is None):
            coded = self._locate(coded)
        self._coded = coded
        if self._scales is not None and not self._stacks.missing:
            self._curves = _curves(
                coded, self._points, self._scales, self._tables, self._limits, self._entered, self._stacks
            )  # fmt: skip
        return coded

    def _with_noise(self) -> Coded:
        """What is known of the camera's noise and response, and which pixels are lit, but no code yet."""
        self._entered("measure noise")
        frames = self._stacks.frames()
        self._ends = frames.white, frames.black
        gamma, noise = 1.0, self._noise
        if noise is None:
            frames, noise, gamma = in_light(self._stacks, self._limits.decoding)
        return not_yet_coded(frames, noise, gamma, self._limits)

    def _with_code(self, coded: Coded) -> Coded:
        """The same with the code read, of the pixels that are asked for."""
        self._entered("decode")
        self._decoded = True
        frames, noise, tables, limits = coded.frames, coded.noise, self._tables, self._limits.decoding
        unresolved = None
        if not self._stacks.patterns.lines:
            unresolved = unresolved_bits(frames, ~coded.unlit)
        code = decode(
            frames, noise, tables.index_of_word, len(tables.cell_position), limits, unresolved=unresolved
        )  # fmt: skip
        asked = None
        if self._asked is not None:
            asked = self._asked.told(frames, code, tables.cell_position)
            code = without_others(code, asked)
        return replace(coded, code=code, unresolved=unresolved, asked=asked)

    def _locate(self, coded: Coded) -> Coded:
        if self._scales is None and not self._stacks.patterns.lines:
            self._entered("locate stripes")
            scale_px = self._limits.stripes.sigma_px or _FINEST_SCALE_PX
            self._scales = _Scales(scale_px, _FINEST_SCALE_PX)
            coded = coded.summed(coded.frames.bits, edge_sum(scale_px))
            self._points = code_edge_points(coded, self._limits.stripes, scale_px)
        # By shift, whatever came first: the first one's stripes tell the scale for all.
        for pattern in self._stacks.patterns.lines[len(self._points) :]:
            if not self._stacks.has(pattern):
                break
            self._entered("locate stripes")
            if self._scales is None:
                # The first frame tells for all.
                coded = coded.summed(coded.frames.lines[:1], phase_sum(coded.frames, coded.searched))
                has_all = _phase_has_all(coded.frames)
                rows = _sampled_rows(coded) if has_all else _ALL_ROWS
                image, deviation = line_image(coded, 0, rows.index)
                blur_px = measured_sigma_px(image, deviation, coded.searched[rows.index] & rows.inner)
                filter_px = self._limits.stripes.sigma_px or _matched_scale_px(blur_px)
                sampled = has_all and filter_px < _LEAST_TELLING_PX
                self._scales = _Scales(filter_px, blur_px, sampled, rows if sampled else _ALL_ROWS)
            scales = self._scales
            rows = scales.rows
            image, deviation = line_image(coded, len(self._points), rows.index)
            lit = coded.searched[rows.index] & rows.inner
            points = stripe_points(image, deviation, lit, self._limits.stripes, sigma_px=scales.filter_px)
            self._points.append(rows.placed(points))
        return coded


def camera_curves(
    frames: AxisFrames,
    tables: CodeTables,
    limits: Limits,
    /,
    *,
    entered: Callable[[str], None],
    noise: NoiseModel | None = None,
    asked: AskedPixels | None = None,
) -> CameraCurves:
    """Reconstruct the curves of one camera; `entered`, `noise` and `asked` as for `CameraStream`."""
    stream = CameraStream(FrameStacks.of(frames), tables, limits, entered=entered, noise=noise, asked=asked)
    return stream.finish()[0]


@dataclass(frozen=True, slots=True)
class _Rows:
    """The rows of an image in which a filter looks for points: all, or bands with what its window needs beside them.

    index : (n,) of the image's rows, or a slice of all; inner : (n, 1) bool, those in which points are looked for.
    """

    index: IntArray | slice
    inner: NDArray[np.bool_] | Literal[True]

    def placed(self, points: LinePoints) -> LinePoints:
        """Points that were found in these rows alone, where they are in the image."""
        if isinstance(self.index, slice):
            return points
        row = np.rint(points.points_px[:, 1]).astype(np.intp)
        points.points_px[:, 1] += self.index[row] - row
        return points


_ALL_ROWS = _Rows(slice(None), inner=True)


def _phase_has_all(frames: AxisFrames) -> bool:
    """Whether the phase at each pixel gives every point: that of lines of half their period.

    Narrow lines light too little for that, and the filter contributes to each point.
    """
    patterns = frames.line_patterns
    return line_step_px(patterns) is not None and patterns[0].is_half_lit


def _sampled_rows(coded: Coded) -> _Rows:
    """Bands of rows in which each frame has enough points for `refinement.refined` to judge its light by."""
    frames = coded.frames
    points = int(np.count_nonzero(coded.searched)) // frames.line_patterns[0].period_px
    apart = _BAND_ROWS * min(points // _POINTS_TO_JUDGE, _MOST_APART)
    if apart <= _BAND_ROWS + 2 * _REACH_PX:
        return _ALL_ROWS
    row = np.arange(len(frames.white))
    away = np.abs((row - apart // 2) % apart - (_BAND_ROWS - 1) / 2)
    near = (away < _BAND_ROWS / 2 + _REACH_PX) | (away > apart - _BAND_ROWS / 2 - _REACH_PX)
    index = np.flatnonzero(near).astype(np.int32)
    return _Rows(index, (away[index] < _BAND_ROWS / 2)[:, None])


@dataclass(frozen=True, slots=True)
class _Scales:
    """Scale of the filter that points were found with, and the blur by the stripes' width, px.

    sampled : whether the filter looks for some of the points only, as of `refinement.refined`; rows : where it looks.
    """

    filter_px: float
    blur_px: float
    sampled: bool = False
    rows: _Rows = _ALL_ROWS


def _curves(
    coded: Coded,
    found: list[LinePoints],
    scales: _Scales,
    tables: CodeTables,
    limits: Limits,
    entered: Callable[[str], None],
    stacks: FrameStacks,
) -> CameraCurves:
    """What is left when all points are found: refine, number and link them.

    What takes memory goes as soon as it is not needed: `found` and the refined points are emptied, and `stacks`, whose
    frames these are.
    """
    frames = coded.frames
    entered("refine stripes")
    best = placed(coded, found, scales.blur_px, tables, limits, stacks.let_lines_go, sampled=scales.sampled)
    if scales.sampled and not best.refined:
        best.points[:] = [
            stripe_points(*line_image(coded, index), coded.searched, limits.stripes, sigma_px=scales.filter_px)
            for index in range(len(frames.lines))
        ]
    points, code, near_shadow, near_step = best.points, best.code, best.near_shadow, best.near_step
    entered("identify stripes")
    shortest = limits.stripes.shortest_points
    stripes = chained(points, code.refusal.shape)
    numbered, refusal = identify(stripes, code, tables.position_of, near_shadow, near_step, shortest_points=shortest)
    chained_points, lost = len(stripes.points_px), None
    del stripes
    if tables.edges_of is not None:
        per_cell = len(points) * frames.gray.cell_px / frames.line_patterns[0].period_px
        clear = ~(near_shadow | near_step) & (True if coded.asked is None else coded.asked)
        lost = lost_lines(numbered.stripes.points_px, coded.code, clear, per_cell)
    if lost is not None and tables.edges_of is not None:
        del numbered
        entered("locate stripes")
        coded, code = _with_fewer_bits(coded, code, lost, tables, limits)
        beside = limits.edges.for_filters(scales.blur_px)
        middles = position_map(frames, coded.position_noise, code, tables.cell_position, by_phase=False)
        shadow, step = near_edges(middles, coded.unlit, cell_width_px(coded), beside)
        near_shadow, near_step = np.where(lost, shadow, near_shadow), np.where(lost, step, near_step)
        del middles, shadow, step
        edges = _edges_within(coded, lost, limits.stripes, scales.filter_px)
        stacks.let_go()
        entered("identify stripes")
        points[:] = [_outside(points.pop(0), lost) for _ in range(len(points))] + edges
        del edges
        stripes = chained(points, code.refusal.shape)
        points.clear()
        chained_points = len(stripes.points_px)
        numbered, refusal = identify(
            stripes, code, np.vstack([tables.position_of, tables.edges_of]), near_shadow, near_step,
            shortest_points=shortest,
        )  # fmt: skip
        del stripes
    points.clear()
    stacks.let_go()
    decoded = coded.code.refusal == Refusal.NONE
    if coded.asked is not None:
        decoded &= coded.asked
        refusal[~coded.asked] = Refusal.OUTSIDE_REGION
    entered("link stripes")
    return CameraCurves(
        ensemble=link(numbered),
        refusal=refusal,
        noise=coded.noise,
        scale_px=scales.filter_px,
        decoded_pixels=int(decoded.sum()),
        stripe_points=chained_points,
        stripe_count=len(numbered.stripes),
        refined=best.refined,
        disagreement_px=best.disagreement_px,
        unresolved=coded.unresolved,
        lost_lines=lost,
        compression_dn=float(np.sqrt(coded.loss_variance)),
        shared_noise=coded.shared,
        gamma=coded.gamma,
    )


def _with_fewer_bits(
    coded: Coded, code: CodeMap, lost: NDArray[np.bool_], tables: CodeTables, limits: Limits
) -> tuple[Coded, CodeMap]:
    """The code without bits that do not resolve, where its edges stand for lines; and the code map with that."""
    frames, noise = coded.frames, coded.noise
    bits = unresolved_bits(frames, lit_pixels(frames, noise, limits.decoding))
    bits[~lost] = 0
    rows, cells = _rows_about(lost, 0), len(tables.cell_position)
    inside = lost[rows]
    fewer = decode(
        frames.rows(rows), noise.rows(rows), tables.index_of_word, cells, limits.decoding, unresolved=bits[rows]
    )

    # Elsewhere all bits are read, as before. Both maps name the same cells, and differ in the causes alone.
    lowest, highest = code.lowest.copy(), code.highest.copy()
    lowest[rows][inside], highest[rows][inside] = fewer.lowest[inside], fewer.highest[inside]

    def changed(before: CodeMap) -> CodeMap:
        refusal = before.refusal.copy()
        refusal[rows][inside] = fewer.refusal[inside]
        return CodeMap(lowest, highest, refusal)

    return replace(coded, code=changed(coded.code), unresolved=bits), changed(code)


def _edges_within(coded: Coded, lost: NDArray[np.bool_], limits: StripeLimits, scale_px: float) -> list[LinePoints]:
    """Points of code edges where lines are lost, looked for in the rows about it."""
    rows = _rows_about(lost, _REACH_PX)
    found = code_edge_points(coded.rows(rows), limits, scale_px, within=lost[rows])
    return [each._replace(points_px=each.points_px + np.array([0.0, rows.start])) for each in found]


def _rows_about(mask: NDArray[np.bool_], reach: int) -> slice:
    """From the first row in which the mask is set to the last, and so many more on either side."""
    inside = np.flatnonzero(mask.any(axis=1))
    return slice(max(int(inside[0]) - reach, 0), min(int(inside[-1]) + reach + 1, len(mask)))


def _outside(points: LinePoints, lost: NDArray[np.bool_]) -> LinePoints:
    """The points of one frame where lines are not lost."""
    columns, rows = np.rint(points.points_px).astype(np.intp).T
    kept = ~lost[rows, columns]
    return LinePoints(*(each[kept] for each in points))


def _matched_scale_px(stripe_sigma_px: float) -> float:
    """Scale of the Gaussian for stripes of this width, px.

    The stripe's own width is the best scale against noise (reconstruction at the physical limit). Stripes sharper than
    the pixels sample well are smoothed more: below a total of 1.4 px the sampling itself displaces the centre.
    """
    more = np.sqrt(max(_LEAST_SMOOTHED_PX**2 - stripe_sigma_px**2, 0.0))
    return float(np.clip(max(stripe_sigma_px, more), _FINEST_SCALE_PX, _COARSEST_SCALE_PX))

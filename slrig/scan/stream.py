"""The frames of a scan on their way into the reconstruction, camera by camera, whether they are read or being taken.

What can be done with a frame is done when it comes. The same code takes the frames of a recorded bundle, in the order
of its list, so a scan that was watched while it was captured and the same scan read from disk give the same bytes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slrig.capture import EvidenceSummary
from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    Calibration,
    CameraFormat,
    Capture,
    CaptureHeader,
    FloatArray,
    Gray,
    LineShift,
    Pattern,
    Pinhole,
    Pixels,
    Primary,
    Refusal,
    Region,
    Shot,
    Sine,
    Size,
    White,
    exposure_groups,
)
from slrig.patterns import (
    cell_positions,
    edge_positions,
    gray_bits,
    index_of_word,
    level_lines,
    line_positions,
    require_numbered,
)
from slrig.reconstruction import (
    NEAR_SATURATION,
    AxisFrames,
    AxisPatterns,
    AxisPositions,
    CameraCurves,
    CameraStream,
    CodeTables,
    DecodingLimits,
    ExposureUse,
    FrameStacks,
    FusedFrames,
    Image,
    PixelPairs,
    ReconstructionLimits,
    RegionMask,
    SheetCurves,
    axis_frames,
    axis_patterns,
    camera_curves,
    decode_second_axis,
    exposure_count,
    exposure_use,
    find_correspondences,
    find_cross_line_pairs,
    fuse_colour,
    fuse_exposures,
    has_phase,
    linearise,
    mean_image,
    optical_depths_mm,
    part_of_region,
    project,
    reference_repeats,
    select_points,
    used_frames,
    used_shots,
)
from slrig.scan.plan import chosen_axis
from slrig.scan.report import Stopwatch

Sample = TypeVar("Sample", bound=np.generic)


@dataclass(frozen=True, slots=True)
class FramePart:
    """The rectangle of a camera's frames that is reconstructed, and the region in it. whole : of the camera."""

    rows: slice
    columns: slice
    region: RegionMask
    whole: CameraFormat

    @property
    def form(self) -> CameraFormat:
        """Extent and depth of the part."""
        size = Size(self.columns.stop - self.columns.start, self.rows.stop - self.rows.start)
        return CameraFormat(size, self.whole.bit_depth)

    def of(self, shot: Shot) -> Shot:
        """The part of a frame."""
        colour = None if shot.colour is None else shot.colour[self.rows, self.columns]
        return replace(shot, image=shot.image[self.rows, self.columns], colour=colour)

    def placed(self, part: NDArray[Sample], beyond: object = 0) -> NDArray[Sample]:
        """An array of the part, (h, w, …), in one of the whole frame; elsewhere it is `beyond`."""
        whole = np.full((*self.whole.size.shape, *part.shape[2:]), beyond, dtype=part.dtype)
        whole[self.rows, self.columns] = part
        return whole

    def curves(self, found: CameraCurves) -> CameraCurves:
        """The same curves in the pixels of the whole frame."""
        origin = np.array([self.columns.start, self.rows.start], dtype=np.float64)
        unresolved, lost = found.unresolved, found.unresolved_lines
        return replace(
            found,
            ensemble=found.ensemble._replace(points_px=found.ensemble.points_px + origin),
            refusal=self.placed(found.refusal, Refusal.OUTSIDE_REGION),
            unresolved=None if unresolved is None else self.placed(unresolved),
            unresolved_lines=None if lost is None else self.placed(lost, beyond=False),
        )


def frame_part(
    region: Region, name: str, form: CameraFormat, device: Pinhole, projector: Pinhole | None, axis: Axis
) -> FramePart:
    """What of a camera's frames is looked at for a region.

    Raises
    ------
    ConfigError
        The region names another extent than the camera's, or nothing of it is in the camera's image.
    """
    part = part_of_region(region, name, form.size, device)
    lowest = highest = None
    if part.depths_mm is not None and projector is not None:
        near, far = (each.ravel() for each in part.depths_mm)
        ends = _light(near, far, part.rays(device), device, projector, axis)
        lowest, highest = (each.reshape(part.mask.shape) for each in ends)
    region_mask = RegionMask(part.mask, lowest, highest, region.min_contrast or 0.0)
    return FramePart(part.rows, part.columns, region_mask, form)


def limited(
    region: Region, curves: SheetCurves, refusal: NDArray[np.uint8], device: Pinhole
) -> tuple[SheetCurves, NDArray[np.uint8], NDArray[np.bool_]]:
    """The points of a camera that the region holds, its refusals, (H, W), with the others among them, and (n,) bool:
    which points it holds.
    """
    kept = within(region, curves.points_mm, curves.pixels_px, refusal, device)
    return select_points(curves, kept), marked(refusal, curves.pixels_px, kept), kept


def within(
    region: Region, points_mm: FloatArray, pixels_px: FloatArray, refusal: NDArray[np.uint8], device: Pinhole
) -> NDArray[np.bool_]:
    """(n,) bool: the points, (n, 3), that the region holds, seen by a camera at these pixels, (n, 2) of its image.

    refusal : (H, W) of that camera, with the pixels outside of the region.
    """
    columns, rows = np.rint(pixels_px).astype(np.intp).T
    kept = refusal[rows, columns] != Refusal.OUTSIDE_REGION
    if region.box_mm is not None:
        least, most = np.array(region.box_mm)
        kept &= ((points_mm >= least) & (points_mm <= most)).all(axis=1)
    if region.depth_mm is not None:
        depth = optical_depths_mm(device, points_mm)
        kept &= (depth >= region.depth_mm[0]) & (depth <= region.depth_mm[1])
    return np.asarray(kept)


def marked(refusal: NDArray[np.uint8], pixels_px: FloatArray, kept: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The refusals, with the pixels outside the region of which no point is kept."""
    if kept.all():
        return refusal
    columns, rows = np.rint(pixels_px).astype(np.intp).T
    out = refusal.copy()
    out[rows[~kept], columns[~kept]] = Refusal.OUTSIDE_REGION
    out[rows[kept], columns[kept]] = refusal[rows[kept], columns[kept]]
    return out


def _light(
    near: FloatArray, far: FloatArray, directions: FloatArray, device: Pinhole, projector: Pinhole, axis: Axis
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n,) float32 each: between which the light's position is on each ray from `near` to `far`."""
    ends = []
    for depth in (near, far):
        # Behind the projector, or without an end, the ray goes anywhere.
        known = np.where(np.isfinite(depth), depth, np.nan)[:, np.newaxis]
        ends.append(project(projector, device.centre_mm + known * directions)[:, 0 if axis is Axis.COLUMN else 1])
    unknown = ~np.isfinite(ends[0] + ends[1])
    lowest = np.where(unknown, -np.inf, np.minimum(*ends)).astype(np.float32)
    return lowest, np.where(unknown, np.inf, np.maximum(*ends)).astype(np.float32)


Entered = Callable[[str, str], None]
"""Told the name of a stage and of a camera as the one begins for the other."""


WAITING = "wait for frames"

_WHITE_OVER_USUAL = 2.5


@dataclass(frozen=True, slots=True)
class CameraResult:
    """One camera: its calibration, its curves, and of its frames what the results still need.

    white : (H, W) uint16, the white frame in camera units; full_scale : of them what to show as white; contrast :
    (H, W, C) float32, white minus black in proportion to light, as grey or as red, green and blue. A bracket's are
    those of the longest exposure, and go beyond the camera's full scale. clipped : (H, W) bool, where white is no
    measure of light. exposures : of a bracket, from short to long. second : what the other axis shows, None where it
    was not played.
    """

    name: str
    device: Pinhole
    curves: CameraCurves
    white: Pixels
    contrast: Image
    clipped: NDArray[np.bool_]
    full_scale: float
    exposures: tuple[ExposureUse, ...] = ()
    second: SecondAxisResult | None = None


@dataclass(frozen=True, slots=True)
class SecondAxisResult:
    """Light of the axis that is not triangulated by, at one camera.

    positions : (H, W), projector position along that axis; None where only one frame of lines was played of it. pairs :
    camera and projector pixels that both axes give; codes : Gray codes of the axes that have one. is_dense : True if
    positions are read between the edges of the code, too. residual_px : (H, W)
    float32, position minus its prediction by the calibration at each triangulated point, NaN elsewhere; None before
    triangulation and without positions.
    """

    positions: AxisPositions | None
    pairs: PixelPairs
    codes: tuple[Gray, ...]
    is_dense: bool = False
    residual_px: NDArray[np.float32] | None = None


class ScanStream:
    """Reconstructs the curves of every camera while frames come, along `axis` or the one that `chosen_axis` chooses.

    Frames that are not needed are let go. one_exposure : every camera takes all frames with one; otherwise all wait for
    the end. region : part of the scene; None for all. drop_finest_bits : as in
    `slrig.scan.plan.ReconstructionPlan`.

    Raises
    ------
    PatternError
        The frames announced cannot be decoded, or tell no depth.
    ConfigError
        The region names a camera that is not there, a mask of another extent, or nothing in a camera's image.
    """

    def __init__(
        self,
        header: CaptureHeader,
        calibration: Calibration,
        *,
        entered: Entered,
        axis: Axis | None = None,
        one_exposure: bool = True,
        region: Region | None = None,
        drop_finest_bits: int = 0,
    ) -> None:
        limits = ReconstructionLimits(decoding=DecodingLimits(drop_finest_bits=drop_finest_bits))
        self.header = header
        self.region = region
        devices = [calibration.cameras[name] for name in header.cameras]
        self.axis = axis or chosen_axis(header.axes, devices, calibration.projector)
        self.calibration = calibration
        if region is not None:
            region.require_fits({name: form.size for name, form in header.cameras.items()})
        self._cameras = {}
        for name, form in header.cameras.items():
            part = None
            if region is not None:
                device, projector = calibration.cameras[name], calibration.projector
                part = frame_part(region, name, form, device, projector, self.axis)
            self._cameras[name] = _CameraFrames(
                name, header, self.axis, entered, limits, part, one_exposure=one_exposure
            )

    def take(self, shot: Shot) -> None:
        """Take one frame."""
        self._cameras[shot.camera].take(shot)

    def finish(self) -> list[CameraResult]:
        """The curves of every camera, once all frames are in.

        Raises
        ------
        PatternError
            The frames cannot be decoded.
        """
        seen = []
        for name in list(self._cameras):
            # What it held of its frames is not needed any more, and the memory is.
            camera = self._cameras.pop(name)
            curves, frames, fused = camera.finish()
            part, used = camera.part, curves.refusal == Refusal.NONE
            second = camera.second_axis(curves, frames, self.calibration)
            white, black = (camera.colour(each, fused) for each in (White(), Black()))
            clipped = frames.white >= NEAR_SATURATION * frames.clipped_at
            if white is None or black is None:
                white, black = frames.white[..., None], frames.black[..., None]
            elif fused is None:
                clipped |= white.max(axis=2) >= NEAR_SATURATION * frames.full_scale
            # They are as the camera gave them.
            white, black = (linearise(each[..., ::-1], curves.gamma, frames.full_scale) for each in (white, black))
            contrast, shown = (
                white - black,
                np.clip(np.rint(frames.white), 0, np.iinfo(np.uint16).max).astype(np.uint16),
            )
            if part is not None:
                curves, contrast, clipped = part.curves(curves), part.placed(contrast), part.placed(clipped)
                # Outside the region, the white frame as it came.
                shown = part.placed(shown, beyond=camera.whole_white)
            seen.append(
                CameraResult(
                    name=name,
                    device=self.calibration.cameras[name],
                    curves=curves,
                    white=shown,
                    contrast=contrast,
                    clipped=clipped,
                    full_scale=frames.full_scale if fused is None else _shown_white(frames, used),
                    exposures=() if fused is None else exposure_use(fused, used),
                    second=second,
                )
            )
        return seen


class _CameraFrames:
    """One camera's share of a stream.

    Frames of a sequence that shows each pattern once are used as they come. Repeats and exposure brackets tell nothing
    before all of them are in, so they wait for `finish`.

    part : what of the frames is looked at; None for all. whole_white : (H, W), a white frame as it came.
    """

    def __init__(
        self,
        name: str,
        header: CaptureHeader,
        axis: Axis,
        entered: Entered,
        limits: ReconstructionLimits,
        part: FramePart | None = None,
        *,
        one_exposure: bool,
    ) -> None:
        self.part = part
        self.whole_white: Pixels | int = 0
        if part is not None:
            header = replace(header, cameras={**header.cameras, name: part.form})
        self._name = name
        self._limits = limits
        self._axis = axis
        self._header = header
        self._entered = lambda stage: entered(stage, name)
        self._kept: list[Shot] = []
        self._repeats: dict[Pattern, list[Pixels]] = {}
        self._colours: defaultdict[Pattern, list[tuple[float | None, Pixels]]] = defaultdict(list)
        self._lights: defaultdict[Pattern, list[Shot]] = defaultdict(list)
        listed = [index for index, camera in header.frames if camera == name]
        shown = [header.patterns[index] for index in listed]
        tells = used_frames(shown, [None] * len(shown))
        self._waiting = Counter(index for index, used in zip(listed, tells, strict=True) if used)
        used = [header.patterns[index] for index in self._waiting.elements()]
        self._wanted = Counter(used)
        self._stream: CameraStream | None = None
        self._second: FrameStacks | None = None
        self._cross_lines = _single_cross_lines(self._wanted, axis)
        self._cross_image: NDArray[Any] | None = None
        self._patterns = axis_patterns(self._wanted, name, axis)
        self._second_patterns: AxisPatterns | None = None
        with suppress(PatternError):  # the code of the other axis is not complete
            self._second_patterns = axis_patterns(self._wanted, name, axis.other)
        if one_exposure and all(self._wanted[each] == 1 for each in used if isinstance(each, Gray | LineShift | Sine)):
            form = header.cameras[name]
            stacks = FrameStacks(
                self._patterns,
                form.size.shape,
                full_scale=float(form.full_scale),
                reference_repeats=reference_repeats(used, axis),
            )
            tables = _tables(self._patterns, header.projector)
            self._stream = CameraStream(
                stacks, tables, self._limits, report_step=self._entered, region=self._region_mask
            )
            if self._second_patterns is not None:
                self._second = FrameStacks(self._second_patterns, form.size.shape, full_scale=float(form.full_scale))

    @property
    def _region_mask(self) -> RegionMask | None:
        return None if self.part is None else self.part.region

    @property
    def waits(self) -> bool:
        """Whether its frames wait for `finish`."""
        return self._stream is None

    def take(self, shot: Shot) -> None:
        """Take one frame of this camera."""
        if self.part is not None:
            if isinstance(self._header.patterns[shot.pattern], White):
                self.whole_white = shot.image
            shot = self.part.of(shot)
        if self._stream is None:
            self._kept.append(shot)
            return
        if self._waiting[shot.pattern] == 0:
            return
        self._waiting[shot.pattern] -= 1
        self._keep_colour(shot)
        pattern = self._header.patterns[shot.pattern]
        repeats = self._repeats.setdefault(pattern, [])
        repeats.append(shot.image)
        if len(repeats) == self._wanted[pattern]:
            image = mean_image(self._repeats.pop(pattern))
            if pattern == self._cross_lines:
                self._cross_image = image
            self._stream.take(pattern, image)
            if self._second is not None:
                self._second.put(pattern, image)

    def finish(self) -> tuple[CameraCurves, AxisFrames, FusedFrames | None]:
        """The curves, and the frames that they were found in; and how these were fused, if they are a bracket's."""
        if self._stream is not None:
            return *self._stream.finish(), None
        header, fused = self._header, None
        capture = Capture(header.projector, header.patterns, header.cameras, tuple(self._kept))
        for shot in used_shots(capture, self._name):
            self._keep_colour(shot)
        second = self._second_patterns
        if exposure_count([shot.exposure_s for shot in self._kept]) > 1:
            fused = fuse_exposures(capture, self._name, self._axis)
            frames, noise = fused.frames, fused.noise
            if second is not None:
                # The axes may have been taken with different exposures, of which no bracket can be made.
                with suppress(PatternError):
                    self._second = FrameStacks.from_frames(fuse_exposures(capture, self._name, second.gray.axis).frames)
        else:
            frames, noise = axis_frames(capture, self._name, self._axis), None
            if second is not None:
                self._second = FrameStacks.from_frames(axis_frames(capture, self._name, second.gray.axis))
        tables = _tables(self._patterns, self._header.projector)
        curves = camera_curves(
            frames, tables, self._limits, report_step=self._entered, noise=noise, region=self._region_mask
        )
        return curves, frames, fused

    def second_axis(
        self, curves: CameraCurves, frames: AxisFrames, calibration: Calibration
    ) -> SecondAxisResult | None:
        """Decode the other axis, if it was played. curves, frames : of the first, in the pixels of `part`."""
        if self._second is None or self._second.missing or self._second_patterns is None:
            return self._by_cross_lines(curves, frames, calibration)
        stacks, self._second = self._second, None
        if curves.gamma != 1:
            stacks.linearise(curves.gamma)
        frames = stacks.frames()
        tables = _tables(self._second_patterns, self._header.projector)
        second = decode_second_axis(frames, curves.noise, tables, ReconstructionLimits().decoding)
        pairs = find_correspondences(curves.ensemble, second, self._axis)
        positions = second.positions
        if self.part is not None:
            origin = np.array([self.part.columns.start, self.part.rows.start])
            pairs = replace(pairs, camera_px=pairs.camera_px + origin)
            positions = AxisPositions(*(self.part.placed(each, beyond=np.nan) for each in (
                positions.position_px, positions.sigma_px
            )))  # fmt: skip
        mine = self._patterns.gray
        codes = (mine, frames.gray) if self._axis is Axis.COLUMN else (frames.gray, mine)
        return SecondAxisResult(positions, pairs, codes, has_phase(second.frames))

    def _by_cross_lines(
        self, curves: CameraCurves, frames: AxisFrames, calibration: Calibration
    ) -> SecondAxisResult | None:
        """Correspondences by one frame of lines of the other axis, if it was played."""
        projector, difference = calibration.projector, self._cross_difference(curves.gamma, frames)
        if difference is None or self._cross_lines is None or projector is None:
            return None
        origin = (0, 0) if self.part is None else (self.part.columns.start, self.part.rows.start)
        pairs = find_cross_line_pairs(
            curves.ensemble, difference, self._cross_lines, calibration.cameras[self._name], projector, origin_px=origin
        )
        return SecondAxisResult(None, pairs, (frames.gray,))

    def _cross_difference(self, gamma: float, frames: AxisFrames) -> NDArray[np.float32] | None:
        """(H, W): light of the lines of the other axis less the middle of white and black, summed over exposures."""
        sets = [] if self._cross_image is None else [(self._cross_image, frames.white, frames.black)]
        clipped_at = NEAR_SATURATION * min(frames.full_scale, float(self._header.cameras[self._name].full_scale))
        for exposure_s in dict.fromkeys(shot.exposure_s for shot in self._kept):
            shots = [shot for shot in self._kept if shot.exposure_s == exposure_s]
            images = [
                [shot.image for shot in shots if self._header.patterns[shot.pattern] == wanted]
                for wanted in (self._cross_lines, White(), Black())
            ]
            if all(images):
                lit, white, black = map(mean_image, images)
                sets.append((lit, white, black))
        total: NDArray[np.float32] | None = None
        for each in sets:
            lit, white, black = (linearise(image, gamma, frames.full_scale) for image in each)
            difference = np.where(each[1] < clipped_at, lit - (white + black) / 2, 0)
            total = np.asarray(difference if total is None else total + difference, dtype=np.float32)
        return total

    def _keep_colour(self, shot: Shot) -> None:
        pattern = self._header.patterns[shot.pattern]
        if shot.colour is not None:
            self._colours[pattern].append((shot.exposure_s, shot.colour))
        elif isinstance(pattern, Black | Primary) and Primary("red") in self._wanted:
            self._lights[pattern].append(shot)

    def colour(self, pattern: White | Black, fused: FusedFrames | None) -> NDArray[Any] | None:
        """(H, W, 3): a pattern in colour, in the units of its grey image; None where not every exposure has colour."""
        found = self._colours.pop(pattern, []) or self._by_lights(pattern)
        if fused is None:
            return mean_image([image for _, image in found]) if found else None
        alike = exposure_groups(each for each, _ in found)
        groups = sorted({each or 0.0 for each in alike.values()}, reverse=True)
        if len(groups) < len(fused.exposures_s):
            return None
        images = [[image for each, image in found if alike[each] == time_s] for time_s in groups]
        return fuse_colour(images, fused, float(self._header.cameras[self._name].full_scale))

    def _by_lights(self, pattern: White | Black) -> list[tuple[float | None, Pixels]]:
        """Frames in colour, of grey ones: white is one in each of the projector's lights, black is dark in all."""
        lights: list[Pattern] = [Primary("blue"), Primary("green"), Primary("red")]
        of_each = [self._lights[light if isinstance(pattern, White) else pattern] for light in lights]
        return [
            (shots[0].exposure_s, np.stack([shot.image for shot in shots], axis=2))
            for shots in zip(*of_each, strict=False)
        ]


class LiveScan(ScanStream):
    """A stream that is fed while the scan is captured, with the seconds it took so far."""

    def __init__(self, header: CaptureHeader, calibration: Calibration, region: Region | None = None) -> None:
        self.evidence: EvidenceSummary | None = None
        self.watch = Stopwatch()
        self._frames: list[tuple[int, str]] = []
        self._exposures_s: defaultdict[str, set[float | None]] = defaultdict(set)
        self._told: Entered = lambda stage, _camera: self.watch.enter(stage)
        super().__init__(header, calibration, entered=lambda stage, camera: self._told(stage, camera), region=region)
        self.watch.enter(WAITING)

    def take(self, shot: Shot) -> None:
        """Take one frame."""
        self._frames.append((shot.pattern, shot.camera))
        self._exposures_s[shot.camera].add(shot.exposure_s)
        self._cameras[shot.camera].take(shot)
        self.watch.enter(WAITING)

    @property
    def taken(self) -> CaptureHeader:
        """The header of the frames that were taken."""
        return replace(self.header, frames=tuple(self._frames))

    @property
    def one_exposure(self) -> bool:
        """Whether every camera took all frames with one, or all frames waited for the end."""
        waits = all(each.waits for each in self._cameras.values())
        return waits or all(exposure_count(each) <= 1 for each in self._exposures_s.values())

    def end(self, evidence: EvidenceSummary) -> None:
        """Take note that all frames have come, and what they have proven."""
        self.evidence = evidence

    def finished(self, entered: Entered) -> list[CameraResult]:
        """As `finish`; `entered` is told the stages from here on."""
        self._told = entered
        return self.finish()


def _shown_white(frames: AxisFrames, used: NDArray[np.bool_]) -> float:
    """The value to show as white, of a bracket: what shines like a mirror is no measure of it."""
    usual = float(np.median(frames.white[used])) if used.any() else frames.full_scale
    return float(np.clip(_WHITE_OVER_USUAL * usual, 1, frames.clipped_at))


def step_px(shown: Collection[Pattern], axis: Axis) -> float:
    """Greatest distance between neighbouring curves: of lines where there are any, of code edges otherwise."""
    lines = sorted((p for p in shown if isinstance(p, LineShift) and p.axis is axis), key=lambda p: p.shift)
    if lines:
        shifts = [p.shift for p in lines]
        return float(np.diff([*shifts, shifts[0] + lines[0].period_px]).max())
    return 1.0 if _has_sinusoids(shown, axis) else cell_px(shown, axis)


def cell_px(shown: Collection[Pattern], axis: Axis) -> float:
    """Width of a cell of the code; of a position that sinusoids number themselves, 1."""
    return float(next((p.cell_px for p in shown if isinstance(p, Gray) and p.axis is axis), 1))


def _single_cross_lines(patterns: Collection[Pattern], axis: Axis) -> LineShift | None:
    """The one frame of half-lit lines of the other axis, None without it."""
    lines = [each for each in patterns if isinstance(each, LineShift) and each.axis is not axis]
    return lines[0] if len(lines) == 1 and lines[0].is_half_lit else None


def _has_sinusoids(shown: Collection[Pattern], axis: Axis) -> bool:
    return any(isinstance(p, Sine) and p.axis is axis for p in shown)


def _tables(patterns: AxisPatterns, size: Size) -> CodeTables:
    """Tables of the positions of an axis. Raises PatternError: sinusoids do not tell their periods apart."""
    gray, lines = patterns.gray, patterns.lines
    if patterns.sines:
        if not patterns.has_code:
            require_numbered(patterns.sines, size)
        positions = Gray(gray.axis, 0, gray_bits(size.along(gray.axis), 1, 0))
        return CodeTables(
            index_of_word=index_of_word(gray),
            cell_position=cell_positions(positions, size),
            position_table=line_positions(level_lines(patterns.sines), positions, size),
            edge_table=edge_positions(gray, size) if patterns.has_code else np.zeros((0, 0)),
        )
    return CodeTables(
        index_of_word=index_of_word(gray),
        cell_position=cell_positions(gray, size),
        position_table=line_positions(lines, gray, size) if lines else edge_positions(gray, size),
        edge_table=edge_positions(gray, size) if lines else None,
    )

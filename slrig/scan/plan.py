"""The plan of a scan: frozen values from a request, a preset and a rig file; the patterns that it means on a rig; and
whether the devices can do it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta
from enum import StrEnum
from math import asin, degrees
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from slrig.bundle import (
    MAX_CAPTURE_BYTES,
    PRESET_NAME,
    Preset,
    PresetDocument,
    TurnedBy,
    json_bytes,
    read_json_model,
    write_file,
)
from slrig.disk import storage_errors
from slrig.errors import ConfigError, PatternError, PresetNotFoundError, UnsupportedByDeviceError, setting
from slrig.model import (
    MIN_BASELINE_FRACTION,
    Axis,
    Black,
    Calibration,
    FlipRule,
    MeshAxes,
    Pattern,
    PatternSequence,
    Pinhole,
    Region,
    SequenceName,
    Sine,
    Size,
    White,
    baseline_fraction,
    bracket_fault,
    depth_sensitive_cameras,
    triangulated_axis,
)
from slrig.patterns import SEQUENCES, SequenceOptions, encode, phase_patterns, scan_patterns, with_cross_lines

if TYPE_CHECKING:
    # For annotations alone: a reconstruction of recorded frames has no rig.
    from slrig.devices import CameraInfo, ProjectorInfo, Rig
    from slrig.rig.session import RigFacts

_OF_LINES = (
    "line_shift", "line_shift_period_px", "line_steps", "line_width_px", "gray_cell_px", "gray_offset_px", "inverses",
)  # fmt: skip
_OF_SINES = ("sine_period_px", "sine_steps")

MOST_TURN_DEG = 3600.0
"""Ten turns either way: more is a slip, and winds up the cables of what stands on a turntable."""


@dataclass(frozen=True, slots=True)
class PatternPlan:
    """Which patterns to play: see `slrig.patterns.sequence.scan_patterns`.

    sequence : what stands where the other options say nothing; see `SEQUENCES` there. line_shift : False gives a
    Gray-only scan. line_shift_period_px : n. line_steps : the number of line frames; None stands for that of the
    sequence, or the next number that divides n. line_width_px : of a line.
    gray_cell_px : None stands for ⌊n/2⌋, so that a code edge may be off by n/4 px, or without lines for 2.
    sine_period_px : of the shortest sinusoid of the sequence `phase`; sine_steps : shifts of each.
    inverses : each bit is followed by its inverse; None stands for True unless lines of half their period prove bits.
    rows : True plays columns and rows, False columns alone, and None what the calibration asks for: columns for
    devices side by side, rows for devices above one another; see `slrig.scan.plan.played_axes`. cross_lines :
    where one axis is played, one frame of lines along the other, which tests the calibration. codes : False
    plays white and black alone: enough for poses that calibrate cameras without the projector, and for no scan.
    """

    sequence: SequenceName = SequenceName.STANDARD
    line_shift: bool = True
    line_shift_period_px: int | None = None
    line_steps: int | None = None
    line_width_px: int | None = None
    gray_cell_px: int | None = None
    gray_offset_px: int = 0
    inverses: bool | None = None
    rows: bool | None = None
    cross_lines: bool = False
    codes: bool = True
    sine_period_px: int | None = None
    sine_steps: int | None = None

    def __post_init__(self) -> None:
        # Requests and stored plans bring plain text.
        object.__setattr__(self, "sequence", SequenceName(self.sequence))
        given = [name for name in unused_options(self.sequence) if getattr(self, name) != _DEFAULTS[name]]
        if given:
            words = (
                f"sinusoids alone: leave it out, use {setting('sine_period_px')} and {setting('sine_steps')}, or ask "
                f"for another {setting('sequence')}"
                if SEQUENCES[self.sequence].sines
                else f"lines and code: leave it out, or ask for {setting('sequence')} {SequenceName.PHASE}"
            )
            message = f"{' and '.join(given)}: the sequence {self.sequence} plays {words}"
            raise ConfigError(message)

    @property
    def named(self) -> SequenceOptions:
        """The sequence with what this plan says otherwise."""
        usual = SEQUENCES[self.sequence]
        if usual.sines:
            return replace(
                usual, period_px=self.sine_period_px or usual.period_px, steps=self.sine_steps or usual.steps
            )
        period_px, width_px = self.line_shift_period_px or usual.period_px, self.line_width_px or usual.line_width_px
        proven = self.line_shift and (2 * width_px == period_px if width_px else period_px % 2 == 0)
        inverses = usual.inverses or not proven if self.inverses is None else self.inverses
        steps = self.line_steps or usual.steps
        if not self.line_steps and steps:
            # Of a period of its own the fewest steps that divide it.
            steps = next((each for each in range(steps, period_px) if period_px % each == 0), period_px)
        return SequenceOptions(
            period_px=period_px,
            steps=steps,
            line_width_px=width_px,
            inverses=inverses,
            closing=max(usual.closing, 2 if inverses else 0),
        )


_DEFAULTS = {each.name: each.default for each in fields(PatternPlan)}


def unused_options(sequence: SequenceName) -> tuple[str, ...]:
    """Names of the options of `PatternPlan` that mean nothing in a sequence: those of lines, or those of sinusoids."""
    return _OF_LINES if SEQUENCES[sequence].sines else _OF_SINES


@dataclass(frozen=True, slots=True)
class RigGuess:
    """What is known of the devices of a rig that is not calibrated.

    focal_px : focal length of cameras by name, px; None stands for all cameras that are not named. The others are
    assumed to see 1.4 times as far as wide. focal_sigma : relative standard deviation of the lengths that are given.
    throw_ratio : distance over width of the projector's picture; throw_sigma : its relative standard deviation.
    baseline_mm : distance of the first camera from the projector; without it lengths are in hundredths of that
    distance. baseline_sigma : its relative standard deviation. most_error : stated error of shape over the size of the
    scene beyond which the scan is refused.

    Raises ConfigError: a value is not positive and finite.
    """

    focal_px: Mapping[str, float] = field(default_factory=dict)
    focal_sigma: float = 0.1
    throw_ratio: float | None = None
    throw_sigma: float = 0.1
    baseline_mm: float | None = None
    baseline_sigma: float = 0.01
    most_error: float = 0.0015

    def __post_init__(self) -> None:
        numbers: dict[str, float | None] = {f"focal_px of '{name}'": each for name, each in self.focal_px.items()}
        numbers |= {each.name: getattr(self, each.name) for each in fields(self) if each.name != "focal_px"}
        for name, value in numbers.items():
            if value is not None and not 0 < value < math.inf:
                message = f"uncalibrated: expected a positive number as {name}, found {value:g}; correct it"
                raise ConfigError(message)


def length_unit(guess: RigGuess | None) -> str:
    """Unit of lengths of a scan. guess : of a rig without a calibration."""
    return "mm" if guess is None or guess.baseline_mm is not None else "% of baseline"


@dataclass(frozen=True, slots=True)
class ReconstructionPlan:
    """How frames become a mesh.

    keep_holes : drop triangles that use a bridge between two stripes of one code.
    depth_edge_ratio : a triangle edge longer than this many times the local sampling distance crosses a depth edge.
    max_code_gap : neighbouring curves whose columns differ by at most this many column steps are meshed together.
    flip_rule : when an edge is exchanged for the other diagonal of its two triangles; `FlipRule` or its value.
    smooth_boundary : shrink and smooth the boundary of the mesh (paper, section 3.4).
    axis : of the light to triangulate by, `Axis` or its value; None the one that crosses the baseline more steeply.
    region : what of the scene is measured; None for all that the devices see.
    drop_finest_bits : number of finest bits of the code not to read where its edges give the points, beside those that
    the camera does not resolve.
    mesh_axes : of mesh.ply, points.ply, STL, OBJ and 3MF, `MeshAxes` or its value. All other files and figures are in
    the axes of the calibration; GLB has axes of its own.
    uncalibrated : calibrate the rig by the scan itself, from these guesses; None uses the rig's calibration.
    rig_in_base : (4, 4), mm, the rig in a robot's base by
    hand-eye calibration, None where it is not known.

    Raises
    ------
    ConfigError
        depth_edge_ratio is not above 1 and finite, max_code_gap is below 1, flip_rule is none of `FlipRule`, axis none
        of `Axis`, mesh_axes none of `MeshAxes`, or robot without rig_in_base, or drop_finest_bits below 0.
    """

    keep_holes: bool = False
    depth_edge_ratio: float = 6.0
    max_code_gap: int = 1
    flip_rule: FlipRule = FlipRule.CONSTRAINED
    smooth_boundary: bool = True
    axis: Axis | None = None
    region: Region | None = None
    drop_finest_bits: int = 0
    mesh_axes: MeshAxes = MeshAxes.UPRIGHT
    uncalibrated: RigGuess | None = None
    rig_in_base: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if not 1 < self.depth_edge_ratio < math.inf:
            message = (
                f"depth_edge_ratio: expected a finite number above 1, found {self.depth_edge_ratio:g}; at 1 or below "
                "every triangle would cross a depth edge; 6 is usual"
            )
            raise ConfigError(message)
        if self.max_code_gap < 1:
            message = (
                f"max_code_gap: expected 1 or more, found {self.max_code_gap}; 1 meshes each curve with the next one"
            )
            raise ConfigError(message)
        if self.drop_finest_bits < 0:
            message = (
                f"drop_finest_bits: expected 0 or more, found {self.drop_finest_bits}; 0 reads every bit that the "
                "camera resolves"
            )
            raise ConfigError(message)
        try:
            # Requests and stored plans bring plain text.
            object.__setattr__(self, "flip_rule", FlipRule(self.flip_rule))
        except ValueError as cause:
            message = f"flip_rule: expected {' or '.join(FlipRule)}, found {self.flip_rule!r}; constrained is usual"
            raise ConfigError(message) from cause
        try:
            object.__setattr__(self, "mesh_axes", MeshAxes(self.mesh_axes))
        except ValueError as cause:
            message = f"mesh_axes: expected {' or '.join(MeshAxes)}, found {self.mesh_axes!r}; upright is usual"
            raise ConfigError(message) from cause
        if self.mesh_axes is MeshAxes.ROBOT and self.rig_in_base is None:
            message = (
                "mesh_axes: robot needs to know where the rig is in the robot's base; calibrate that (slrig calibrate "
                "hand-eye), and ask for it scan by scan: neither rig files, presets, schedules nor models can"
            )
            raise ConfigError(message)
        if self.rig_in_base is not None:
            object.__setattr__(self, "rig_in_base", tuple(map(tuple, self.rig_in_base)))
        try:
            object.__setattr__(self, "axis", None if self.axis is None else Axis(self.axis))
        except ValueError as cause:
            message = f"axis: expected {' or '.join(Axis)}, found {self.axis!r}; left out, the calibration decides"
            raise ConfigError(message) from cause


@dataclass(frozen=True, slots=True)
class SeriesPlace:
    """A scan's place in a series. id : names the series; number : 1 for the first of `count`; due_at : with a time
    zone, before which it does not begin.
    """

    id: UUID
    number: int
    count: int
    due_at: datetime


@dataclass(frozen=True, slots=True)
class PresetUse:
    """The preset that a scan was asked for by: its name, the version of its format, and a digest of its options."""

    name: str
    version: int
    digest: str

    def __str__(self) -> str:
        return f"preset '{self.name}' (version {self.version}, {self.digest})"


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """One scan: patterns, exposure, reconstruction. `exposure_s` None keeps what the rig file says per camera.

    exposures_s : a bracket, for an object that is dark here and shines there: the sequence is played once for each
    of these exposure times, and the frames are fused. They are times and not multiples of what each camera has,
    like `exposure_s`: so every one can be a whole number of a projector's refreshes (of 1/60 s, say), and is
    checked against what the cameras can do before anything moves. Two to six, at least a tenth apart, in any order.
    exposure_factors : one or a bracket, in place of both, times the exposures that the cameras have by themselves;
    see `slrig.scan.acquisition.exposed`. preset : where some of this came from, None where no preset was named.
    colour : keep white and black frames in colour, None where a camera has it. coloured_light : play white in red,
    green and blue as well, for the cameras that have no colour. series : None for a scan alone. turn_deg : the angle
    of the turntable that the object is shot at, right-handed about its axis; None without one. turned_by : the
    table turns to it before the first frame; a hand has turned already, and nothing moves.

    Raises
    ------
    ConfigError
        exposure_s is not above 0 and finite, exposures_s is no bracket, or more than one of the three is given. Or
        turn_deg is no angle of at most MOST_TURN_DEG.
    """

    patterns: PatternPlan = field(default_factory=PatternPlan)
    reconstruction: ReconstructionPlan = field(default_factory=ReconstructionPlan)
    exposure_s: float | None = None
    exposures_s: tuple[float, ...] | None = None
    exposure_factors: tuple[float, ...] | None = None
    colour: bool | None = None
    coloured_light: bool = False
    series: SeriesPlace | None = None
    preset: PresetUse | None = None
    turn_deg: float | None = None
    turned_by: TurnedBy = "table"

    def __post_init__(self) -> None:
        # NaN is within no limits.
        if self.turn_deg is not None and not abs(self.turn_deg) <= MOST_TURN_DEG:
            message = (
                f"{setting('turn_deg')}: expected an angle from {-MOST_TURN_DEG:g}° to {MOST_TURN_DEG:g}°, found "
                f"{self.turn_deg:g}°; the next view of eight is at 45"
            )
            raise ConfigError(message)
        if self.turn_deg is None and self.turned_by == "hand":
            message = f"{setting('turn_deg')}: expected the angle that a hand has turned to, found none; say it"
            raise ConfigError(message)
        if self.exposure_s is not None and not 0 < self.exposure_s < math.inf:
            message = f"exposure_s: expected a finite time above 0 s, found {self.exposure_s:g} s; 0.0167 is usual"
            raise ConfigError(message)
        if self.exposure_factors is not None and (self.exposure_s or self.exposures_s):
            message = "expected exposure_factors alone, found exposure times beside them; keep one of them"
            raise ConfigError(message)
        if self.reconstruction.uncalibrated is not None:
            if self.patterns.rows is False:
                message = (
                    f"{setting('rows')}: expected columns and rows for a rig without a calibration, found columns "
                    "alone; leave it out"
                )
                raise ConfigError(message)
            object.__setattr__(self, "patterns", replace(self.patterns, rows=True))
        if self.exposures_s is None:
            return
        if self.exposure_s is not None:
            message = "expected exposure_s or exposures_s, found both; keep exposures_s for a bracket"
            raise ConfigError(message)
        fault = bracket_fault(self.exposures_s)
        if fault is not None:
            message = f"exposures_s: {fault}"
            raise ConfigError(message)

    @property
    def exposure_count(self) -> int:
        """How often the sequence is played."""
        return len(self.exposures_s or self.exposure_factors or (None,))

    @property
    def rising_exposures_s(self) -> tuple[float, ...]:
        """The exposure times asked for, from short to long; none where the rig file's are kept."""
        if self.exposures_s is not None:
            return tuple(sorted(self.exposures_s))
        return () if self.exposure_s is None else (self.exposure_s,)


def series_of(plan: ScanPlan, series: UUID, *, count: int, every_s: float, begins_at: datetime) -> tuple[ScanPlan, ...]:
    """The plans of a series: one scan every `every_s`, or as fast as the rig can where it needs longer.

    >>> from datetime import UTC
    >>> begins_at = datetime(2026, 11, 25, tzinfo=UTC)
    >>> _, second = series_of(ScanPlan(), UUID(int=7), count=2, every_s=90, begins_at=begins_at)
    >>> second.series.number, str(second.series.due_at)
    (2, '2026-11-25 00:01:30+00:00')
    """
    return tuple(
        replace(plan, series=SeriesPlace(series, 1 + index, count, begins_at + timedelta(seconds=index * every_s)))
        for index in range(count)
    )


_NEXT_TO_NONE = 0.01
FAIR_SHARE = 0.5
"""By this share of it (30°), errors are twice as large as they need be."""

_BOTH = f"Scan with both axes: {setting('rows')}"


def played_axes(
    rows: bool | None, calibration: Calibration | None, names: Iterable[str], *, axis: Axis | None = None
) -> tuple[Axis, ...]:
    """The axes that a scan with the cameras `names` plays.

    rows : True plays both, False columns alone; None the one that the calibration asks for, and columns without one.
    axis : the one to triangulate by, if that was asked for.

    Raises
    ------
    PatternError
        The axis asked for tells no depth by the calibration, or columns alone are to be played and rows to be used.
    """
    if rows:
        return tuple(Axis)
    if axis is Axis.ROW and rows is False:
        message = (
            f"{setting('rows')} as false plays columns alone, and {setting('axis')} as row triangulates by rows; leave "
            "one of them out"
        )
        raise PatternError(message)
    cameras = _known(calibration, names)
    wanted = Axis.COLUMN if rows is False else axis
    if calibration is None or not cameras:
        return (wanted or Axis.COLUMN,)
    if wanted is None:
        return (triangulated_axis(cameras, calibration.projector),)
    return (chosen_axis((wanted,), cameras, calibration.projector),)


def chosen_axis(shown: Collection[Axis], cameras: Sequence[Pinhole], projector: Pinhole | None) -> Axis:
    """The axis to triangulate by, of those that were shown.

    Raises
    ------
    PatternError
        The only one shown tells no depth. Without a projector the stripes have to be seen before that can be said.
    """
    if len(shown) != 1:
        return triangulated_axis(cameras, projector)
    (axis,) = shown
    if projector is not None and baseline_fraction(axis, cameras, projector) < MIN_BASELINE_FRACTION:
        where = "above or below" if axis is Axis.COLUMN else "beside"
        message = (
            f"expected patterns across the baseline, found those of {axis}s alone: the camera stands {where} the "
            f"projector, and light of one {axis} is seen edge on there and tells no depth. {_BOTH}"
        )
        raise PatternError(message)
    return axis


def weakness(axis: Axis, shown: Collection[Axis], share: float, *, on_request: bool = False) -> str | None:
    """What to say of a scan whose stripes cross the baseline by so small a share; None where that is well.

    on_request : True if this axis was requested. Then the other one, if it was shown, is the cure.
    """
    if share >= FAIR_SHARE:
        return None
    if len(shown) == 1:
        cure = _BOTH
    elif on_request:
        cure = f"The {axis.other}s were played, too, and cross it more steeply: leave out {setting('axis')}"
    else:
        cure = "Both axes were played: turn the projector about its view by 45°"
    times = f"{1 / share:.1f}" if share > _NEXT_TO_NONE else f"more than {1 / _NEXT_TO_NONE:.0f}"
    return (
        f"the light of the {axis}s crosses the baseline at {degrees(asin(share)):.0f}° only, and depth is {times} "
        f"times as uncertain as it would be across it. {cure}"
    )


def left_out_notes(axis: Axis, cameras: Mapping[str, Pinhole], projector: Pinhole | None) -> list[str]:
    """One sentence for each camera that the axis tells no depth, where it tells others."""
    if projector is None:
        return []
    told = depth_sensitive_cameras(axis, list(cameras.values()), projector)
    return [
        f"camera '{name}' is left out: its baseline to the projector lies along the {axis}s of light, which tell it no "
        "depth; the other cameras measure by them"
        for name, tells in zip(cameras, told, strict=True)
        if not tells
    ]


def _known(calibration: Calibration | None, names: Iterable[str]) -> list[Pinhole]:
    return [] if calibration is None else [calibration.cameras[n] for n in names if n in calibration.cameras]


def pattern_sequence(
    plan: PatternPlan,
    size: Size,
    calibration: Calibration | None = None,
    cameras: Iterable[str] = (),
    *,
    axis: Axis | None = None,
    recorded: tuple[Pattern, ...] = (),
    coloured_light: bool = False,
) -> PatternSequence:
    """The patterns that a plan means on a projector of this size, with these cameras. Raises PatternError.

    axis : the one to triangulate by, if that was asked for. recorded : of `ProjectorInfo`; they are played unless the
    plan asks for patterns of its own. coloured_light : of `ScanPlan`.
    """
    if recorded and plan == PatternPlan():
        return encode(recorded, size)
    axes = played_axes(plan.rows, calibration, cameras, axis=axis)
    named = plan.named
    rows, columns = (plan.codes and axis in axes for axis in (Axis.ROW, Axis.COLUMN))
    if named.sines:
        patterns = phase_patterns(
            size, period_px=named.period_px, steps=named.steps, rows=rows, columns=columns,
            coloured_light=coloured_light,
        )  # fmt: skip
    else:
        patterns = scan_patterns(
            size,
            line_shift=plan.line_shift,
            period_px=named.period_px,
            steps=named.steps,
            inverses=named.inverses,
            closing=named.closing,
            line_width_px=named.line_width_px,
            gray_cell_px=plan.gray_cell_px,
            gray_offset_px=plan.gray_offset_px,
            rows=rows,
            columns=columns,
            coloured_light=coloured_light,
        )
    if plan.cross_lines and rows != columns:
        patterns = with_cross_lines(patterns, Axis.COLUMN if rows else Axis.ROW)
    return encode(patterns, size)


def rig_sequence(plan: ScanPlan, rig: Rig) -> PatternSequence:
    """The patterns of a scan on an open rig. Raises PatternError."""
    projector = rig.projector.info
    return pattern_sequence(
        plan.patterns, projector.size, rig.calibration, rig.cameras, axis=plan.reconstruction.axis,
        recorded=projector.recorded, coloured_light=plan.coloured_light,
    )  # fmt: skip


def in_colour(plan: ScanPlan, cameras: Mapping[str, CameraInfo], projector: ProjectorInfo) -> frozenset[str]:
    """The cameras whose white and black frames a plan keeps in colour.
    Raises UnsupportedByDeviceError: it asks for colour, and a camera has none; or for coloured light, and the projector
    has none, or no camera needs it.
    """
    mono = [name for name, camera in cameras.items() if not camera.colour]
    if plan.colour and mono:
        message = (
            f"{setting('colour')}: asked for, and camera '{mono[0]}' has none in the format that it is read in. Leave "
            "it out, and the cameras that have colour give it."
        )
        raise UnsupportedByDeviceError(message)
    kept = frozenset(cameras if plan.colour is not False else ()).difference(mono)
    if plan.coloured_light and not projector.lights:
        message = (
            f"{setting('coloured_light')}: asked for, and the projector '{projector.model}' has no lights of its own "
            "for red, green and blue that its driver could switch. Leave it out; a camera that has colour gives it."
        )
        raise UnsupportedByDeviceError(message)
    if plan.coloured_light and len(kept) == len(cameras):
        message = f"{setting('coloured_light')}: asked for, and every camera has colour already. Leave it out."
        raise UnsupportedByDeviceError(message)
    return kept


def no_turntable(turn_deg: float) -> UnsupportedByDeviceError:
    """The error that a rig cannot turn what stands before it."""
    message = (
        f"{setting('turn_deg')}: the object is to stand at {turn_deg:g}°, and this rig has no turntable. Turn it by "
        f"hand, and say so with {setting('turned_by')}; or name a turntable in the rig file"
    )
    return UnsupportedByDeviceError(message)


def check_plan(plan: ScanPlan, facts: RigFacts, calibration: Calibration | None = None) -> int:
    """Return the bytes that the frames of a scan take on this rig, uncompressed. calibration : that it is to use.

    Raises
    ------
    PatternError
        The patterns do not fit the projector, or by the calibration they tell no depth.
    ConfigError
        The region names a camera that is not there, or a mask of another extent.
    UnsupportedByDeviceError
        A camera cannot expose that long, or that briefly, or has no colour, or the frames are more than a bundle holds.
        Or there is no turntable to turn, or the projector shows no shades of grey.
    """
    if plan.turn_deg is not None and plan.turned_by == "table" and not facts.turntable:
        raise no_turntable(plan.turn_deg)
    exposures_s = plan.rising_exposures_s
    if plan.reconstruction.region is not None:
        plan.reconstruction.region.require_fits({name: each.format.size for name, each in facts.cameras.items()})
    axis = plan.reconstruction.axis
    projector = facts.projector
    sequence = pattern_sequence(
        plan.patterns, projector.size, calibration, facts.cameras, axis=axis, recorded=projector.recorded,
        coloured_light=plan.coloured_light,
    )  # fmt: skip
    if not projector.shades and any(isinstance(each, Sine) for each in sequence.patterns):
        message = (
            f"{setting('sequence')}: {plan.patterns.sequence} plays sinusoids, and the projector '{projector.model}' "
            "shows black and white alone. Ask for standard or fast, or connect its video input and drive it as a "
            "display (driver screen or kms in the rig file), which shows shades of grey"
        )
        raise UnsupportedByDeviceError(message)
    count, coloured = len(sequence) * plan.exposure_count, in_colour(plan, facts.cameras, projector)
    ends = sum(isinstance(each, White | Black) for each in sequence.patterns) * plan.exposure_count
    key = "exposure_s" if plan.exposures_s is None else "exposures_s"
    total = 0
    for name, camera in facts.cameras.items():
        least_s, most_s = camera.exposure_range_s
        for asked_s in exposures_s:
            if not least_s <= asked_s <= most_s:
                message = (
                    f"{key}: {asked_s:g} s was asked for, camera '{name}' can do {least_s:g} s to {most_s:g} s. "
                    "Ask for a value in that range."
                )
                raise UnsupportedByDeviceError(message)
        size = camera.format.size
        images = count + (3 * ends if name in coloured else 0)
        total += images * size.width_px * size.height_px * (1 if camera.format.bit_depth <= 8 else 2)
    if total > MAX_CAPTURE_BYTES:
        message = (
            f"The frames of this scan would take {total / 1e9:.1f} GB, a bundle holds {MAX_CAPTURE_BYTES / 1e9:.1f} "
            "GB at most. Ask for fewer exposures or fewer patterns."
        )
        raise UnsupportedByDeviceError(message)
    return total


MOST_PRESET_BYTES = 2**20

SHIPPED: Mapping[str, Preset] = {
    "matt": Preset(description="matt and light: plaster, paint, 3-D prints", exposure_factors=(1.0,)),
    "dark": Preset(description="dark, with lighter parts: rubber, black plastic", exposure_factors=(1.0, 8.0)),
    "shiny": Preset(description="glossy: machined metal, varnish", exposure_factors=(0.25, 2.0)),
    "mixed": Preset(description="dark here and shining there", exposure_factors=(0.0625, 0.5, 4.0)),
    "fast": Preset(
        description="least time, for matt and light objects", exposure_factors=(0.5,), sequence=SequenceName.FAST
    ),
    "precise": Preset(
        description="least noise, for objects that stand still",
        exposure_factors=(0.0625, 0.25, 1.0, 4.0),
    ),
}
"""Factors, because seconds mean nothing on another rig: they are of the exposure at which a light matt object comes
near full scale, as a rig's own is set. Chosen by `tests/bench/preset_sweep.py`; README.md has what they measured.
"""


class PresetSource(StrEnum):
    """Where a preset comes from."""

    SHIPPED = "shipped"
    RIG = "rig"
    KEPT = "kept"


_WORDS = {PresetSource.SHIPPED: "slrig itself", PresetSource.RIG: "the rig file"}


@dataclass(frozen=True, slots=True)
class NamedPreset:
    """A preset by its name. digest : of its options; see `PresetDocument`. fault : what is wrong with its file; there
    are no options then.
    """

    name: str
    source: PresetSource
    description: str | None = None
    digest: str | None = None
    fault: str | None = None


class Presets:
    """The presets of a service. Any thread may call.

    folder : where those are kept that were put, one file each; made when there is need. of_rig : those of the rig file.
    """

    def __init__(self, folder: Path, of_rig: Mapping[str, Preset]) -> None:
        self._folder = folder
        self._given = {
            **{name: (PresetSource.SHIPPED, preset) for name, preset in SHIPPED.items()},
            **{name: (PresetSource.RIG, preset) for name, preset in of_rig.items()},
        }

    def listed(self) -> list[NamedPreset]:
        """All that there are, by name."""
        kept = self._kept()
        found = []
        for name in sorted(kept | set(self._given)):
            source = PresetSource.KEPT if name in kept else self._given[name][0]
            try:
                document = self.get(name)
            except PresetNotFoundError:
                # It was deleted meanwhile.
                continue
            except ConfigError as error:
                found.append(NamedPreset(name, source, fault=str(error)))
            else:
                found.append(NamedPreset(name, source, document.scan.description, document.digest))
        return found

    def get(self, name: str) -> PresetDocument:
        """The preset of a name.

        Raises
        ------
        PresetNotFoundError
            There is none.
        ConfigError
            Its file was changed and is none any more, or is of another version.
        """
        path = self._path(name)
        if path.is_file():
            return read_json_model(path, PresetDocument, "preset", max_bytes=MOST_PRESET_BYTES, error=ConfigError)
        if name not in self._given:
            names = ", ".join(sorted(self._kept() | set(self._given)))
            message = f"There is no preset '{name}' here. There are: {names}."
            raise PresetNotFoundError(message)
        return PresetDocument(scan=self._given[name][1])

    def put(self, name: str, document: PresetDocument) -> None:
        """Keep a preset, in place of what has its name. Raises StorageError."""
        with storage_errors(self._folder):
            self._folder.mkdir(mode=0o750, exist_ok=True)
        write_file(self._path(name), json_bytes(document.model_dump(mode="json", exclude_none=True)))

    def delete(self, name: str) -> None:
        """Remove a preset that was put; one of the rig file or a shipped one of its name is then seen again.

        Raises
        ------
        PresetNotFoundError
            None was put by that name.
        StorageError
            The disk refused.
        """
        path = self._path(name)
        if not path.is_file():
            self.get(name)
            message = (
                f"Preset '{name}' is not kept here, but comes from {_WORDS[self._given[name][0]]}, and cannot be "
                "deleted. One that is PUT by its name takes its place."
            )
            raise PresetNotFoundError(message)
        with storage_errors(path):
            path.unlink(missing_ok=True)

    def _kept(self) -> set[str]:
        """The names of those that were put; a file of another name was put there by hand, and nobody can ask for it."""
        return {path.stem for path in self._folder.glob("*.json") if re.fullmatch(PRESET_NAME, path.stem)}

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

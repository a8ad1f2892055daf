"""What a scan is asked to do: frozen data, made once from a request and a rig file; and who is told how far it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta
from typing import Protocol
from uuid import UUID

from slrig.bundle import TurnedBy
from slrig.errors import ConfigError, setting
from slrig.model import Axis, FlipRule, Region, SequenceName, bracket_fault
from slrig.patterns import SEQUENCES, SequenceOptions

_OF_LINES = (
    "line_shift", "line_shift_period_px", "line_steps", "line_width_px", "gray_cell_px", "gray_offset_px", "inverses",
)  # fmt: skip
_OF_SINES = ("sine_period_px", "sine_steps")

MOST_TURN_DEG = 3600.0
"""Ten turns either way: more is a slip, and winds up the cables of what stands on a turntable."""


class ProgressCallback(Protocol):
    """Told how far a scan is: the stage, the fraction done (0 to 1) of the whole call, and a few words."""

    def __call__(self, stage: str, fraction: float, detail: str, /) -> None:
        """Take note."""
        ...


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
    devices side by side, rows for devices above one another; see `slrig.scan.light_axis.played_axes`. cross_lines :
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

    Raises
    ------
    ConfigError
        depth_edge_ratio is not above 1 and finite, max_code_gap is below 1, flip_rule is none of `FlipRule`, axis none
        of `Axis`, or drop_finest_bits below 0.
    """

    keep_holes: bool = False
    depth_edge_ratio: float = 6.0
    max_code_gap: int = 1
    flip_rule: FlipRule = FlipRule.CONSTRAINED
    smooth_boundary: bool = True
    axis: Axis | None = None
    region: Region | None = None
    drop_finest_bits: int = 0

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

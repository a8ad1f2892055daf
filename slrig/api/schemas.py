"""Bodies of requests and answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from uuid import UUID

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from slrig.api.problems import fault_problem
from slrig.bundle import (
    EXPOSURE_KEYS,
    BracketSeconds,
    CameraName,
    ExposureFactors,
    FreeText,
    PoseEntry,
    PresetDocument,
    PresetName,
    RegionTable,
    ScanDefaults,
    Strict,
    TurnedBy,
    refuse_alternatives,
)
from slrig.failure import JobFailure
from slrig.jobs.records import JobRecord, JobState
from slrig.model import Axis, FlipRule, MeshAxes, SequenceName, Size
from slrig.scan.plan import (
    MOST_TURN_DEG,
    PatternPlan,
    PresetUse,
    ReconstructionPlan,
    RigGuess,
    ScanPlan,
    length_unit,
    unused_options,
)

MOST_EXPOSURE_S = 60.0
MOST_REPEATS = 500
"""Most of one request: more are for a schedule, which outlives the faults of one series."""
Body = TypeVar("Body", bound=BaseModel)


class PatternRequest(Strict):
    """Which patterns to play. What is absent or null is as the rig file says, and else the default."""

    sequence: Annotated[SequenceName, Field(strict=False)] | None = Field(
        default=None,
        description="defaults of the options below: `fast`, fewest frames; `standard`; `robust`, "
        "each bit with its inverse, for reflecting and concave objects; `phase`, sinusoids in few frames, "
        "where the projector shows shades of grey. Default standard",
    )
    line_shift: bool | None = Field(default=None, description="false: Gray code only. Default true")
    line_shift_period_px: Annotated[int, Field(ge=4, le=1024)] | None = Field(
        default=None, description="distance of two lines in one frame, projector pixels. Default: the sequence's"
    )
    line_steps: Annotated[int, Field(ge=3, le=1024)] | None = Field(
        default=None,
        description="number of line frames, which divide the distance evenly. Default: the sequence's; of `standard` "
        "and `robust` one for each pixel of the distance",
    )
    line_width_px: Annotated[int, Field(ge=1, le=256)] | None = Field(
        default=None, description="of a line, projector pixels. Default: half the line period"
    )
    sine_period_px: Annotated[int, Field(ge=4, le=1024)] | None = Field(
        default=None, description="of `phase`: period of the shortest sinusoid, projector pixels. Default 8"
    )
    sine_steps: Annotated[int, Field(ge=3, le=64)] | None = Field(
        default=None,
        description="of `phase`: frames of each sinusoid. Default 4; 3 take less time, bent more by gamma",
    )
    gray_cell_px: Annotated[int, Field(ge=1, le=1024)] | None = Field(
        default=None, description="width of the finest Gray cell. Default: half the line period, or 2 without lines"
    )
    gray_offset_px: Annotated[int, Field(ge=0, le=65535)] | None = Field(
        default=None, description="moves the edges of the Gray cells. Default 0"
    )
    inverses: bool | None = Field(
        default=None,
        description="play each bit of the code with its inverse. Default: the sequence's, and true without lines of "
        "half their period",
    )
    rows: bool | None = Field(
        default=None,
        description="true: columns and rows. false: columns alone. Default: as the calibration needs, columns for "
        "devices side by side and rows for devices above one another; columns without a calibration",
    )
    cross_lines: bool | None = Field(
        default=None,
        description="true: where one axis is played, also one frame of lines along the other, which tests the "
        "calibration. Default false",
    )


class UncalibratedRequest(Strict):
    """Known facts of the devices of a rig that is not calibrated: the scan itself calibrates it."""

    focal_px: dict[CameraName, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict, description="focal length of cameras by name, px. Default: 1.4 times the image's width"
    )
    focal_sigma: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="relative standard deviation of these lengths"
    )
    throw_ratio: Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None, description="distance over width of the projector's picture. Default 1.4"
    )
    throw_sigma: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="relative standard deviation of the throw ratio"
    )
    baseline_mm: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        default=None,
        description="distance of the first camera from the projector. Default: lengths are in hundredths of it",
    )
    baseline_sigma: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.01, description="relative standard deviation of the baseline"
    )
    most_error: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.0015, description="stated error of shape over the size of the scene beyond which it is refused"
    )

    def guess(self) -> RigGuess:
        """The same as a plan has it."""
        return RigGuess(**self.model_dump())


class ReconstructionRequest(Strict):
    """Options of the reconstruction. Absent or null ones are as the rig file says, or else the default."""

    keep_holes: bool | None = Field(
        default=None, description="drop triangles that span a gap between two stripes of one code. Default false"
    )
    depth_edge_ratio: Annotated[float, Field(gt=1, le=1000)] | None = Field(
        default=None,
        description="a triangle edge longer than this many times the local sampling distance crosses a depth edge. "
        "Default 6",
    )
    max_code_gap: Annotated[int, Field(ge=1, le=64)] | None = Field(
        default=None,
        description="stripes with columns that differ by at most this many steps are meshed together. Default 1",
    )
    flip_rule: Annotated[FlipRule, Field(strict=False)] | None = Field(
        default=None,
        description="when an edge is exchanged for the other diagonal of its two triangles: Delaunay, or Delaunay "
        "constrained against sharp triangles and folds. Default constrained",
    )
    smooth_boundary: bool | None = Field(
        default=None, description="shrink and smooth the boundary of the mesh. Default true"
    )
    axis: Annotated[Axis, Field(strict=False)] | None = Field(
        default=None,
        description="of the light to triangulate by; it is played. Default: the one that crosses the baseline more "
        "steeply",
    )
    region: RegionTable | None = Field(default=None, description="what of the scene is measured. Default: all of it")
    drop_finest_bits: Annotated[int, Field(ge=0, le=16)] | None = Field(
        default=None,
        description="number of finest bits of the code not to read where its edges give the points: without line-shift "
        "frames, or where the camera does not resolve lines. Default 0: every bit that the camera resolves",
    )
    mesh_axes: Annotated[MeshAxes, Field(strict=False)] | None = Field(
        default=None,
        description="axes of mesh.ply, points.ply, STL, OBJ and 3MF: x right, y up, z towards the rig, or those of the "
        "calibration (x right, y down, z away), in which all other files and figures are; robot: the base of a robot, "
        "by hand-eye calibration (PUT /hand-eye), of a single scan. Default upright",
    )
    uncalibrated: UncalibratedRequest | None = Field(
        default=None,
        description="calibrate by the scan itself, which plays columns and rows, from these guesses, and use no "
        "calibration of the rig; `{}` guesses all. Default: the rig's calibration",
    )


class ShotRequest(Strict):
    """Options of a scan of an object. An empty request is as the rig file describes it."""

    preset: PresetName | None = Field(
        default=None,
        description="options by name, as GET /preset lists them. Other options of the request override it; it "
        "overrides the rig file's `[scan]`",
    )
    patterns: PatternRequest = Field(default_factory=PatternRequest)
    reconstruction: ReconstructionRequest = Field(default_factory=ReconstructionRequest)
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = Field(
        default=None, description="exposure time of every camera, seconds. Default: as the rig file says per camera"
    )
    exposures_s: BracketSeconds | None = Field(
        default=None,
        description="a bracket, for what is dark here and shines there: the sequence is played once for each of these "
        "exposure times of every camera, seconds, and the frames are fused. Two to six in place of exposure_s; on a "
        "video projector, whole refresh periods. Default: as the rig file says",
    )
    exposure_factors: ExposureFactors | None = Field(
        default=None,
        description="in place of both, times the exposure that the rig's cameras have by themselves: one, or two to "
        "six for a bracket, which where cameras differ is of their geometric mean",
    )
    colour: bool | None = Field(
        default=None,
        description="true: keep white and black frames in colour, and refuse where a camera has none. false: in grey. "
        "Default: as the rig file says, else in colour where a camera has it",
    )
    coloured_light: bool | None = Field(
        default=None,
        description="true: play white in red, green and blue as well, so that cameras without colour give it, and "
        "refuse where the projector has no such lights or every camera has colour. Default: as the rig file says, else "
        "false",
    )

    _one_exposure = field_validator("exposures_s", "exposure_factors")(refuse_alternatives)


class ScanRequest(ShotRequest):
    """A scan. An empty request is a scan as the rig file describes it."""

    label: FreeText | None = Field(default=None, description="free text, to find the scan again")
    turn_deg: Annotated[float, Field(ge=-MOST_TURN_DEG, le=MOST_TURN_DEG)] | None = Field(
        default=None,
        description="angle of the turntable for this scan, right-handed about its axis; the report says so. "
        "The rig's turntable turns there first, from where it stood when it was opened. Default: nothing is turned",
    )
    turned_by: TurnedBy = Field(
        default="table", description="hand: a person has turned the object to turn_deg already, and nothing moves"
    )
    robot_pose: PoseEntry | None = Field(
        default=None, description="of the flange in the robot's base, 4 x 4, mm, at this scan, where the rig is in hand"
    )
    if_busy: Literal["reject", "queue"] = Field(
        default="reject", description="what to do while the rig is held: answer 409, or wait in line"
    )

    repeat: Annotated[int, Field(ge=1, le=MOST_REPEATS)] = Field(
        default=1, description="a series of so many scans; the answer is the first one, `links.series` leads to all"
    )
    every_s: Annotated[float, Field(ge=0, le=86400)] | None = Field(
        default=None,
        description="of a series: a scan begins so long after the one before it began, or as soon as the rig is free, "
        "if that is later. Default: as soon as the rig is free",
    )

    @field_validator("every_s")
    @classmethod
    def _of_a_series(cls, every_s: float | None, info: ValidationInfo) -> float | None:
        if every_s is not None and info.data.get("repeat") == 1:
            message = "expected repeat above 1 with it, found none; say how many scans, or leave every_s out"
            raise ValueError(message)
        return every_s


def filled(body: type[Body], source: object, /, **others: Any) -> Body:
    """An answer with the attributes of `source` by their names, at every depth, save what `others` says."""
    own = {name: getattr(source, name) for name in body.model_fields if name not in others}
    return body.model_validate({**own, **others}, from_attributes=True)


def scan_plan(
    request: ShotRequest,
    defaults: ScanDefaults,
    preset: PresetDocument | None = None,
    rig_in_base: Sequence[Sequence[float]] | None = None,
) -> ScanPlan:
    """The plan that a request means on a rig with these defaults. preset : the one that the request names.
    rig_in_base : (4, 4), mm, the rig in a robot's base, where it is known.

    The rig file's exposure is not part of it: it is among the settings that each camera was opened with. Its bracket
    is, unless the request or the preset states an exposure.

    >>> scan_plan(ScanRequest(), ScanDefaults(line_shift_period_px=12)).patterns.line_shift_period_px
    12
    >>> scan_plan(ScanRequest(exposure_s=0.02), ScanDefaults(exposures_s=(0.01, 0.04))).exposures_s is None
    True
    """
    usual, use = defaults.model_copy(update={"exposure_s": None}), None
    if preset is not None and request.preset is not None:
        usual, use = preset.scan.apply_to(usual), PresetUse(request.preset, preset.version, preset.digest)
    exposing: BaseModel = request if any(getattr(request, key) is not None for key in EXPOSURE_KEYS) else usual
    return ScanPlan(
        patterns=pattern_plan(request.patterns, usual),
        reconstruction=ReconstructionPlan(
            **_chosen(ReconstructionPlan, request.reconstruction, usual),
            rig_in_base=None if rig_in_base is None else tuple(map(tuple, rig_in_base)),
        ),
        **{key: getattr(exposing, key) for key in EXPOSURE_KEYS},
        colour=request.colour if request.colour is not None else usual.colour,
        coloured_light=bool(usual.coloured_light if request.coloured_light is None else request.coloured_light),
        preset=use,
    )


def pattern_plan(request: PatternRequest, defaults: ScanDefaults) -> PatternPlan:
    """The patterns that a request means on a rig with these defaults. Of those, what is of lines or of sinusoids counts
    in their own sequences only. Raises ConfigError: the request has options of one kind with a sequence of the other.

    >>> request = PatternRequest(sequence="phase", sine_period_px=16)
    >>> pattern_plan(request, ScanDefaults(line_width_px=1)) == PatternPlan(sequence="phase", sine_period_px=16)
    True
    """
    chosen = _chosen(PatternPlan, request, defaults)
    unused = unused_options(chosen.get("sequence", SequenceName.STANDARD))
    counts = (key for key in chosen if key not in unused or getattr(request, key) is not None)
    return PatternPlan(**{key: chosen[key] for key in counts})


def _chosen(plan: type[Any], request: BaseModel, defaults: ScanDefaults) -> dict[str, Any]:
    chosen = {}
    for field in fields(plan):
        # Not every part of a plan is an option of a request, or of a rig file.
        given = getattr(request, field.name, None)
        value = given if given is not None else getattr(defaults, field.name, None)
        if value is not None:
            chosen[field.name] = (
                value.region() if isinstance(value, RegionTable)
                else value.guess() if isinstance(value, UncalibratedRequest)
                else value
            )  # fmt: skip
    return chosen


class NewName(Strict):
    """The name of a scan or a model from now on."""

    label: FreeText | None = Field(description="free text; null takes the name away")


class ProgressBody(BaseModel):
    """Progress of a job: 0 to 1 of the whole."""

    stage: str
    fraction: Annotated[float, AfterValidator(lambda fraction: round(fraction, 4))]
    detail: str


class JobLinks(BaseModel):
    """Links of a job. `files` holds those that are ready."""

    self: str
    events: str
    cancel: str
    files: dict[str, str]


class ScanLinks(JobLinks):
    """Links of a scan. `files` holds those that are ready."""

    series: str | None = Field(description="all scans of the series that this one belongs to; null for one alone")


def _shown_fault(fault: object) -> object:
    """A recorded fault as a problem; a problem that was sent can be read again."""
    return fault_problem(fault) if isinstance(fault, JobFailure) else fault


AnyFault = Annotated[dict[str, Any] | None, BeforeValidator(_shown_fault)]
"""A recorded fault, shown as the problem that it is."""
FaultBody = Annotated[
    AnyFault,
    # Already a document, without the members that do not apply; described as what it is.
    WithJsonSchema({"anyOf": [{"$ref": "#/components/schemas/Problem"}, {"type": "null"}]}),
    Field(description="why it did not succeed"),
]


Plan = TypeVar("Plan")
AskedPlan = Annotated[
    Plan | None,
    BeforeValidator(lambda plan: plan or None),
    Field(description="the request; null where its record is damaged"),
]


class JobFacts(BaseModel):
    """Fields of every job on record."""

    id: UUID
    state: JobState
    label: str | None
    rig: str
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    progress: ProgressBody
    error: FaultBody


class JobBody(JobFacts):
    """A job on record."""

    summary: dict[str, Any] | None = Field(description="the plain figures and the notes of report.json")
    requested_by: str | None = Field(description="the name of the key, or the schedule, that requested it")


class ListedLinks(BaseModel):
    """Links of a listed job. `self` has everything else; `picture` is null where there is none yet."""

    self: str
    events: str
    cancel: str
    picture: str | None


class ListedJob(JobFacts):
    """A scan or a model in a list."""

    pinned: bool = Field(description="kept, also where the settings remove old ones")
    triangles: int | None = Field(description="of its mesh; null without one")
    sigma_mm: float | None = Field(description="median of the standard deviations of the mesh's points")
    links: ListedLinks


LengthUnit = Annotated[
    str,
    Field(description="of lengths in its files and figures: mm, or % of baseline where no calibration and no baseline "
          "are known"),
]  # fmt: skip


class ScanBody(JobBody):
    """A scan on record."""

    plan: AskedPlan[ScanPlan]
    unit: LengthUnit
    pinned: bool = Field(description="kept, also where the settings remove old scans")
    links: ScanLinks


class ListedScan(ListedJob):
    """A scan in a list."""

    turn_deg: float | None = Field(description="angle of the turntable; null where nothing was turned")
    preset: str | None = Field(description="the name of the requested preset; null without one")
    unit: LengthUnit


class ScanSeries(BaseModel):
    """The scans of a series that are on record, in their order."""

    scans: list[ScanBody]


def listed_links(record: JobRecord, made: Path, picture: str) -> ListedLinks:
    """The links of a scan or a model in a list. picture : the name of the one that it has where there is `made`."""
    here = f"{record.kind.path}/{record.id}"
    shown = f"{here}/{picture}" if record.state.final and made.is_file() else None
    return ListedLinks(self=here, events=f"{here}/events", cancel=f"{here}/cancel", picture=shown)


class ScanPage(BaseModel):
    """Scans from new to old. `next` is the path of the next page, null on the last."""

    scans: list[ListedScan]
    next: str | None


def scan_body(record: JobRecord, files: Mapping[str, str]) -> ScanBody:
    """A record as an answer; `files` maps the names of those that are ready to their paths."""
    here = f"/scan/{record.id}"
    series = None if record.parent is None else f"/scan/series/{record.parent}"
    links = ScanLinks(self=here, events=f"{here}/events", cancel=f"{here}/cancel", series=series, files=dict(files))
    return filled(ScanBody, record, error=record.fault, unit=scan_unit(record), links=links)


def scan_unit(record: JobRecord) -> str:
    """Unit of a scan's lengths, also where the record of the request is damaged."""
    guess = (record.plan.get("reconstruction") or {}).get("uncalibrated")
    return length_unit(None if guess is None else RigGuess(baseline_mm=guess.get("baseline_mm")))


Extent = Annotated[
    tuple[int, int], BeforeValidator(lambda size: (size.width_px, size.height_px) if isinstance(size, Size) else size)
]
"""A `Size`, shown as width and height."""


class CameraBody(BaseModel):
    """A camera of the rig, as it declares itself, and as it is set."""

    name: str
    model: str
    serial: str
    size_px: Extent
    bit_depth: int
    triggers: list[str]
    exposure_range_s: tuple[float, float]
    gain_range: tuple[float, float]
    colour: bool
    exposure_s: float | None = Field(
        description="in use, as the camera read it back when it was last set; null before the first picture or scan"
    )
    gain: float | None = Field(description="in use, likewise")
    notes: list[str] = Field(
        description="its driver's remarks, and settings that it refused or changed; each with what to do"
    )


class ProjectorBody(BaseModel):
    """The projector of the rig, as it declares itself."""

    name: str
    model: str
    serial: str
    size_px: Extent
    plays: bool
    latency_s: float
    refresh_s: float | None = Field(description="of its light: exposures that are whole multiples of it see it steady")


class CalibrationInUse(BaseModel):
    """The calibration that scans use."""

    source: Literal["session", "rig"] = Field(description="activated here, or the rig file's or the head's own")
    id: UUID | None = Field(description="GET /calibration/{id} has it; null where it is the rig's own")
    solve: str | None = Field(description="names the solve, as the reports of scans do; null if it does not say")
    solved_at: datetime | None
    age_s: float | None
    expected_error_mm: float | None = Field(
        description="of a scanned point now, a standard deviation: that of the solve, the board's size included, and "
        "what changed since; null if the calibration says nothing of its own error"
    )
    error: str | None = Field(description="why scans are refused with it: it is for other devices")


class RigBody(BaseModel):
    """The rig: what is known of its devices, who holds it, and how many scans wait."""

    name: str
    open: bool = Field(description="every device is open and was well when last used")
    error: str | None = Field(description="why it is not open; the next scan tries again")
    opening: str = Field(description="its driver's latest report while it is opened; empty without one")
    reconstruction: str = Field(description="ok, or how far the process that computes is, or why it cannot compute")
    preparing: bool = Field(description="that process is on its way to ok")
    calibrated: bool | None = Field(description="null before the rig was first open")
    calibration: CalibrationInUse | None = Field(description="what scans use now; null where there is none")
    positions: list[str] = Field(description="poses that the rig's positioner can take; none where a person does")
    turntable: bool = Field(description="the positioner turns objects to any angle")
    cameras: list[CameraBody]
    lost_cameras: dict[str, str] = Field(
        description="cameras of the rig file that could not be opened, each with the reason; scans go on without them, "
        "and the next work tries again"
    )
    projector: ProjectorBody | None
    holder: str | None = Field(description="who holds the rig: the id of a scan, or other work by name")
    since: datetime | None
    waiting: int
    queue_length: int
    computing: list[str] = Field(
        description="scans that are reconstructed, and other work that computes, or wait for that, in their order and "
        "named as the holder is: the rig is free of them"
    )
    backlog_length: int = Field(description="while as many are computed, the next scan waits before it begins")
    scan_defaults: dict[str, Any] = Field(description="what the rig file says; a request may say otherwise")
    fleet: bool = Field(description="it shares a catalogue with other rigs: GET /fleet")


class Probe(BaseModel):
    """The answer of a probe: each check, "ok" or what is wrong or not done yet."""

    checks: dict[str, str]
    pending: list[str] = Field(default=[], description="checks that are on their way to ok by themselves")


class Explanation(BaseModel):
    """Meaning of a kind of problem."""

    type: str
    title: str
    description: str

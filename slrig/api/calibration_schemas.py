"""What requests of a calibration may say and what answers hold."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import BaseModel, BeforeValidator, Field

from slrig.api.schemas import MOST_EXPOSURE_S, FaultBody, PatternRequest, ProgressBody, filled
from slrig.bundle import FreeText, SafeText, Strict
from slrig.calibrate.records import PoseRecord, SessionRecord, SessionState, plain
from slrig.calibration import DEFAULT_BOARD, BoardKind, BoardShape
from slrig.jobs.records import JobState
from slrig.scan.plan import PatternPlan
from slrig.schedule.task_options import ScheduledBoard

Millimetres = Annotated[float, Field(gt=0, le=1000)]
CornerCount = Annotated[int, Field(ge=3, le=60)]
Known = Annotated[float | None, BeforeValidator(plain)]
"""A figure, null where it is not known, which is NaN."""
IfBusy = Literal["reject", "queue"]


class BoardRequest(ScheduledBoard):
    """The board that is printed: see `slrig calibrate board`."""

    corners: Annotated[
        list[CornerCount],
        Field(min_length=2, max_length=2, description="inner corners (circles), columns then rows"),
    ]
    square_mm: Millimetres = Field(
        description="side of a square as measured on the print; of circles, the distance of two neighbouring rows"
    )
    marker_mm: Millimetres | None = Field(default=None, description="of a ChArUco board. Default 0.75 of square_mm")
    dictionary: Annotated[SafeText, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description="of a ChArUco board's markers, by OpenCV's name. Default DICT_5X5_250"
    )
    square_sigma: Annotated[float, Field(gt=0, le=0.05)] | None = Field(
        default=None,
        description="standard deviation of the print's width, and of its height, over themselves, as of a certificate. "
        "Default 0.001; with measured_mm, that of a steel ruler",
    )
    aspect: Annotated[float, Field(gt=0.9, lt=1.1)] = Field(
        default=1.0, description="a square's height over its width, as measured"
    )
    measured_mm: Annotated[list[Millimetres], Field(min_length=2, max_length=2)] | None = Field(
        default=None,
        description="what the two printed scales of the sheet measure from end to end: the one below the board, and "
        "the one left of it",
    )


class CalibrationRequest(Strict):
    """A calibration session. An empty request opens one for the usual board."""

    board: BoardRequest | None = Field(default=None, description=f"Default: {DEFAULT_BOARD.description}")
    label: FreeText | None = None
    patterns: PatternRequest = Field(
        default_factory=PatternRequest,
        description="what each pose is lit with. Default: as the rig file says, with both axes",
    )
    projector: bool = Field(
        default=True,
        description="false: calibrate the cameras alone, one or several. Poses are lit white and black, without codes",
    )


class PoseRequestBody(Strict):
    """A pose. An empty request shoots the board where it is held."""

    position: Annotated[int, Field(ge=0, le=10_000)] | FreeText | None = Field(
        default=None, description="of the positioner, by its number from 0 or its name. Default: a person holds it"
    )
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = Field(
        default=None, description="of every camera, seconds. Default: as the rig file says per camera"
    )
    if_busy: IfBusy = Field(
        default="reject", description="what to do while the rig is held: answer 409, or wait in line"
    )


class ScriptRequest(Strict):
    """Poses of the positioner, one after the other. An empty request shoots all of them."""

    positions: Annotated[
        list[Annotated[int, Field(ge=0, le=10_000)] | FreeText],
        Field(max_length=1000),
    ] = Field(default_factory=list, description="by number from 0 or by name. Default: all, in their order")
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None
    if_busy: IfBusy = "reject"


class SolveRequest(Strict):
    """A solve. An empty request solves from all accepted poses."""

    board_shape: Annotated[BoardShape, Field(strict=False)] = Field(
        default=BoardShape.AUTO,
        description="flat: the board is, for certain; bowed: its bend is solved for; auto: it is taken for bowed where "
        "held-out poses are better with that",
    )


class PoseLinks(BaseModel):
    """Where to go from a pose."""

    self: str
    events: str
    cancel: str
    pictures: dict[str, str] = Field(description="by camera: the white frame, with the corners that were found")


class PoseBody(BaseModel):
    """A pose of a session."""

    number: int
    name: str
    state: JobState = Field(description="succeeded where a solve takes it")
    accepted: bool | None = Field(description="whether a solve takes it, by what was found; null until it was read")
    created_at: datetime
    position: int | None
    position_name: str | None
    exposure_s: float | None
    answer: dict[str, Any] | None = Field(
        description="by camera: corners found, share of the image filled, tilt, distance, sharpness, saturation, "
        "movement; and warnings in words"
    )
    error: FaultBody = Field(description="why it was refused, and what to do")
    seconds: float | None = Field(description="from the last frame to the answer")
    links: PoseLinks


class CalibrationLinks(BaseModel):
    """Where to go from a calibration. `files` holds those that are ready."""

    self: str
    events: str
    pose: str
    solve: str
    activate: str
    coverage: dict[str, str] = Field(description="by device: a picture of what is covered, and where to go next")
    files: dict[str, str]


class BoardBody(BaseModel):
    """The board of a session."""

    kind: BoardKind
    corners: tuple[int, int]
    square_mm: float
    marker_mm: float | None
    dictionary: str | None
    square_sigma: float = Field(description="deviation of the print's width and of its height, over themselves")
    aspect: float = Field(description="a square's height over its width")
    title: str


class CalibrationSummary(BaseModel):
    """A calibration, as a list shows it."""

    id: UUID
    state: SessionState
    label: str | None
    rig: str
    created_at: datetime
    solved_at: datetime | None
    imported: bool
    active: bool = Field(description="scans use it")
    poses: int = Field(description="those that were accepted")
    verdict: str | None = Field(description="of the last solve, in a sentence")
    links: CalibrationLinks


class CalibrationBody(CalibrationSummary):
    """A calibration session with its poses and what came of them."""

    board: BoardBody | None
    patterns: PatternPlan
    shot: list[PoseBody] = Field(description="every pose, refused and failed ones too")
    script: list[int] = Field(description="positions of the positioner that are still to be taken")
    coverage: dict[str, Any] | None = Field(
        description="by device: a 6 x 6 grid of how many poses were seen where, depths, tilts and turns; and what is "
        "still missing, in words"
    )
    next_move: dict[str, Any] | None = Field(description="what to move next, and why")
    progress: ProgressBody | None = Field(description="of what is under way")
    error: FaultBody = Field(description="why the last solve failed")
    result: dict[str, Any] | None = Field(
        description="of the last solve that went well: devices with rms and values, each with its standard deviation; "
        "the expected error in mm, of one camera alone `across` its line of sight; `odd_even`, by how many mm odd and "
        "even poses differ that are solved apart, over what is stated for that, null where they are too few; how far "
        "the board is out of flat; "
        "the verdict and why"
    )
    last_event: int = Field(description="to follow `links.events` from here: send it as Last-Event-ID")


class CalibrationList(BaseModel):
    """Calibrations from new to old."""

    calibrations: list[CalibrationSummary]
    active: UUID | None = Field(description="the one that scans use; null where it is the rig's own")


class DifferenceBody(BaseModel):
    """Second minus first, and its standard deviation; null where either says nothing of its own error."""

    value: float
    sigma: Known
    sigmas: Known = Field(description="the size of the difference in its standard deviation")
    words: str


class DeviceDifferenceBody(BaseModel):
    """What differs of one device; the last two are null for the first camera, which both start from."""

    focal_percent: DifferenceBody
    principal_px: DifferenceBody
    rotation_deg: DifferenceBody | None
    baseline_mm: DifferenceBody | None


class ComparisonBody(BaseModel):
    """Two calibrations, compared."""

    first: UUID
    second: UUID
    devices: dict[str, DeviceDifferenceBody]
    missing: list[str] = Field(description="devices that only one of them has")
    moved_rms_mm: Known = Field(
        description="by how much points in the volume move, beyond the rigid motion of them all; null without a volume"
    )
    moved_max_mm: Known
    turn_deg: Known = Field(description="of that rigid motion, about the volume's middle")
    shift_mm: Known = Field(description="of that rigid motion, of the volume's middle")
    words: list[str]


def pose_body(session_id: UUID, pose: PoseRecord, cameras: Mapping[str, object]) -> PoseBody:
    """A pose as an answer; `cameras` are those of the session."""
    here = f"/calibration/{session_id}/pose/{pose.number}"
    shown = pose.accepted or pose.refused
    pictures = {name: f"{here}/picture.png?camera={name}" for name in cameras} if shown else {}
    links = PoseLinks(self=here, events=f"/calibration/{session_id}/events", cancel=f"{here}/cancel", pictures=pictures)
    judged = True if pose.accepted else False if pose.refused else None
    return filled(PoseBody, pose, accepted=judged, error=pose.fault, links=links)


def calibration_summary(record: SessionRecord, *, active: UUID | None, files: Mapping[str, str]) -> CalibrationSummary:
    """A calibration as a list shows it; `files` maps the names of those that are ready to their paths."""
    return filled(CalibrationSummary, record, **_summary(record, active, files))


def calibration_body(
    record: SessionRecord, *, active: UUID | None, files: Mapping[str, str], last_event: int
) -> CalibrationBody:
    """A calibration as an answer."""
    board = record.board
    return filled(
        CalibrationBody,
        record,
        **_summary(record, active, files),
        board=None if board is None else filled(BoardBody, board, corners=(board.columns, board.rows)),
        shot=[pose_body(record.id, pose, record.cameras) for pose in record.poses],
        error=record.fault,
        last_event=last_event,
    )


def _summary(record: SessionRecord, active: UUID | None, files: Mapping[str, str]) -> dict[str, Any]:
    here = f"/calibration/{record.id}"
    devices = [*record.cameras, *(["projector"] if record.projector is not None else [])]
    shown = devices if record.board is not None else ()
    return {
        "imported": record.board is None,
        "active": active == record.id,
        "poses": len(record.accepted),
        "verdict": ((record.result or {}).get("verdict") or {}).get("summary"),
        "links": CalibrationLinks(
            self=here,
            events=f"{here}/events",
            pose=f"{here}/pose",
            solve=f"{here}/solve",
            activate=f"{here}/activate",
            coverage={name: f"{here}/coverage.png?device={name}" for name in shown},
            files=dict(files),
        ),
    }

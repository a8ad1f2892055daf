"""/calibration: a board to print; a session, its poses, its solve, its use; list, import, compare, delete; files."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal
from uuid import UUID

from fastapi import APIRouter, Body, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse
from pydantic import BaseModel, BeforeValidator, Field
from starlette.exceptions import HTTPException

from slrig.api.problems import file_of, problems
from slrig.api.schemas import MOST_EXPOSURE_S, FaultBody, PatternRequest, ProgressBody, filled, pattern_plan
from slrig.api.service import IdempotencyKey, Probed, Service, Serving, started_once
from slrig.bundle import CAMERA_NAME, MAX_CALIBRATION_BYTES, FreeText, SafeText, Strict
from slrig.calibrate.job import EXPORTS, PoseRequest
from slrig.calibrate.store import (
    REPORT,
    USUAL_PATTERNS,
    PoseRecord,
    SessionRecord,
    SessionState,
    picture_name,
    plain,
    pose_of,
    session_readings,
    setting_of,
)
from slrig.calibration import DEFAULT_BOARD, Board, BoardKind, BoardShape, PoseObservation
from slrig.errors import ArtefactNotReadyError, CalibrationStateError, CameraNotFoundError, ConfigError
from slrig.jobs.records import JobState
from slrig.model import Calibration
from slrig.scan.plan import PatternPlan
from slrig.schedule.scheduler import ScheduledBoard

Millimetres = Annotated[float, Field(gt=0, le=1000)]
CornerCount = Annotated[int, Field(ge=3, le=60)]
Known = Annotated[float | None, BeforeValidator(plain)]
"""A figure, null where it is not known, which is NaN."""
IfBusy = Literal["reject", "queue"]


Rulers = Annotated[
    list[Millimetres],
    Field(
        min_length=2,
        max_length=2,
        description="what the two printed scales of the sheet measure from end to end: the one below the board, and "
        "the one left of it",
    ),
]


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
    measured_mm: Rulers | None = None


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
    measured_mm: Rulers | None = Field(
        default=None, description="for a board that was not measured when the session began: as in POST /calibration"
    )


class PoseLinks(BaseModel):
    """Links of a pose."""

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
        "movement; and warnings as text"
    )
    error: FaultBody = Field(description="why it was refused, and what to do")
    seconds: float | None = Field(description="from the last frame to the answer")
    links: PoseLinks


class CalibrationLinks(BaseModel):
    """Links of a calibration. `files` holds those that are ready."""

    self: str
    events: str
    pose: str
    solve: str
    activate: str
    coverage: dict[str, str] = Field(description="by device: a picture of the coverage, and the board's next place")
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
    rulers_mm: tuple[int, int] = Field(description="what the scales below and left of it are printed to measure")
    measured: bool = Field(description="its size was measured, and is not what some printer made of it")
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
    pinned: bool = Field(description="kept, also where the settings remove old calibrations")
    coverage: dict[str, Any] | None = Field(
        description="by device: a 6 x 6 grid of how many poses were seen where, depths, tilts and turns; and what is "
        "still missing, as text"
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
    """Differences of one device; the last two are null for the first camera, which both start from."""

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


IMPORT_PATH = "/calibration/import"
MOST_IMPORT_BYTES = MAX_CALIBRATION_BYTES
"""Longest body of an import: a covariance is longer than any other request."""

_ENDINGS = {
    "application/json": ".json",
    "application/yaml": ".yml",
    "application/x-yaml": ".yml",
    "text/yaml": ".yml",
    "application/xml": ".xml",
    "text/xml": ".xml",
}

router = APIRouter(prefix="/calibration", tags=["calibration"])

Label = Annotated[FreeText | None, Query(description="free text, to find it again")]


def _answered(service: Service, record: SessionRecord) -> CalibrationBody:
    calibrations = service.calibrations
    return calibration_body(
        record,
        active=calibrations.active,
        files=_ready_files(service, record),
        last_event=service.store.last_event_of(record.id),
    )


def _ready_files(service: Service, record: SessionRecord) -> dict[str, str]:
    """Name to URL path of each file of a calibration that can be fetched now."""
    if not record.solve:
        return {}
    place = service.calibrations.store.solve(record.id, record.solve)
    names = [*EXPORTS, *([REPORT] if (place / REPORT).is_file() else [])]
    return {name: f"/calibration/{record.id}/{name}" for name in names}


@router.post("", status_code=201, responses=problems(507))
def open_calibration(
    service: Serving,
    response: Response,
    request: Annotated[CalibrationRequest, Body(default_factory=CalibrationRequest)],
) -> CalibrationBody:
    """Open a calibration session for a board. Touches no device."""
    # A pose is shot once and counts for long: its rows and its sequence are not what scans of the rig play.
    usual = {
        key: getattr(USUAL_PATTERNS, key) for key in ("rows", "sequence") if getattr(request.patterns, key) is None
    }
    patterns = pattern_plan(request.patterns.model_copy(update=usual), service.scan_defaults)
    patterns = replace(patterns, codes=request.projector)
    if patterns.named.sines:
        message = (
            f"patterns.sequence: {patterns.sequence} plays sinusoids, and poses are read by Gray code; leave it out, "
            f"and {USUAL_PATTERNS.sequence} is played. Scans of the rig may still play {patterns.sequence}"
        )
        raise ConfigError(message)
    board = DEFAULT_BOARD if request.board is None else request.board.board()
    record = service.calibrations.open(board, label=request.label, patterns=patterns)
    response.headers["Location"] = f"/calibration/{record.id}"
    return _answered(service, record)


@router.get("")
def list_calibrations(service: Serving, limit: Annotated[int, Query(ge=1, le=200)] = 50) -> CalibrationList:
    """List calibrations from new to old, and say which one scans use."""
    active = service.calibrations.active
    shown = service.calibrations.latest()[:limit]
    return CalibrationList(
        calibrations=[calibration_summary(each, active=active, files=_ready_files(service, each)) for each in shown],
        active=active,
    )


@router.post(
    "/import",
    status_code=201,
    responses=problems(415, 503, 507),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                name: {"schema": {"type": "string"}}
                for name in ("application/json", "application/yaml", "application/xml")
            },
        }
    },
)
async def import_calibration(
    request: Request, service: Serving, response: Response, label: Label = None
) -> CalibrationBody:
    """Take in a calibration: slrig's JSON, or OpenCV FileStorage as YAML or XML. It can then be activated."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    ending = _ENDINGS.get(kind)
    if ending is None:
        message = (
            f"Content-Type: expected one of {', '.join(_ENDINGS)}, found '{kind}'. Send the file as it is, with the "
            "type that it has."
        )
        raise HTTPException(415, message)
    text = await request.body()
    record = await run_in_threadpool(service.calibrations.submit, text, ending, label=label)
    response.headers["Location"] = f"/calibration/{record.id}"
    return await run_in_threadpool(_answered, service, record)


@router.get("/board.pdf", response_class=Response, responses=file_of("application/pdf", 503))
async def fetch_board(
    service: Probed,
    kind: BoardKind = DEFAULT_BOARD.kind,
    columns: CornerCount = DEFAULT_BOARD.columns,
    rows: CornerCount = DEFAULT_BOARD.rows,
    square_mm: Millimetres = DEFAULT_BOARD.square_mm,
    marker_mm: Millimetres | None = None,
    dictionary: Annotated[SafeText, Query(min_length=1, max_length=64)] | None = None,
    page: Annotated[
        str,
        Query(max_length=32, description="A4, A3, letter; fit, as large as the board needs; or WIDTHxHEIGHT in mm"),
    ] = "A4",
) -> Response:
    """Return the sheet of a board, to be printed at 100 %, with a scale below the board and one left of it. The fields
    are those of POST /calibration.
    """
    # Late: what draws a PDF takes a while to load.
    from slrig.calibration.printing import board_pdf

    board = Board(kind, columns, rows, square_mm, marker_mm, dictionary)
    name = f"board-{kind}-{columns}x{rows}-{square_mm:g}mm.pdf"
    headers = {"Content-Disposition": f'inline; filename="{name}"', "Cache-Control": "no-store"}
    pdf = await service.makings.of((board, page), partial(board_pdf, board, page=page))
    return Response(pdf, media_type="application/pdf", headers=headers)


@router.get("/compare", responses=problems(404, 409, 503))
async def compare_calibrations(service: Serving, first: UUID, second: UUID) -> ComparisonBody:
    """Compare two calibrations of one rig: each device's differences in their σ, and by how much points move."""
    compare = partial(service.calibrations.compare, first, second)
    return filled(ComparisonBody, await service.clouds.of((first, second), compare), first=first, second=second)


@router.get("/{calibration_id}")
def look_at_calibration(service: Serving, calibration_id: UUID) -> CalibrationBody:
    """Return a calibration: its poses with their answers, its coverage, the next move, and the result."""
    return _answered(service, service.calibrations.register.get(calibration_id))


@router.post("/{calibration_id}/pose", status_code=202, responses=problems(409, 429, 502, 503, 507))
def shoot_pose(
    service: Serving,
    response: Response,
    calibration_id: UUID,
    request: Annotated[PoseRequestBody, Body(default_factory=PoseRequestBody)],
    idempotency_key: IdempotencyKey = None,
) -> PoseBody:
    """Shoot a pose of the board. The answer comes at once; GET the pose for the result."""
    wanted, wait = PoseRequest(request.position, request.exposure_s), request.if_busy == "queue"

    def shoot(key: str | None) -> PoseRecord:
        return service.calibrations.shoot(calibration_id, wanted, wait=wait, key=key)

    return _accepted(service, response, calibration_id, "pose", idempotency_key, request, shoot)


@router.post("/{calibration_id}/script", status_code=202, responses=problems(409, 429, 502, 503, 507))
def shoot_script(
    service: Serving,
    response: Response,
    calibration_id: UUID,
    request: Annotated[ScriptRequest, Body(default_factory=ScriptRequest)],
    idempotency_key: IdempotencyKey = None,
) -> PoseBody:
    """Shoot the poses of the positioner one after the other; return the first. Other work may come between two of them.
    To stop, cancel the pose that is under way.
    """
    wanted, wait = PoseRequest(None, request.exposure_s), request.if_busy == "queue"

    def shoot(key: str | None) -> PoseRecord:
        return service.calibrations.script(calibration_id, request.positions, wanted, wait=wait, key=key)

    return _accepted(service, response, calibration_id, "script", idempotency_key, request, shoot)


def _accepted(
    service: Service,
    response: Response,
    calibration_id: UUID,
    what: str,
    key: str | None,
    request: BaseModel,
    shoot: Callable[[str | None], PoseRecord],
) -> PoseBody:
    """The pose as it was when it was made, so that a repeated request gets the same answer."""
    register = service.calibrations.register
    cameras = register.get(calibration_id).cameras
    path = f"/calibration/{calibration_id}/{what}"
    job = started_once(service.keys, service.store, key, path, request, lambda key: shoot(key).id)
    body = pose_body(calibration_id, pose_of(job), cameras)
    response.headers["Location"] = body.links.self
    return body


def observed_boards(
    service: Service, session_id: UUID, numbers: Sequence[int] | None
) -> tuple[list[PoseObservation], Board, Calibration]:
    """Observations of poses of a session, None for all that were accepted, their board, and the calibration in use.

    Raises CalibrationNotFoundError; ConfigError: there are no such poses; CalibrationStateError: none is in use.
    """
    record = service.calibrations.register.get(session_id)
    board, (_, _, calibration) = setting_of(record).board, service.health.health()
    if calibration is None:
        message = "The rig has no calibration in use, by which poses of a board are known. Activate one first."
        raise CalibrationStateError(message)
    readings = session_readings(service.calibrations.store.folder(record.id))
    accepted = dict(zip([pose.number for pose in record.accepted], readings, strict=True))
    numbers = list(accepted) if numbers is None else numbers
    if not set(numbers) <= set(accepted) or len(set(numbers)) < len(numbers):
        message = f"poses: expected accepted poses of calibration {record.id}, each once, found {numbers}; there are "
        raise ConfigError(message + (", ".join(map(str, accepted)) or "none"))
    return [accepted[number].observation for number in numbers], board, calibration


@router.get("/{calibration_id}/pose/{number}")
def look_at_pose(service: Serving, calibration_id: UUID, number: int) -> PoseBody:
    """Return a pose: its state, and its findings, or why it was refused and what to do."""
    register = service.calibrations.register
    pose = register.pose(calibration_id, number)
    return pose_body(calibration_id, pose, register.get(calibration_id).cameras)


@router.post("/{calibration_id}/pose/{number}/cancel", status_code=202)
def cancel_pose(service: Serving, calibration_id: UUID, number: int) -> PoseBody:
    """Request the early end of a pose, and of the script that it is part of. May be repeated."""
    pose = service.calibrations.cancel(calibration_id, number)
    return pose_body(calibration_id, pose, service.calibrations.register.get(calibration_id).cameras)


@router.delete("/{calibration_id}/pose/{number}", status_code=204, responses=problems(409, 507))
def drop_pose(service: Serving, calibration_id: UUID, number: int) -> None:
    """Drop a pose with its frames. The next solve does without it."""
    service.calibrations.drop(calibration_id, number)


@router.post("/{calibration_id}/solve", status_code=202, responses=problems(409, 507))
def solve_calibration(
    service: Serving, calibration_id: UUID, request: Annotated[SolveRequest, Body(default_factory=SolveRequest)]
) -> CalibrationBody:
    """Solve the calibration from its accepted poses. The answer comes at once; `progress` shows how far it is."""
    shape, measured_mm = request.board_shape, request.measured_mm
    return _answered(service, service.calibrations.solve(calibration_id, board_shape=shape, measured_mm=measured_mm))


@router.post("/{calibration_id}/activate", responses=problems(409, 507))
def activate_calibration(service: Serving, calibration_id: UUID) -> CalibrationBody:
    """Use this calibration for further scans in place of the rig's own, after a restart too."""
    return _answered(service, service.calibrations.activate(calibration_id))


@router.post("/{calibration_id}/deactivate", responses=problems(409, 507))
def deactivate_calibration(service: Serving, calibration_id: UUID) -> CalibrationBody:
    """Use the rig's own calibration for further scans again."""
    return _answered(service, service.calibrations.deactivate(calibration_id))


@router.put("/{calibration_id}/pin", responses=problems(507))
def pin_calibration(service: Serving, calibration_id: UUID) -> CalibrationBody:
    """Keep a calibration, also where the settings remove old ones. DELETE ends that."""
    return _answered(service, service.calibrations.pin(calibration_id, pinned=True))


@router.delete("/{calibration_id}/pin", responses=problems(507))
def unpin_calibration(service: Serving, calibration_id: UUID) -> CalibrationBody:
    """Allow the removal of a calibration when it is old, where the settings say so."""
    return _answered(service, service.calibrations.pin(calibration_id, pinned=False))


@router.delete("/{calibration_id}", status_code=204, responses=problems(409, 507))
def delete_calibration(service: Serving, calibration_id: UUID) -> None:
    """Delete a calibration with all its poses. The one in use is refused."""
    service.calibrations.delete(calibration_id)


def _serve(name: str, media_type: str) -> Callable[..., Awaitable[Response]]:
    async def fetch(service: Serving, calibration_id: UUID) -> Response:
        export = partial(service.calibrations.exported, calibration_id, name)
        content = await service.makings.of((calibration_id, name), export)
        # Another solve of the same session gives another file.
        headers = {"Content-Disposition": f'inline; filename="{name}"', "Cache-Control": "no-store"}
        return Response(content, media_type=media_type, headers=headers)

    fetch.__doc__ = f"Return what the last solve gave, as {name}."
    return fetch


for _name, _media_type in zip(EXPORTS, ("application/json", "application/yaml", "application/xml"), strict=True):
    router.add_api_route(
        f"/{{calibration_id}}/{_name}",
        _serve(_name, _media_type),
        response_class=Response,
        responses=file_of(_media_type, 409, 503, 507),
        operation_id=f"fetch_{_name.replace('.', '_')}",
        summary=f"Fetch {_name}",
    )


@router.get(f"/{{calibration_id}}/{REPORT}", response_class=Response, responses=file_of("text/html", 409))
def fetch_calibration_report(service: Serving, calibration_id: UUID) -> Response:
    """Return the report of the last solve: one page that holds everything that it shows and runs no script."""
    path = service.calibrations.file(calibration_id, REPORT)
    # It loads nothing, and nothing in it may.
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    headers = {"Cache-Control": "no-store", "Content-Security-Policy": policy}
    return FileResponse(path, media_type="text/html", headers=headers)


@router.get("/{calibration_id}/pose/{number}/picture.png", response_class=Response, responses=file_of("image/png", 409))
def fetch_pose_picture(
    service: Serving,
    calibration_id: UUID,
    number: int,
    camera: Annotated[str | None, Query(pattern=CAMERA_NAME, description="Default: the first one")] = None,
) -> Response:
    """Return what a camera saw of a pose: its white frame, with the corners that were found. Refused poses have it."""
    calibrations = service.calibrations
    pose = calibrations.register.pose(calibration_id, number)
    cameras = calibrations.register.get(calibration_id).cameras
    chosen = next(iter(cameras), "") if camera is None else camera
    path = calibrations.store.pose(calibration_id, number) / picture_name(chosen)
    if cameras and chosen not in cameras:
        message = f"Calibration {calibration_id} has no camera '{chosen}'; it has {', '.join(cameras)}."
        raise CameraNotFoundError(message)
    if not service.folder.owns(path):
        message = f"{pose.name} of calibration {calibration_id} is {pose.state} and has no picture."
        raise ArtefactNotReadyError(message)
    service.folder.require_whole(path.parent, path.name)
    return FileResponse(path, media_type="image/png", headers={"Cache-Control": "private, no-cache"})


@router.get("/{calibration_id}/coverage.png", response_class=Response, responses=file_of("image/png", 409, 503))
async def fetch_coverage_picture(
    service: Serving,
    calibration_id: UUID,
    device: Annotated[
        str | None, Query(pattern=CAMERA_NAME, description="a camera, or projector. Default: the first camera")
    ] = None,
) -> Response:
    """Return a picture of a device's views of the board so far, and of the next position of the board."""
    draw = partial(service.calibrations.coverage_picture, calibration_id, device)
    content = await service.makings.of((calibration_id, "coverage", device), draw)
    return Response(content, media_type="image/png", headers={"Cache-Control": "no-store"})

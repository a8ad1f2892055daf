"""/rig, /device, /preview: devices and live pictures; examinations, health and verification, turntable."""

from __future__ import annotations

from collections.abc import AsyncIterator
from datetime import datetime
from functools import partial
from typing import Annotated, Any
from uuid import UUID

import cv2
import numpy as np
from fastapi import APIRouter, Body, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from starlette.responses import StreamingResponse

from slrig.api.calibration import BoardRequest, IfBusy, observed_boards
from slrig.api.events import Held
from slrig.api.files import require_whole
from slrig.api.problems import file_of, problems
from slrig.api.schemas import (
    MOST_EXPOSURE_S,
    AnyFault,
    CalibrationInUse,
    CameraBody,
    JobBody,
    ProjectorBody,
    RigBody,
    ScanRequest,
    filled,
    scan_plan,
)
from slrig.api.service import IdempotencyKey, Service, Serving, started_once
from slrig.bundle import (
    AwareMoment,
    AxisSource,
    Strict,
    TurntableEntry,
    TurntableRecord,
    turntable_entry,
    turntable_record,
)
from slrig.calibrate.job import AxisJob, turntable_axis
from slrig.calibrate.verification import VerificationJob, health_svg
from slrig.calibration import Board
from slrig.calibration.health import THRESHOLDS, DriftEstimate, HealthState, PairFigures, Thresholds
from slrig.capture.latency import DEFAULT_SEARCH_S, DEFAULT_TRIALS
from slrig.conformance import ConformanceJob
from slrig.devices import CameraInfo, FoundDevice, Trigger
from slrig.discovery import InstalledDriver, MissingLibrary, OtherSystem, installed_drivers
from slrig.doctor import DoctorJob, Examination, LatencyJob, last_examination
from slrig.errors import CalibrationError, ConfigError, ScanStateError, SlrigError
from slrig.jobs.job import Job
from slrig.jobs.manager import RigStatus
from slrig.jobs.records import RIG_JOBS, JobKind, JobRecord, JobState, utc_now
from slrig.jobs.worker import REQUEST_WAIT_S, Task
from slrig.model_jobs.job import turntable_planes
from slrig.model_jobs.turntable import TurntableState, state_of, turntable_svg
from slrig.rig.preview import LONGEST_S, Light, Watch
from slrig.rig.watchdog import SettingsInUse
from slrig.scan.artefacts import MESH

_BOUNDARY = "picture"
_WIDEST_PX = 1280
_QUALITY = 80
_SATURATED = 254
_TOO_DARK = 12
"""Grey levels of 255 in white light: four times the contrast below which a scan takes a pixel for unlit."""
_RED, _BLUE = (32, 32, 224), (224, 80, 32)
_WAIT_S = 0.5
"""Longest wait for a picture on a thread; then the connection to the client is checked."""

_FRESH_S = 5.0
"""Largest age of the result of a search for devices."""

router = APIRouter(tags=["rig"])

_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": f"JPEG pictures, each a part of a multipart body (boundary `{_BOUNDARY}`), 8 bits of grey, at "
        f"most {_WIDEST_PX} px wide and 15 a second. While a scan holds the rig no pictures come; afterwards they go "
        "on. The stream ends when the camera fails.",
        "content": {f"multipart/x-mixed-replace; boundary={_BOUNDARY}": {"schema": {"type": "string"}}},
    }
}


@router.get("/rig")
def look_at_rig(service: Serving) -> RigBody:
    """Return the rig: its devices, its holder, and how many scans wait. Touches no device."""
    status = service.manager.status()
    facts, settings = status.facts, service.manager.rig.settings
    return filled(
        RigBody,
        status,
        name=status.rig,
        open=facts is not None and status.fault is None,
        error=status.fault,
        calibrated=None if facts is None else (status.active is not None or facts.calibration is not None),
        calibration=_in_use(service, status),
        positions=[] if facts is None else facts.positions,
        turntable=facts is not None and facts.turntable,
        cameras=[] if facts is None else [_camera(*each, settings.get(each[0])) for each in facts.cameras.items()],
        lost_cameras={} if facts is None else facts.lost,
        projector=None if facts is None else filled(ProjectorBody, facts.projector, size_px=facts.projector.size),
        scan_defaults=service.scan_defaults.model_dump(exclude_none=True),
        fleet=service.copier is not None,
    )


class DeviceList(BaseModel):
    """Installed drivers, connected devices, and missing parts."""

    drivers: tuple[InstalledDriver, ...]
    devices: tuple[FoundDevice, ...]
    missing: tuple[MissingLibrary, ...]
    elsewhere: tuple[OtherSystem, ...]
    faults: list[str]


@router.get("/device", responses=problems(409))
async def list_devices(service: Serving) -> DeviceList:
    """Return the drivers that are installed, the devices that are plugged in, and the libraries that are missing. While
    the rig is held, those that were plugged in before.
    """
    return await service.probes.of("devices", partial(_devices, service), fresh_s=_FRESH_S)


def _devices(service: Service) -> DeviceList:
    found = service.devices.found(service.manager.status().holder)
    return filled(DeviceList, found, drivers=installed_drivers(), faults=[str(fault) for fault in found.faults])


def _in_use(service: Service, status: RigStatus) -> CalibrationInUse | None:
    active, facts = status.active, status.facts
    calibration = active.calibration if active is not None else None if facts is None else facts.calibration
    if calibration is None:
        return None
    solved = calibration.solved
    solved_at = None if solved is None else datetime.fromisoformat(solved.solved_at)
    return CalibrationInUse(
        source="rig" if active is None else "session",
        id=None if active is None else UUID(active.name),
        solve=None if solved is None else solved.id,
        solved_at=solved_at,
        age_s=None if solved_at is None else round((utc_now() - solved_at).total_seconds(), 1),
        expected_error_mm=service.health.error_mm(calibration),
        error=status.misfit,
    )


def _camera(name: str, camera: CameraInfo, settings: SettingsInUse | None) -> CameraBody:
    form, applied = camera.format, None if settings is None else settings.applied
    return filled(
        CameraBody,
        camera,
        name=name,
        size_px=form.size,
        bit_depth=form.bit_depth,
        triggers=sorted(camera.triggers),
        exposure_s=None if applied is None else applied.exposure_s,
        gain=None if applied is None else applied.gain,
        notes=[*camera.notes, *(() if settings is None else settings.notes)],
    )


@router.get("/preview/{camera}", response_class=Response, responses={**_STREAM, **problems(409, 429, 502, 503)})
async def look_through_camera(
    held: Held,
    service: Serving,
    camera: Annotated[str, Path(max_length=64, description="name of a camera of the rig")],
    light: Annotated[Light, Query(description="what the projector does meanwhile: dark, or all white")] = Light.OFF,
    marks: Annotated[
        bool, Query(description="saturated pixels in red, and in white light in blue those that are too dark")
    ] = False,
    exposure_s: Annotated[
        float | None,
        Query(
            gt=0,
            le=LONGEST_S,
            description="exposure of the live picture, or the nearest that the camera can take. All viewers of the "
            "camera get the last one requested; scans keep their own. "
            "Default: the rig file's",
        ),
    ] = None,
) -> Response:
    """Preview of a camera: an `img` element shows it. Scans go first; pictures wait while one holds the rig."""
    held.enter_context(service.streams.take())
    watch = await run_in_threadpool(service.manager.watch, camera, light, exposure_s)
    return StreamingResponse(
        _parts(watch, marked=marks),
        media_type=f"multipart/x-mixed-replace; boundary={_BOUNDARY}",
        headers={"Cache-Control": "no-store"},
    )


async def _parts(watch: Watch, *, marked: bool) -> AsyncIterator[bytes]:
    number, lit = 0, watch.light is Light.WHITE
    make = partial(_shown, marked=marked, lit=lit)
    with watch:
        while True:
            try:
                picture = await run_in_threadpool(watch.picture, number, _WAIT_S)
            except SlrigError:
                # The answer has begun: all that is left is to end it. `/rig` says why.
                return
            if picture is None:
                # An empty line between parts: it reveals clients that have gone.
                yield b"\r\n"
                continue
            number = picture.number
            jpeg = await run_in_threadpool(picture.made, (marked, lit), make)
            head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            yield head.encode() + jpeg + b"\r\n"


def _shown(image: NDArray[np.uint8], *, marked: bool, lit: bool) -> bytes:
    return encoded(marked_picture(image, lit=lit) if marked else image)


def marked_picture(image: NDArray[np.uint8], *, lit: bool) -> NDArray[np.uint8]:
    """A grey image (H, W) as (H, W, 3), blue, green, red: saturated pixels are red, and too dark ones, if lit, blue."""
    picture = np.repeat(image[:, :, None], 3, axis=2)
    picture[image >= _SATURATED] = _RED
    if lit:
        picture[image < _TOO_DARK] = _BLUE
    return picture


def encoded(image: NDArray[np.uint8]) -> bytes:
    """A JPEG of an image (H, W) or (H, W, 3) uint8, at most `_WIDEST_PX` wide."""
    height, width = image.shape[:2]
    if width > _WIDEST_PX:
        image = np.asarray(
            cv2.resize(image, (_WIDEST_PX, max(round(height * _WIDEST_PX / width), 1)), interpolation=cv2.INTER_AREA)
        )
    made, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not made:
        message = f"a picture of {width} x {height} could not be encoded as JPEG"
        raise ValueError(message)
    return jpeg.tobytes()


examination_router = APIRouter(prefix="/rig", tags=["rig"])

SearchSeconds = Annotated[float, Field(ge=0.01, le=10, description="longest latency to search for, seconds")]


class ExaminationBody(JobBody):
    """An examination on record."""

    summary: dict[str, Any] | None = Field(description="what it found, as the command prints it with --json")
    links: dict[str, str]


class ExaminationRequest(Strict):
    """An examination of the rig in its present state, before a still object."""

    if_busy: IfBusy = Field(default="reject", description="while the rig is held: answer 409, or wait in line")


class DoctorRequest(ExaminationRequest):
    """An examination of light, timing, picture, response and flicker."""

    search_s: SearchSeconds = DEFAULT_SEARCH_S


class LatencyRequest(ExaminationRequest):
    """A measurement of how late the light is."""

    flashes: int = Field(default=DEFAULT_TRIALS, ge=8, le=1000, description="that each camera must see happen")
    search_s: SearchSeconds = DEFAULT_SEARCH_S
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None
    trigger: Annotated[Trigger, Field(strict=False)] | None = Field(
        default=None, description="how exposures are started. Default: free where a camera can"
    )


class Examinations(BaseModel):
    """The last examination of each kind; null where there was none."""

    doctor: Examination | None
    latency: Examination | None
    conformance: Examination | None


@examination_router.get("/examinations")
def list_examinations(service: Serving) -> Examinations:
    """Return what each examination found last on this rig. Touches no device."""
    root, rig = service.folder.root, service.manager.rig.name
    return Examinations(**{name: last_examination(root, name, rig) for name in Examinations.model_fields})


@examination_router.post("/doctor", status_code=202, responses=problems(409, 429, 502, 503, 507))
def examine_rig(
    service: Serving,
    response: Response,
    request: Annotated[DoctorRequest, Body(default_factory=DoctorRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Examine the rig for faults of light, timing, focus and flicker. The answer comes at once; GET it later."""
    plan = scan_plan(ScanRequest(), service.scan_defaults)
    job = DoctorJob(plan.patterns, service.scan_defaults.exposure_s, request.search_s)
    return _started(service, response, job, request, idempotency_key)


@examination_router.post("/latency", status_code=202, responses=problems(409, 429, 502, 503, 507))
def measure_rig_latency(
    service: Serving,
    response: Response,
    request: Annotated[LatencyRequest, Body(default_factory=LatencyRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Flash the projector, and measure how late its light is and how each camera's shutter rolls."""
    job = LatencyJob(request.flashes, request.search_s, request.exposure_s, request.trigger)
    return _started(service, response, job, request, idempotency_key)


@examination_router.post("/conformance", status_code=202, responses=problems(409, 429, 502, 503, 507))
def check_conformance(
    service: Serving,
    response: Response,
    request: Annotated[ExaminationRequest, Body(default_factory=ExaminationRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Check that the rig's drivers keep their contract. The rig is closed and opened many times."""
    job = ConformanceJob(scan_plan(ScanRequest(), service.scan_defaults).patterns)
    return _started(service, response, job, request, idempotency_key)


@examination_router.get("/job/{job_id}")
def look_at_rig_job(service: Serving, job_id: UUID) -> ExaminationBody:
    """Return an examination: its state, and its findings, or why there are none."""
    return _examination(service.store.get(job_id, *RIG_JOBS))


@examination_router.post("/job/{job_id}/cancel", status_code=202)
def cancel_rig_job(service: Serving, job_id: UUID) -> ExaminationBody:
    """Request the early end of an examination. May be repeated."""
    return _examination(service.manager.cancel(service.store.get(job_id, *RIG_JOBS).id))


def _started(
    service: Service, response: Response, job: Job, request: ExaminationRequest, key: str | None
) -> ExaminationBody:
    def start(key: str | None) -> UUID:
        return service.manager.submit(job, wait=request.if_busy == "queue", key=key)[0].id

    body = _examination(started_once(service.keys, service.store, key, f"/rig/{job.kind}", request, start))
    response.headers["Location"] = body.links["self"]
    return body


def _examination(record: JobRecord) -> ExaminationBody:
    here = f"{record.kind.path}/{record.id}"
    links = {"self": here, "events": f"{here}/events", "cancel": f"{here}/cancel", "last": "/rig/examinations"}
    return filled(ExaminationBody, record, error=record.fault, links=links)


health_router = APIRouter(prefix="/rig", tags=["health"])


class VerificationFigures(BaseModel):
    """Findings of one verification."""

    id: UUID
    at: datetime
    calibration: str
    kind: str = Field(description="board or scan")
    state: HealthState
    reasons: list[str]
    remedy: str | None
    pairs: list[PairFigures]
    scale_percent: float | None
    scale_sigma_percent: float | None
    scale_mm: float | None
    expected_mm: float | None = Field(description="error of a scanned point then, without the board's size")
    stated_mm: float | None = Field(description="the same after the calibration: the size would hide a change")
    drift_mm: float | None = Field(description="by how much the likeliest change moves a point; 0 where none is likely")
    drifts: list[DriftEstimate]
    open: str | None = Field(description="what the geometry leaves open")
    unseen: list[str] = Field(description="devices that took no part, of which nothing was learned")


class HealthBody(BaseModel):
    """The health of the calibration in use."""

    state: HealthState
    reasons: list[str]
    remedy: str | None
    calibration: str | None
    calibration_age_s: float | None
    expected_error_mm: float | None = Field(
        description="of a scanned point now, a standard deviation: that of the solve, the board's size included, and "
        "what changed since; null if the calibration says nothing of its own error"
    )
    refuses_scans_when_stale: bool
    thresholds: Thresholds
    latest: VerificationFigures | None
    links: dict[str, str]


class HealthPage(BaseModel):
    """Verifications, newest first."""

    verifications: list[VerificationFigures]


class VerificationRequest(Strict):
    """A verification. An empty request shoots the board of the calibration in use, where it is."""

    board: BoardRequest | None = Field(default=None, description="Default: that of the active calibration")
    position: Annotated[int, Field(ge=0, le=10_000)] | None = Field(
        default=None, description="of the positioner, by its number from 0. Default: the board stays where it is"
    )
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None
    if_busy: IfBusy = Field(default="reject", description="while the rig is held: answer 409, or wait in line")


class VerificationBody(BaseModel):
    """A requested verification."""

    id: UUID
    state: JobState
    created_at: datetime
    found: VerificationFigures | None
    error: AnyFault
    links: dict[str, str]


@health_router.get("/health")
def look_at_health(service: Serving) -> HealthBody:
    """Return whether the calibration in use still holds, the reasons, and the remedy. Touches no device."""
    health, latest, calibration = service.health.health()
    solved = None if calibration is None else calibration.solved
    age_s = None if solved is None else (utc_now() - datetime.fromisoformat(solved.solved_at)).total_seconds()
    return filled(
        HealthBody,
        health,
        calibration=None if calibration is None else calibration.solve_id,
        calibration_age_s=age_s,
        expected_error_mm=None if calibration is None else service.health.error_mm(calibration),
        refuses_scans_when_stale=service.refuse_when_stale,
        thresholds=THRESHOLDS,
        latest=None if latest is None else VerificationFigures.model_validate(latest.document()),
        links={"history": "/rig/health/history", "plot": "/rig/health.svg", "verify": "/rig/verification"},
    )


@health_router.get("/health/history")
def list_health(
    service: Serving,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    since: Annotated[AwareMoment | None, Query(description="ISO 8601, with its offset from UTC")] = None,
) -> HealthPage:
    """List verifications, newest first."""
    found = service.health.store.history(limit=limit, since=since)
    return HealthPage(verifications=[VerificationFigures.model_validate(record.document()) for record in found])


@health_router.get(
    "/health.svg",
    response_class=Response,
    responses=file_of("image/svg+xml"),
)
def plot_health(service: Serving, limit: Annotated[int, Query(ge=1, le=2000)] = 500) -> Response:
    """Draw the newest verifications over time."""
    records = service.health.store.history(limit=limit)
    return Response(health_svg(records[::-1]), media_type="image/svg+xml")


@health_router.post("/verification", status_code=202, responses=problems(409, 429, 502, 503, 507))
def verify_rig(
    service: Serving,
    response: Response,
    request: Annotated[VerificationRequest, Body(default_factory=VerificationRequest)],
    idempotency_key: IdempotencyKey = None,
) -> VerificationBody:
    """Shoot the board and judge the calibration in use by it. The answer comes at once; GET it later."""
    board = _board_in_use(service) if request.board is None else request.board.board()

    def start(key: str | None) -> UUID:
        job = VerificationJob(board, request.position, request.exposure_s)
        return service.manager.submit(job, wait=request.if_busy == "queue", key=key)[0].id

    body = _verification(
        started_once(service.keys, service.store, idempotency_key, "/rig/verification", request, start)
    )
    response.headers["Location"] = body.links["self"]
    return body


@health_router.get("/verification/{verification_id}")
def look_at_verification(service: Serving, verification_id: UUID) -> VerificationBody:
    """Return a verification: its state, and its findings, or why there are none."""
    return _verification(service.store.get(verification_id, JobKind.VERIFICATION))


@health_router.post("/verification/{verification_id}/cancel", status_code=202)
def cancel_verification(service: Serving, verification_id: UUID) -> VerificationBody:
    """Request the early end of a verification. May be repeated."""
    return _verification(service.manager.cancel(service.store.get(verification_id, JobKind.VERIFICATION).id))


def _board_in_use(service: Service) -> Board:
    """The board of the active calibration. Raises CalibrationError where there is none."""
    active = service.calibrations.active
    board = None if active is None else service.calibrations.register.get(active).board
    if board is None:
        message = (
            "board: the calibration in use was imported or is the rig's own, and its board is not known here; send "
            '"board" with the kind, corners and square_mm of the one that is in view'
        )
        raise CalibrationError(message)
    return board


def _verification(job: JobRecord) -> VerificationBody:
    here = f"/rig/verification/{job.id}"
    links = {"self": here, "events": f"{here}/events", "cancel": f"{here}/cancel", "health": "/rig/health"}
    return filled(VerificationBody, job, found=job.summary, error=job.fault, links=links)


turntable_router = APIRouter(prefix="/rig", tags=["turntable"])

_MOST_POSES = 100


class TurntableBody(BaseModel):
    """State of the turntable. `document` can be kept, and put back with PUT."""

    state: TurntableState
    own_axis: bool = Field(description="no axis was measured, and the rig's own is used")
    remedy: str = Field(description="what to do; empty where nothing is to be done")
    point_sigma_mm: float | None = Field(description="standard deviation of the axis' point across it")
    direction_sigma_deg: float | None = Field(description="the same of its direction")
    document: TurntableEntry
    links: dict[str, str]


class AxisRequest(Strict):
    """The axis from a session in which a board stood on the turntable, turned from pose to pose."""

    calibration: Annotated[UUID, Field(strict=False)] = Field(
        description="the session; it need not be solved, and need not be the calibration in use"
    )
    poses: Annotated[list[int], Field(max_length=_MOST_POSES)] | None = Field(
        default=None, description="their numbers. Default: all that were accepted"
    )
    angles_deg: Annotated[list[float], Field(max_length=_MOST_POSES)] | None = Field(
        default=None, description="where the turntable says that it stood, pose by pose. Default: not known"
    )


class AxisShootRequest(ExaminationRequest):
    """The axis from a board on the turntable, which is turned from shot to shot."""

    board: BoardRequest | None = Field(default=None, description="Default: that of the active calibration")
    first_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=-50.0, description="angle of the first shot, from the turntable's position when it is opened"
    )
    step_deg: Annotated[float, Field(gt=0, le=180)] = 20.0
    count: Annotated[int, Field(ge=3, le=72)] = Field(
        default=6, description="shots; cameras must see the board in them"
    )
    exposure_s: Annotated[float, Field(gt=0, le=MOST_EXPOSURE_S)] | None = None


class PlanesRequest(Strict):
    """The planes from a scan of the turntable with nothing on it."""

    scan: Annotated[UUID, Field(strict=False)]


class TurntablePose(BaseModel):
    """A pose of the board. error_deg : of the turntable's angle, null where it is unknown."""

    name: str
    residual_mm: float = Field(description="rms distance of the board's corners from where a pure turn puts them")
    angle_deg: float
    error_deg: float | None


class AxisBody(TurntableBody):
    """The calibrated axis, and its poses."""

    poses: list[TurntablePose]


@turntable_router.get("/turntable")
def get_turntable(service: Serving) -> TurntableBody:
    """Return the axis of the turntable, its planes, how the axis came to be, and whether it still holds."""
    return _turntable(service, service.turntable.record())


@turntable_router.get("/turntable.svg", response_class=Response, responses=file_of("image/svg+xml"))
def plot_turntable(service: Serving) -> Response:
    """Draw how the axis has moved."""
    return Response(turntable_svg(service.turntable.record().history), media_type="image/svg+xml")


@turntable_router.post("/turntable/axis", responses=problems(404, 409, 503, 507))
def calibrate_turntable(service: Serving, request: Annotated[AxisRequest, Body()]) -> AxisBody:
    """Calibrate the axis from poses of a board on the turntable, by the calibration in use."""
    observed = observed_boards(service, request.calibration, request.poses)
    if request.angles_deg is not None and len(request.angles_deg) != len(observed[0]):
        message = f"angles_deg: expected one for each of {len(observed[0])} poses, found {len(request.angles_deg)}"
        raise ConfigError(message)
    task = Task(turntable_axis, (*observed, request.angles_deg), what="axis of the turntable")
    found = service.worker.run(task, within_s=REQUEST_WAIT_S)
    of = str(request.calibration)
    turntable = service.turntable.put_axis(found.axis.measured_axis, source=AxisSource.BOARD, of=of)
    poses = [
        TurntablePose(
            name=name, residual_mm=left, angle_deg=found.angles_deg[name], error_deg=found.errors_deg.get(name)
        )
        for name, left in found.residual_mm.items()
    ]
    return AxisBody(**dict(_turntable(service, turntable)), poses=poses)


@turntable_router.post("/turntable/shoot", status_code=202, responses=problems(409, 429, 502, 503, 507))
def shoot_axis(
    service: Serving,
    response: Response,
    request: Annotated[AxisShootRequest, Body(default_factory=AxisShootRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ExaminationBody:
    """Shoot a board on the turntable at several angles, and measure the axis, by the calibration in use. The answer
    comes at once; GET it later.
    """
    board = _board_in_use(service) if request.board is None else request.board.board()
    job = AxisJob(board, request.first_deg, request.step_deg, request.count, request.exposure_s)
    return _started(service, response, job, request, idempotency_key)


@turntable_router.post("/turntable/planes", responses=problems(404, 409, 503, 507))
def find_planes(service: Serving, request: Annotated[PlanesRequest, Body()]) -> TurntableBody:
    """Find plate and backdrops in a scan of the empty turntable. Views of models are cut by them from then on."""
    scan, mesh = service.store.get(request.scan, JobKind.SCAN), service.folder.scan(request.scan) / MESH
    if scan.state is not JobState.SUCCEEDED or not service.folder.owns(mesh):
        message = (
            f"Scan {request.scan} is {scan.state} and has no {MESH} here. Scan the empty turntable, and wait for it."
        )
        raise ScanStateError(message)
    require_whole(service, scan, mesh.parent, MESH)
    found = service.worker.run(
        Task(turntable_planes, (mesh, service.turntable.axis()), what="planes of the turntable"),
        within_s=REQUEST_WAIT_S,
    )
    return _turntable(service, service.turntable.put_planes(found))


@turntable_router.put("/turntable", responses=problems(507))
def replace_turntable(service: Serving, request: Annotated[TurntableEntry, Body()]) -> TurntableBody:
    """Put back a document that was kept, in place of all that is known."""
    return _turntable(service, service.turntable.replace(turntable_record(request)))


@turntable_router.delete("/turntable", status_code=204, responses=problems(507))
def delete_turntable(service: Serving) -> None:
    """Forget axis, planes and history, a damaged record too."""
    service.turntable.delete()


def _turntable(service: Service, record: TurntableRecord) -> TurntableBody:
    axis, own = record.axis, service.manager.rig.axis
    state, remedy = state_of(record, own)
    return TurntableBody(
        state=state,
        own_axis=axis is None and own is not None,
        remedy=remedy,
        point_sigma_mm=None if axis is None else axis.point_sigma_mm,
        direction_sigma_deg=None if axis is None else float(np.rad2deg(axis.direction_sigma_rad)),
        document=turntable_entry(record),
        links={
            "self": "/rig/turntable",
            "plot": "/rig/turntable.svg",
            "axis": "/rig/turntable/axis",
            "planes": "/rig/turntable/planes",
        },
    )

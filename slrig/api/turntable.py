"""/rig/turntable: the axis of the turntable, calibrated from a board and improved by models, and the planes behind
it.
"""

from __future__ import annotations

from typing import Annotated
from uuid import UUID

import numpy as np
from fastapi import APIRouter, Body, Response
from pydantic import BaseModel, Field

from slrig.api.openapi import file_of, problems
from slrig.api.service import Serving
from slrig.bundle import AxisSource, Strict, TurntableEntry, TurntableRecord, turntable_entry, turntable_record
from slrig.calibrate.jobs import turntable_axis
from slrig.calibrate.records import setting_of
from slrig.calibrate.store import session_readings
from slrig.combine.job import turntable_planes
from slrig.combine.turntable import TurntableState, state_of
from slrig.combine.turntable_plot import turntable_svg
from slrig.errors import CalibrationStateError, ConfigError, ScanStateError
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.worker_process import Task
from slrig.scan.artefacts import MESH

router = APIRouter(prefix="/rig", tags=["turntable"])

_MOST_POSES = 100


class TurntableBody(BaseModel):
    """What is known of the turntable. `document` can be kept, and put back with PUT."""

    state: TurntableState
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


class PlanesRequest(Strict):
    """The planes from a scan of the turntable with nothing on it."""

    scan: Annotated[UUID, Field(strict=False)]


class TurntablePose(BaseModel):
    """A pose of the board. error_deg : of the turntable's angle, null where it was not told."""

    name: str
    residual_mm: float = Field(description="rms distance of the board's corners from where a pure turn puts them")
    angle_deg: float
    error_deg: float | None


class AxisBody(TurntableBody):
    """The axis that was calibrated, and the poses that tell it."""

    poses: list[TurntablePose]


@router.get("/turntable")
def get_turntable(service: Serving) -> TurntableBody:
    """Return the axis of the turntable, its planes, how the axis came to be, and whether it still holds."""
    return _body(service.turntable.record())


@router.get("/turntable.svg", response_class=Response, responses=file_of("image/svg+xml"))
def plot_turntable(service: Serving) -> Response:
    """Draw how the axis has moved."""
    return Response(turntable_svg(service.turntable.record().history), media_type="image/svg+xml")


@router.post("/turntable/axis", responses=problems(404, 409, 503, 507))
def calibrate_turntable(service: Serving, request: Annotated[AxisRequest, Body()]) -> AxisBody:
    """Calibrate the axis from poses of a board that stood on the turntable, by the calibration in use."""
    record = service.calibrations.register.get(request.calibration)
    board, (_, _, calibration) = setting_of(record).board, service.health.health()
    if calibration is None:
        message = "The rig has no calibration in use, by which poses of a board tell an axis. Activate one first."
        raise CalibrationStateError(message)
    numbers_of = [pose.number for pose in record.accepted]
    readings = session_readings(service.calibrations.store.folder(record.id))
    accepted = dict(zip(numbers_of, readings, strict=True))
    numbers = numbers_of if request.poses is None else request.poses
    missing = [str(number) for number in numbers if number not in accepted]
    if missing or len(set(numbers)) < len(numbers):
        message = f"poses: expected accepted poses of calibration {record.id}, each once, found {numbers}; there are "
        raise ConfigError(message + (", ".join(map(str, accepted)) or "none"))
    if request.angles_deg is not None and len(request.angles_deg) != len(numbers):
        message = f"angles_deg: expected one for each of {len(numbers)} poses, found {len(request.angles_deg)}"
        raise ConfigError(message)
    observed = [accepted[number].observation for number in numbers]
    given = (observed, board, calibration, request.angles_deg)
    found = service.worker.run(Task(turntable_axis, given, what="axis of the turntable"))
    turntable = service.turntable.put_axis(found.axis.measured_axis, source=AxisSource.BOARD, of=str(record.id))
    poses = [
        TurntablePose(
            name=name, residual_mm=left, angle_deg=found.angles_deg[name], error_deg=found.errors_deg.get(name)
        )
        for name, left in found.residual_mm.items()
    ]
    return AxisBody(**dict(_body(turntable)), poses=poses)


@router.post("/turntable/planes", responses=problems(404, 409, 503, 507))
def find_planes(service: Serving, request: Annotated[PlanesRequest, Body()]) -> TurntableBody:
    """Find plate and backdrops in a scan of the empty turntable. Views of models are cut by them from then on."""
    scan, mesh = service.store.get(request.scan, JobKind.SCAN), service.folder.scan(request.scan) / MESH
    if scan.state is not JobState.SUCCEEDED or not service.folder.owns(mesh):
        message = (
            f"Scan {request.scan} is {scan.state} and has no {MESH} here. Scan the empty turntable, and wait for it."
        )
        raise ScanStateError(message)
    found = service.worker.run(Task(turntable_planes, (mesh, service.turntable.axis()), what="planes of the turntable"))
    return _body(service.turntable.put_planes(found))


@router.put("/turntable", responses=problems(507))
def replace_turntable(service: Serving, request: Annotated[TurntableEntry, Body()]) -> TurntableBody:
    """Put back a document that was kept, in place of all that is known."""
    return _body(service.turntable.replace(turntable_record(request)))


@router.delete("/turntable", status_code=204, responses=problems(507))
def delete_turntable(service: Serving) -> None:
    """Forget axis, planes and history, a damaged record too."""
    service.turntable.delete()


def _body(record: TurntableRecord) -> TurntableBody:
    state, remedy = state_of(record)
    axis = record.axis
    return TurntableBody(
        state=state,
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

"""/hand-eye: pose of the rig on or before a robot, by poses of a session; kept with the calibration in use."""

from __future__ import annotations

from typing import Annotated, Literal, Self
from uuid import UUID

from fastapi import APIRouter, Body
from pydantic import BaseModel, Field, model_validator

from slrig.api.calibration import observed_boards
from slrig.api.problems import problems
from slrig.api.service import Service, Serving
from slrig.bundle import CALIBRATION, FreeText, PoseEntry, Strict, read_calibration
from slrig.calibrate.hand_eye import (
    HandEyeDocument,
    HandEyeStore,
    ReadBoards,
    ScannedSpheres,
    checked_poses,
    solved_poses,
)
from slrig.errors import CalibrationError, CalibrationStateError
from slrig.jobs.data_folder import BUNDLE
from slrig.jobs.records import JobKind
from slrig.jobs.worker import REQUEST_WAIT_S, Task
from slrig.model import Calibration
from slrig.scan.artefacts import MESH

_MOST_POSES = 100

PATHS = ("/hand-eye", "/hand-eye/check")
MOST_BYTES = 2**18
"""Most of a request: 100 poses with all their digits; and of a document."""

router = APIRouter(prefix="/hand-eye", tags=["calibration"])


class RobotPose(Strict):
    """An observation of the rig, and the robot's pose."""

    pose: int | None = Field(default=None, description="its number in the session")
    scan: Annotated[UUID, Field(strict=False)] | None = Field(default=None, description="a scan of the sphere")
    robot_pose: PoseEntry = Field(description="of the flange in the robot's base, 4 x 4, mm")


class PosesRequest(Strict):
    """Poses of a session, or scans of a sphere, in which a robot moved these, or the rig."""

    calibration: Annotated[UUID, Field(strict=False)] | None = Field(
        default=None, description="the session; it need not be solved, and need not be the calibration in use"
    )
    sphere_mm: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=None, description="diameter of the sphere, in place of a session"
    )
    poses: Annotated[list[RobotPose], Field(min_length=1, max_length=_MOST_POSES)]

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        wanted = "pose" if self.sphere_mm is None else "scan"
        if (self.calibration is None) == (self.sphere_mm is None) or any(
            getattr(each, wanted) is None or None not in (each.pose, each.scan) for each in self.poses
        ):
            message = "expected calibration and the number `pose` of each, or sphere_mm and the id `scan` of each"
            raise ValueError(message)
        return self


class HandEyeRequest(PosesRequest):
    """Hand-eye calibration. 12 poses that turn by 30° about two axes are good."""

    kind: Literal["in-hand", "fixed"] = Field(
        description="in-hand: the rig is on the flange, the board lies still. fixed: the robot holds the board"
    )
    robot_sigma: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="noise of the robot's poses, mm and degrees. Default: estimated from the residuals"
    )
    base_frame: FreeText = Field(default="base_link", description="name of the robot's base, for ROS")
    flange_frame: FreeText = Field(default="tool0", description="name of what its poses are of, for ROS")


class DriftBody(BaseModel):
    """New poses against the hand-eye calibration."""

    holds: bool = Field(description="the residuals are within what is stated")
    probability: float = Field(description="of residuals as large by chance")
    shift_mm: float = Field(description="by how much the rig would have moved, if nothing else did")
    sigma_mm: float
    turn_deg: float
    sigma_deg: float
    residual_mm: list[float] = Field(description="by pose: distance of the board from where it should be")


def _in_use(service: Service) -> Calibration:
    _, _, calibration = service.health.health()
    if calibration is None:
        raise CalibrationStateError("The rig has no calibration in use, and thus no frame. Activate one first.")
    return calibration


def _store(service: Service) -> HandEyeStore:
    return HandEyeStore(service.folder.root)


def _observations(service: Service, request: PosesRequest) -> ReadBoards | ScannedSpheres:
    """Observations of the rig. Raises CalibrationNotFoundError, JobNotFoundError, ConfigError, CalibrationStateError;
    and CalibrationError: a scan is in the frame of another calibration than that in use.
    """
    if request.calibration is not None:
        numbers = [int(each.pose or 0) for each in request.poses]
        return ReadBoards(*observed_boards(service, request.calibration, numbers))
    own, scans = _in_use(service), {}
    for each in request.poses:
        record = service.store.get(UUID(str(each.scan)), JobKind.SCAN)
        folder = service.folder.scan(record.id)
        service.folder.require_whole(folder, MESH)
        of_scan = read_calibration(folder / BUNDLE / CALIBRATION).solve_id
        if of_scan != own.solve_id:
            message = f"scan {record.id} is of calibration {of_scan}, in use is {own.solve_id}: scan the sphere again"
            raise CalibrationError(message)
        scans[str(record.id)] = folder
    return ScannedSpheres(scans, float(request.sphere_mm or 0.0), own)


@router.get("", responses=problems(404, 409))
def get_hand_eye(service: Serving) -> HandEyeDocument:
    """Return the rig's pose, for the calibration in use."""
    return _store(service).get(_in_use(service).solve_id)


@router.put("", responses=problems(409, 507))
def put_hand_eye(service: Serving, document: Annotated[HandEyeDocument, Body()]) -> HandEyeDocument:
    """Keep a hand_eye.json, as `slrig calibrate hand-eye` writes it, for the calibration in use."""
    own = _in_use(service).solve_id
    if document.calibration != own:
        message = (
            f"calibration: expected {own}, which is in use, found {document.calibration}: the rig's frame is another "
            "one in each calibration. Activate that one, or solve hand-eye again"
        )
        raise CalibrationError(message)
    _store(service).put(document)
    return document


@router.delete("", status_code=204, responses=problems(409, 507))
def delete_hand_eye(service: Serving) -> None:
    """Delete the rig's pose. Idempotent."""
    _store(service).remove(_in_use(service).solve_id)


@router.post("", responses=problems(404, 409, 503, 507))
def solve_hand_eye(service: Serving, request: Annotated[HandEyeRequest, Body()]) -> HandEyeDocument:
    """Find the rig's pose from poses of a session or scans of a sphere, by the calibration in use, and keep it."""
    options = request.model_dump(include={"kind", "robot_sigma", "base_frame", "flange_frame"})
    given = _observations(service, request), [each.robot_pose for each in request.poses], options
    task = Task(solved_poses, given, what="hand-eye calibration")
    document: HandEyeDocument = service.worker.run(task, within_s=REQUEST_WAIT_S)
    _store(service).put(document)
    return document


@router.post("/check", responses=problems(404, 409, 503))
def check_hand_eye(service: Serving, request: Annotated[PosesRequest, Body()]) -> DriftBody:
    """Compare new poses of the same target, at its earlier place, with the kept result: did anything move?"""
    kept = _store(service).get(_in_use(service).solve_id)
    given = _observations(service, request), [each.robot_pose for each in request.poses], kept
    task = Task(checked_poses, given, what="check of hand-eye")
    return DriftBody(**service.worker.run(task, within_s=REQUEST_WAIT_S))


def rig_in_base(service: Service, robot_pose: PoseEntry | None, *, needed: bool) -> list[list[float]] | None:
    """The rig in the robot's base at a scan. None where it is not needed and not known.

    Raises CalibrationNotFoundError, CalibrationError: it is needed, and there is no hand-eye calibration for the
    calibration in use, or the rig is in hand and has no pose.
    """
    if not needed and robot_pose is None:
        return None
    found: list[list[float]] = _store(service).get(_in_use(service).solve_id).rig_in_base(robot_pose).tolist()
    return found

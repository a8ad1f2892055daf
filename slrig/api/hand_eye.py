"""/hand-eye: where the rig is on a robot or before it, by poses of a session; kept with the calibration in use."""

from __future__ import annotations

from typing import Annotated, Literal
from uuid import UUID

from fastapi import APIRouter, Body
from pydantic import BaseModel, Field

from slrig.api.calibration import observed_boards
from slrig.api.problems import problems
from slrig.api.service import Service, Serving
from slrig.bundle import FreeText, PoseEntry, Strict
from slrig.calibrate.hand_eye import HandEyeDocument, HandEyeStore, checked_poses, solved_poses
from slrig.errors import CalibrationError, CalibrationStateError
from slrig.jobs.worker import REQUEST_WAIT_S, Task
from slrig.model import Calibration

_MOST_POSES = 200

PATHS = ("/hand-eye", "/hand-eye/check")
MOST_BYTES = 2**18
"""Of a request: 200 poses with all their digits."""

router = APIRouter(prefix="/hand-eye", tags=["calibration"])


class RobotPose(Strict):
    """A pose of a session, and where the robot was."""

    pose: int = Field(description="its number in the session")
    robot_pose: PoseEntry = Field(description="of the flange in the robot's base, 4 x 4, mm")


class PosesRequest(Strict):
    """Poses of a session in which a robot moved the board, or the rig."""

    calibration: Annotated[UUID, Field(strict=False)] = Field(
        description="the session; it need not be solved, and need not be the calibration in use"
    )
    poses: Annotated[list[RobotPose], Field(min_length=1, max_length=_MOST_POSES)]


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
        raise CalibrationStateError("The rig has no calibration in use, in whose frame it is. Activate one first.")
    return calibration


def _store(service: Service) -> HandEyeStore:
    return HandEyeStore(service.folder.root)


@router.get("", responses=problems(404, 409))
def get_hand_eye(service: Serving) -> HandEyeDocument:
    """Return where the rig is, for the calibration in use."""
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
    """Forget where the rig is. Idempotent."""
    _store(service).remove(_in_use(service).solve_id)


@router.post("", responses=problems(404, 409, 503, 507))
def solve_hand_eye(service: Serving, request: Annotated[HandEyeRequest, Body()]) -> HandEyeDocument:
    """Find where the rig is from poses of a session, by the calibration in use, and keep it."""
    seen = observed_boards(service, request.calibration, [each.pose for each in request.poses])
    options = request.model_dump(include={"kind", "robot_sigma", "base_frame", "flange_frame"})
    task = Task(
        solved_poses, (*seen, [each.robot_pose for each in request.poses], options), what="hand-eye calibration"
    )
    document: HandEyeDocument = service.worker.run(task, within_s=REQUEST_WAIT_S)
    _store(service).put(document)
    return document


@router.post("/check", responses=problems(404, 409, 503))
def check_hand_eye(service: Serving, request: Annotated[PosesRequest, Body()]) -> DriftBody:
    """Hold new poses of the same board, at its place of then, against what is kept: did anything move?"""
    seen = observed_boards(service, request.calibration, [each.pose for each in request.poses])
    kept = _store(service).get(seen[2].solve_id)
    task = Task(checked_poses, (*seen, [each.robot_pose for each in request.poses], kept), what="check of hand-eye")
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

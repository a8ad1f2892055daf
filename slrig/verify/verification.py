"""A calibration verified by one pose of the board, and what its health means for a scan."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slrig.calibrate.tools import CapturePose
from slrig.calibration import Board
from slrig.calibration.health import Health, HealthState, Verification
from slrig.errors import CalibrationStateError, PoseRefusedError
from slrig.jobs.compute import Compute
from slrig.model import Calibration
from slrig.scan.acquisition import capture_frames
from slrig.verify.store import VerificationRecord

if TYPE_CHECKING:
    from slrig.calibrate.solving import ReadPose

_STILL_PX = 0.3


_READ, _JUDGE = "slrig.calibrate.pose_reading:read_pose", "slrig.calibration.health.verification:verify_by_board"


@dataclass(frozen=True, slots=True)
class VerificationTools:
    """The shot, the reading and the judgement. The mathematics is loaded when it is first used."""

    capture: CapturePose = capture_frames
    read: Callable[[Path, Board, str], ReadPose] = field(default_factory=lambda: _later(_READ))
    judge: Callable[[Sequence[Any], Board, Calibration], Verification] = field(default_factory=lambda: _later(_JUDGE))


def verification_tools(worker: Compute) -> VerificationTools:
    """Those of a service: the shot is taken here, the mathematics is the worker's."""
    return VerificationTools(read=worker.task(_READ, "reading of the board"), judge=worker.task(_JUDGE, "verification"))


def verify_bundle(
    folder: Path, board: Board, calibration: Calibration, /, *, tools: VerificationTools | None = None
) -> Verification:
    """Judge a calibration by a recorded pose of the board.

    Raises PoseRefusedError if the board is not to be seen, or moved while it was shot; CalibrationError if the
    calibration is of other cameras; BundleError, PatternError if the frames are no sound capture.
    """
    used = VerificationTools() if tools is None else tools
    pose = used.read(folder, board, folder.name)
    for name, figures in pose.figures.items():
        if figures.moved_px > _STILL_PX:
            lost = math.isinf(figures.moved_px)
            how = "is not in every frame" if lost else f"moved by {figures.moved_px:.2f} px while it was shot"
            message = (
                f"camera '{name}': the board {how}, and a movement of more than {_STILL_PX} px would be taken for "
                "a change of the rig; put it on a stand, and shoot it again"
            )
            raise PoseRefusedError(message)
    return used.judge([pose.observation], board, calibration)


def require_healthy(health: Health, *, refuse_when_stale: bool) -> None:
    """Refuse a scan with a stale calibration, if the rig file says so. Raises CalibrationStateError."""
    if refuse_when_stale and health.state is HealthState.STALE:
        message = (
            f"The calibration is stale, and this rig's file has scans refused then: {'; '.join(health.reasons)}. "
            f"What to do: {health.remedy or 'calibrate again'}. To scan all the same, set refuse_when_stale = false in "
            "the rig file."
        )
        raise CalibrationStateError(message)


def health_stamp(health: Health, latest: VerificationRecord | None) -> dict[str, Any]:
    """The section `health` of a scan's report: what the rig's health was when it was scanned."""
    return {
        "state": str(health.state),
        "reasons": list(health.reasons),
        "verified_at": None if latest is None else latest.at.isoformat(timespec="seconds"),
        "verification": None if latest is None else str(latest.id),
        "expected_error_mm": None if latest is None else latest.found.expected_mm,
    }


def _later(name: str) -> Callable[..., Any]:
    module, function = name.split(":")

    def call(*given: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(module), function)(*given, **options)

    return call

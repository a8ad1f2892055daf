"""What a calibration session works with: the shot, the reading, the judgement, the solve and its report.

They are named here rather than imported: the service loads the mathematics when the first session opens, and a test
puts tame ones in their place.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from slrig.calibration.board import Board, BoardShape
from slrig.calibration.solution import PROJECTOR
from slrig.devices import Rig
from slrig.model import Calibration, Size
from slrig.scan.acquisition import capture_bundle
from slrig.scan.plan import Progress, ScanPlan
from slrig.sessions.calibration.records import SessionRecord, plain
from slrig.sessions.calibration.solving import CalibrationResult, ReadPose
from slrig.sessions.calibration.store import CalibrationStore


@dataclass(frozen=True, slots=True)
class Setting:
    """What stands before the rig, and what the rig is: the board, and the extents of the devices.

    projector is None where only the cameras are calibrated.
    """

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None


@dataclass(frozen=True, slots=True)
class Standing:
    """Where a session stands: what its poses cover, and what to move next and why; JSON values."""

    coverage: Mapping[str, Any]
    next_move: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is told of a pose. refusals : why it cannot be used, in words; none if it can. answer : its figures, as JSON
    values. standing : where the session stands with it, None where it could not be read.
    """

    refusals: tuple[str, ...]
    answer: Mapping[str, Any]
    standing: Standing | None


class CapturePose(Protocol):
    """`slrig.scan.acquisition.capture_bundle`."""

    def __call__(
        self, rig: Rig, plan: ScanPlan, folder: Path, /, *, progress: Progress, cancelled: Callable[[], bool]
    ) -> None:
        """Play the patterns and write a complete bundle into `folder`."""
        ...


class SolvePoses(Protocol):
    """`slrig.sessions.calibration.solving.solve_poses`."""

    def __call__(
        self,
        board: Board,
        cameras: Mapping[str, Size],
        projector: Size | None,
        poses: Sequence[ReadPose],
        /,
        *,
        progress: Progress,
        earlier: Calibration | None = None,
        board_shape: BoardShape = BoardShape.AUTO,
    ) -> CalibrationResult:
        """Return the calibration. Raises SolveRefusedError."""
        ...


class WriteReport(Protocol):
    """Writes the report of a solve as a page of its own."""

    def __call__(
        self,
        path: Path,
        result: CalibrationResult,
        poses: Sequence[ReadPose],
        record: SessionRecord,
        store: CalibrationStore,
        /,
    ) -> None:
        """Write it."""
        ...


@dataclass(frozen=True, slots=True)
class CalibrationTools:
    """Each part of the work. The signatures are those of the functions that `calibration_tools` names."""

    capture: CapturePose
    read: Callable[[Path, Board, str], ReadPose]
    judge: Callable[[ReadPose, Sequence[ReadPose], Setting], Judgement]
    survey: Callable[[Sequence[ReadPose], Setting], Standing]
    picture: Callable[[Path, str, ReadPose | None, Board], bytes]
    coverage_picture: Callable[[Setting, str, Sequence[ReadPose], Mapping[str, Any]], bytes]
    solve: SolvePoses
    report: WriteReport
    summary: Callable[[CalibrationResult], Mapping[str, Any]] = plain
    warm: Callable[[], None] = lambda: None


def sizes_of(setting: Setting) -> Mapping[str, Size]:
    """The extents of the devices, the projector among them where there is one."""
    return setting.cameras if setting.projector is None else {**setting.cameras, PROJECTOR: setting.projector}


def calibration_tools() -> CalibrationTools:
    """The real ones. Loads the mathematics when they are first used, or by `warm`."""
    return CalibrationTools(
        capture=capture_bundle,
        read=_later("slrig.sessions.calibration.pose_reading:read_pose"),
        judge=_later("slrig.sessions.calibration.pose_judging:judgement"),
        survey=_later("slrig.sessions.calibration.pose_judging:standing"),
        picture=_later("slrig.sessions.calibration.pose_pictures:pose_png"),
        coverage_picture=_later("slrig.sessions.calibration.pose_pictures:coverage_png"),
        solve=_later("slrig.sessions.calibration.solving:solve_poses"),
        report=_later("slrig.sessions.calibration.pose_judging:write_report"),
        summary=_later("slrig.sessions.calibration.pose_judging:summary"),
        warm=_later("slrig.sessions.calibration.pose_judging:warm"),
    )


def _later(name: str) -> Callable[..., Any]:
    module, function = name.split(":")

    def call(*given: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(module), function)(*given, **options)

    return call

"""What a calibration session works with: the shot, the reading, the judgement, the solve and its report.

They are named here rather than imported: the worker does them, the service loads none of their mathematics, and a test
puts tame ones in their place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from slrig.calibrate.records import SessionRecord
from slrig.calibrate.solving import CalibrationResult, ReadPose
from slrig.calibration import PROJECTOR, Board
from slrig.calibration.accuracy import Comparison
from slrig.devices import Rig
from slrig.errors import CalibrationStateError
from slrig.jobs.compute import Compute
from slrig.jobs.rig_jobs import Recorded
from slrig.model import Calibration, Size
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ProgressCallback, ScanPlan


@dataclass(frozen=True, slots=True)
class Setting:
    """The board before the rig, and the extents of the devices; projector is None where only cameras are calibrated."""

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None

    @property
    def sizes(self) -> Mapping[str, Size]:
        """The extents of the devices, the projector among them where there is one."""
        return self.cameras if self.projector is None else {**self.cameras, PROJECTOR: self.projector}


def setting_of(record: SessionRecord) -> Setting:
    """The setting of a session. Raises CalibrationStateError for an imported calibration, which has no board."""
    if record.board is None:
        message = f"Calibration {record.id} was imported and has no board. Open a new one to shoot poses."
        raise CalibrationStateError(message)
    return Setting(record.board, record.cameras, record.projector)


@dataclass(frozen=True, slots=True)
class SessionGuidance:
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
    standing: SessionGuidance | None


class CapturePose(Protocol):
    """`slrig.scan.acquisition.capture_frames`."""

    def __call__(
        self, rig: Rig, plan: ScanPlan, folder: Path, /, *, progress: ProgressCallback, cancelled: Callable[[], bool]
    ) -> Recorded:
        """Play the patterns, and record a bundle for `folder`."""
        ...


@dataclass(frozen=True, slots=True)
class CalibrationTools:
    """Each part of the work. The signatures are those of the functions that `calibration_tools` names.

    parse : of a calibration's file that a stranger sent.
    """

    capture: CapturePose
    read: Callable[[Path, Board, str], ReadPose]
    judge: Callable[[ReadPose, Sequence[ReadPose], Setting], Judgement]
    survey: Callable[[Sequence[ReadPose], Setting], SessionGuidance]
    picture: Callable[[Path, str, ReadPose | None, Board], bytes]
    coverage_picture: Callable[[Setting, str, Sequence[ReadPose], Mapping[str, Any]], bytes]
    solve: Callable[..., CalibrationResult]
    report: Callable[[Path, CalibrationResult, Sequence[ReadPose], SessionRecord, Mapping[str, Path]], None]
    compare: Callable[[Calibration, Calibration], Comparison]
    parse: Callable[[Path], Calibration]
    summary: Callable[[CalibrationResult], Mapping[str, Any]]
    warm: Callable[[], None] = lambda: None


def calibration_tools(worker: Compute) -> CalibrationTools:
    """The real ones: the shot is taken here, the mathematics is the worker's."""
    room = "slrig.calibrate"
    return CalibrationTools(
        capture=capture_frames,
        read=worker.task(f"{room}.pose_reading:read_pose", "reading of the pose"),
        judge=worker.task(f"{room}.pose_judging:judgement", "judgement of the pose"),
        survey=worker.task(f"{room}.pose_judging:standing", "survey of the poses"),
        picture=worker.task(f"{room}.pose_pictures:pose_png", "picture of the pose"),
        coverage_picture=worker.task(f"{room}.pose_pictures:coverage_png", "picture of the coverage"),
        solve=worker.task(f"{room}.solving:solve_poses", "solve"),
        report=worker.task(f"{room}.pose_judging:write_report", "report of the solve"),
        summary=worker.task(f"{room}.pose_judging:summary", "summary of the solve"),
        compare=worker.task("slrig.calibration.accuracy:compare_calibrations", "comparison"),
        parse=worker.task("slrig.bundle.calibration:read_calibration", "reading of the calibration"),
        warm=worker.task(f"{room}.pose_judging:warm", "preparation"),
    )

"""Verification of a calibration by one pose of the board or by a scan: the job, the history of the rig's health, its
plot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar
from uuid import UUID, uuid4

import structlog
from markupsafe import Markup
from sqlalchemy import select
from sqlalchemy.orm import Session

from slrig.bundle import read_calibration, stored_json
from slrig.calibrate.store import USUAL_PATTERNS
from slrig.calibration import Board
from slrig.calibration.health import (
    THRESHOLDS,
    Health,
    HealthState,
    Thresholds,
    Verification,
    judge_health,
    scan_error_mm,
    verification_from_document,
    verification_from_scan,
)
from slrig.errors import CalibrationStateError, PoseRefusedError, UnsupportedByDeviceError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database, VerificationRow, readable
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.records import Clock, JobKind, utc_now
from slrig.model import Calibration
from slrig.reports.page import (
    END,
    GAP,
    GREEN,
    GREY,
    INK,
    LEFT,
    ORANGE,
    PALE,
    PANEL,
    RED,
    TOP,
    Panel,
    nothing_yet,
    shape,
    times,
    trend,
    x_of,
)
from slrig.rig.session import RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import REPORT
from slrig.scan.plan import ScanPlan, check_plan

_STILL_PX = 0.3
_TREND = 60
_KEPT = 20_000

_UNCALIBRATED = (
    "The rig has no calibration that could be verified. Calibrate it (POST /calibration) and activate the result; "
    "`slrig verify` takes the file of a calibration, too."
)

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class VerificationJob(Job):
    """One pose of the board, by which the calibration in use is judged. position : of the positioner, by its number;
    None leaves the board where it is.
    """

    kind: ClassVar[JobKind] = JobKind.VERIFICATION
    noun: ClassVar[str] = "verification"

    board: Board
    position: int | None = None
    exposure_s: float | None = None

    def check(self, rig: RigSession) -> int:
        """See `Job`.

        Raises CalibrationStateError if the rig has no calibration; UnsupportedByDeviceError if it has no positioner, or
        not that position; PatternError.
        """
        if rig.facts is None:
            return 0
        rig.refuse_misfit()
        if rig.calibration is None:
            raise CalibrationStateError(_UNCALIBRATED)
        if self.position is not None and not 0 <= self.position < len(rig.facts.positions):
            message = f"position: found {self.position}, this rig has {len(rig.facts.positions)} of them"
            raise UnsupportedByDeviceError(message)
        return check_plan(self._scan, rig.facts)

    def capture(self, rig: RigSession, run: JobRun) -> Recording:
        """Move the board to `position`, if any, and record a bundle with the calibration to verify."""
        opened = rig.open_whole()
        if self.position is not None and opened.positioner is not None:
            opened.positioner.move(self.position)
        # A verification must not use what a rendered rig knows of its scene.
        bare = replace(opened, head=None)
        return capture_frames(bare, self._scan, run.recording, run)

    def compute(self, run: JobRun) -> Outcome:
        """Read the board, and hold the calibration against it."""
        calibration = read_calibration(run.bundle / "calibration.json")
        found = verify_bundle(run.bundle, self.board, calibration)
        return Outcome({"calibration": calibration.solve_id, "found": found.document()})

    @property
    def _scan(self) -> ScanPlan:
        """The patterns of one pose."""
        return ScanPlan(patterns=USUAL_PATTERNS, exposure_s=self.exposure_s)


def verify_bundle(folder: Path, board: Board, calibration: Calibration) -> Verification:
    """Judge a calibration by a recorded pose of the board.

    Raises PoseRefusedError if the board is not visible, or moved while it was shot; CalibrationError if the calibration
    is of other cameras; BundleError, PatternError if the frames are not a sound capture.
    """
    # Late: the service knows these values, and loads no mathematics.
    from slrig.calibrate.pose_reading import read_pose
    from slrig.calibration.health.verification import verify_by_board

    pose = read_pose(folder, board, folder.name)
    for name, figures in pose.figures.items():
        if figures.moved_px > _STILL_PX:
            lost = math.isinf(figures.moved_px)
            how = "is not in every frame" if lost else f"moved by {figures.moved_px:.2f} px while it was shot"
            message = (
                f"camera '{name}': the board {how}, and a movement of more than {_STILL_PX} px would be taken for "
                "a change of the rig; put it on a stand, and shoot it again"
            )
            raise PoseRefusedError(message)
    return verify_by_board([pose.observation], board, calibration)


def require_healthy(health: Health, *, refuse_when_stale: bool) -> None:
    """Refuse a scan with a stale calibration, if the rig file says so. Raises CalibrationStateError."""
    if refuse_when_stale and health.state is HealthState.STALE:
        message = (
            f"The calibration is stale, and this rig's file has scans refused then: {'; '.join(health.reasons)}. "
            f"What to do: {health.remedy or 'calibrate again'}. To scan all the same, set refuse_when_stale = false in "
            "the rig file."
        )
        raise CalibrationStateError(message)


def health_stamp(
    health: Health, latest: VerificationRecord | None, *, calibration: str | None = None, error_mm: float | None = None
) -> dict[str, Any]:
    """The section `health` of a scan's report: what the rig's health was when it was scanned. error_mm : see
    `RigHealth.error_mm`.
    """
    return {
        "state": str(health.state),
        "reasons": list(health.reasons),
        "verified_at": None if latest is None else latest.at.isoformat(timespec="seconds"),
        "verification": None if latest is None else str(latest.id),
        "calibration": calibration,
        "expected_error_mm": error_mm,
    }


@dataclass(frozen=True, slots=True)
class VerificationRecord:
    """One verification on record. number : rises; calibration : the id of the solve, or a digest of the numbers.

    health : what was made of it and of those before it, at its time.
    """

    number: int
    id: UUID
    at: datetime
    calibration: str
    found: Verification
    health: Health

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "id": str(self.id),
            "at": self.at.astimezone(UTC).isoformat(timespec="milliseconds"),
            "calibration": self.calibration,
            "state": str(self.health.state),
            "reasons": list(self.health.reasons),
            "remedy": self.health.remedy,
            **self.found.document(),
        }


class HealthStore:
    """Verifications. Safe to call from any thread and from several processes."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def add(
        self, found: Verification, *, calibration: str, at: datetime, job_id: UUID | None = None
    ) -> VerificationRecord:
        """Judge a verification with those before it of its calibration, and put it on record. Raises StorageError.

        job_id : of its job; an earlier verification of that, as before a kill, stays.
        """
        with self.database.changing() as session:
            name = str(job_id or uuid4())
            earlier = session.scalar(select(VerificationRow).where(VerificationRow.id == name))
            if earlier is not None:
                return _record(earlier)
            newest = session.scalar(select(VerificationRow).order_by(VerificationRow.number.desc()).limit(1))
            query = select(VerificationRow).where(VerificationRow.calibration == calibration)
            # The first few too: a trend starts from them.
            first = list(session.scalars(query.order_by(VerificationRow.number).limit(3)))
            last = list(session.scalars(query.order_by(VerificationRow.number.desc()).limit(_TREND)))
            rows = {row.number: row for row in [*first, *reversed(last)]}
            health = judge_health([*(verification_from_document(rows[number].found) for number in sorted(rows)), found])
            row = VerificationRow(
                id=name, at=_stamp(at), calibration=calibration, kind=found.kind, state=str(health.state),
                reasons=list(health.reasons), remedy=health.remedy, found=found.document(),
            )  # fmt: skip
            session.add(row)
            session.flush()
            for old in session.scalars(select(VerificationRow).where(VerificationRow.number <= row.number - _KEPT)):
                session.delete(old)
            record = _record(row)
            self.added(session, None if newest is None else _record(newest), record)
            return record

    def added(self, session: Session, before: VerificationRecord | None, now: VerificationRecord) -> None:
        """Called in the transaction that puts a verification on record. before : the one before it, of any calibration.

        A subclass that sends notices overrides it.
        """

    def history(self, *, limit: int = 200, since: datetime | None = None) -> Sequence[VerificationRecord]:
        """Up to `limit` verifications, newest first, none older than `since`."""
        query = select(VerificationRow)
        if since is not None:
            query = query.where(VerificationRow.at >= _stamp(since))
        with self.database.reading() as session:
            rows = session.scalars(query.order_by(VerificationRow.number.desc()).limit(limit))
            return list(readable(rows, _record))

    def latest(self) -> VerificationRecord | None:
        """The newest verification; None where there is none."""
        return next(iter(self.history(limit=1)), None)

    def last_by_board(self, calibration: str) -> Verification | None:
        """The newest verification of a calibration with the board: a scan's states no error."""
        query = select(VerificationRow).where(VerificationRow.calibration == calibration)
        with self.database.reading() as session:
            board = query.where(VerificationRow.kind == "board").order_by(VerificationRow.number.desc()).limit(1)
            found = list(readable(session.scalars(board), _record))
        return found[0].found if found else None

    def since_calibration(self, calibration: str, *, limit: int = 1000) -> Sequence[VerificationRecord]:
        """The verifications of one calibration, oldest first; the newest `limit` of them."""
        query = select(VerificationRow).where(VerificationRow.calibration == calibration)
        with self.database.reading() as session:
            rows = session.scalars(query.order_by(VerificationRow.number.desc()).limit(limit))
            return [*readable(rows, _record)][::-1]

    def health_of(self, calibration: str) -> Health:
        """Health by the last verification of a calibration; unknown where there was none."""
        found = self.since_calibration(calibration, limit=1)
        return found[-1].health if found else judge_health([])


def _record(row: VerificationRow) -> VerificationRecord:
    health = Health(HealthState(row.state), tuple(row.reasons), row.remedy)
    found, at = verification_from_document(row.found), datetime.fromisoformat(row.at)
    return VerificationRecord(row.number, UUID(row.id), at, row.calibration, found, health)


def _stamp(moment: datetime) -> str:
    # One zone and one length: the texts sort as the moments do.
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")


class RigHealth:
    """Health of the calibration in use: see `Group`. It learns from verifications and scans. Any thread may call.

    store : the history. A verification's summary is `VerificationRecord.document` of what was found.
    """

    def __init__(self, rig: RigSession, store: HealthStore, data: DataFolder, *, clock: Clock = utc_now) -> None:
        self.store = store
        self._rig = rig
        self._data = data
        self._clock = clock
        # Scans carry it.
        rig.health = self.stamp

    def stamp(self) -> dict[str, Any] | None:
        """The health now, as a scan's report has it; None where nothing was verified yet."""
        health, latest, calibration = self.health()
        if latest is None or calibration is None:
            return None
        error_mm = self.error_mm(calibration)
        return health_stamp(health, latest, calibration=calibration.solve_id, error_mm=error_mm)

    def error_mm(self, calibration: Calibration) -> float | None:
        """The expected error of a scanned point with a calibration now: see `scan_error_mm`."""
        if calibration.solved is None:
            return None
        return scan_error_mm(calibration.solved, self.store.last_by_board(calibration.solve_id))

    def health(self) -> tuple[Health, VerificationRecord | None, Calibration | None]:
        """The health of the calibration in use, the verification that it rests on, and that calibration."""
        active, facts = self._rig.active, self._rig.facts
        calibration = active.calibration if active is not None else None if facts is None else facts.calibration
        if calibration is None:
            unknown = Health(HealthState.UNKNOWN, ("the rig has no calibration, or is not open yet",), "calibrate it")
            return unknown, None, None
        found = self.store.since_calibration(calibration.solve_id, limit=1)
        return self.store.health_of(calibration.solve_id), found[-1] if found else None, calibration

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """See `Group`."""
        if outcome is None or outcome.summary is None:
            return outcome or Outcome()
        if job.kind is JobKind.SCAN:
            try:
                self._note_scan(job_id, stored_json((self._data.scan(job_id) / REPORT).read_bytes()))
            except Exception:  # noqa: BLE001 - an error here must not fail the scan
                _log.exception("what a scan says of its calibration could not be noted")
            return outcome
        found, calibration = verification_from_document(outcome.summary["found"]), outcome.summary["calibration"]
        return Outcome(self.store.add(found, calibration=calibration, at=self._clock(), job_id=job_id).document())

    def _note_scan(self, scan_id: UUID, report: dict[str, Any]) -> None:
        _, _, calibration = self.health()
        found = verification_from_scan(report["redundancy"].get("residual_px") or ())
        if found is not None and calibration is not None:
            self.store.add(found, calibration=calibration.solve_id, at=self._clock(), job_id=scan_id)


HEIGHT = 470.0
_COLOURS = {HealthState.GOOD: GREEN, HealthState.WATCH: ORANGE, HealthState.STALE: RED, HealthState.UNKNOWN: GREY}
_LINES = ("#1c4e80", "#7a3e9d", "#00798c", "#8a5a00", "#5b6b1f", "#a3336b")

Records = Sequence[VerificationRecord]


def health_svg(records: Records, /, *, thresholds: Thresholds = THRESHOLDS) -> Markup:
    """The picture of verifications, oldest first. With none it says so."""
    if not records:
        return nothing_yet("Nothing was verified yet. POST /rig/verification shoots one.")
    second = TOP + PANEL + GAP
    parts = [
        *_errors(records, thresholds, TOP),
        *_residuals(records, thresholds, second),
        *_recalibrations(records, second + PANEL),
        *times(_moments(records), second + PANEL),
    ]
    title = f"health of the rig over {len(records)} verifications, now {records[-1].health.state}"
    return trend(title, HEIGHT, parts)


def _moments(records: Records) -> list[datetime]:
    return [record.at for record in records]


def _errors(records: Records, at: Thresholds, top: float) -> list[Markup]:
    # A calibration without an error of its own, and a scan, have none.
    errors = [record.found.error_ratio for record in records]
    known = [error for error in errors if error is not None]
    if not known:
        text = "No verification shows a change: they are of scans, or the calibration does not state its own error."
        return [shape("text", text, x=LEFT, y=top + 20)]
    panel = Panel(_moments(records), top, max(*known, 1.2 * at.watch_error_ratio), "Change since calibration")
    panel.limit(1.0, "as calibrated", _COLOURS[HealthState.UNKNOWN])
    for state, ratio in ((HealthState.WATCH, at.watch_error_ratio), (HealthState.STALE, at.stale_error_ratio)):
        panel.limit(ratio, f"{state}, {ratio:g} x", _COLOURS[state])
    panel.line(errors, PALE, of=[record.calibration for record in records])
    for record, error in zip(records, errors, strict=True):
        if error is not None:
            text = f"{record.health.state}. {'; '.join(record.health.reasons)}"
            panel.dot(record.at, error, _COLOURS[record.health.state], text)
    for number, state in enumerate((HealthState.GOOD, HealthState.WATCH, HealthState.STALE)):
        x = END - 190 + 64 * number
        panel.parts.append(shape("circle", cx=x, cy=top - 16, r=3.2, fill=_COLOURS[state]))
        panel.parts.append(shape("text", str(state), x=x + 8, y=top - 12))
    return panel.parts


def _residuals(records: Records, at: Thresholds, top: float) -> list[Markup]:
    all_pairs = [{(pair.first, pair.second): pair for pair in record.found.pairs} for record in records]
    known = [max(pair.rms_px, abs(pair.mean_px)) for pairs in all_pairs for pair in pairs.values()]
    panel = Panel(_moments(records), top, max([*known, 1.2 * at.watch_mean_px]), "Disagreement of two devices, px")
    panel.limit(at.watch_mean_px, "watch (mean)", _COLOURS[HealthState.WATCH])
    panel.limit(at.stale_mean_px, "stale (mean)", _COLOURS[HealthState.STALE])
    of = [record.calibration for record in records]
    for number, name in enumerate(dict.fromkeys(name for pairs in all_pairs for name in pairs)):
        colour, x = _LINES[number % len(_LINES)], LEFT + 256 + 130 * number
        panel.line([abs(pairs[name].mean_px) if name in pairs else None for pairs in all_pairs], colour, of=of)
        panel.line([pairs[name].rms_px if name in pairs else None for pairs in all_pairs], colour, of=of, wide=0.7)
        panel.parts.append(shape("path", d=f"M{x:.1f} {top - 16:.1f}h14", stroke=colour, stroke_width=2))
        panel.parts.append(shape("text", " - ".join(name), x=x + 18, y=top - 12))
    note = shape("text", "thick: mean, thin: rms", x=END, y=top + PANEL + 36, class_="faint end")
    return [*panel.parts, note]


def _recalibrations(records: Records, bottom: float) -> list[Markup]:
    parts = []
    for before, after in pairwise(records):
        if before.calibration != after.calibration:
            x = (x_of(_moments(records), before.at) + x_of(_moments(records), after.at)) / 2
            parts.append(shape("path", d=f"M{x:.1f} {TOP}V{bottom:.1f}", stroke=INK, stroke_dasharray="2 3"))
            parts.append(shape("text", "calibrated", x=x + 4, y=TOP + 12))
    return parts

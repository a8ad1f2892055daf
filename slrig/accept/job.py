"""Acceptance tests on a rig: opened, measured position by position or by script, evaluated and kept. No HTTP here."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar
from uuid import UUID, uuid4

import numpy as np

from slrig.accept.evaluation import AcceptanceResult, Reading, reading, verdicts
from slrig.accept.plan import AcceptancePlan, Artefact, Step, takes_of, turn_deg
from slrig.accept.store import (
    POSITIONS,
    READINGS,
    AcceptanceRecord,
    AcceptanceState,
    AcceptanceStore,
    keep_points,
    read_test,
    readings_json,
    with_jobs,
)
from slrig.bundle import CALIBRATION, read_calibration, write_calibration, write_file
from slrig.config import HeadTable, RigConfig
from slrig.devices import Rig
from slrig.disk import storage_errors
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    DeviceBusyError,
    InvalidInputError,
    JobNotFoundError,
    ScanStateError,
    UnsupportedByDeviceError,
    setting,
)
from slrig.jobs.data_folder import BUNDLE, DataFolder, write_entries
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.listener import Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Clock, Holder, JobKind, JobRecord, utc_now
from slrig.jobs.worker import Task
from slrig.model import Calibration, FloatArray
from slrig.rig.session import RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import MESH, decode_mesh_ply
from slrig.scan.plan import ReconstructionPlan, ScanPlan, check_plan


def bundle_name(step: Step, take: int) -> str:
    """The folder of a capture's frames."""
    return f"{step.name}-{take + 1}"


def capture_take(rig: Rig, plan: AcceptancePlan, bundle: Path, listener: Listener) -> None:
    """Record a bundle of the artefact before the rig. Raises CalibrationError, and as a scan."""
    calibration = required_calibration(rig)
    # The test must not use what a rendered rig knows of its scene; and the noise of a point, stated next to its form,
    # leaves out the calibration's own error, which the form shows.
    blind = replace(rig, head=None, calibration=replace(calibration, solved=None))
    scan = ScanPlan(exposure_s=plan.exposure_s)
    capture_frames(blind, scan, bundle, listener).finish()


def evaluated(
    bundle: Path, folder: Path, plan: AcceptancePlan, step: Step, take: int, listener: Listener, /
) -> Reading:
    """Reconstruct a bundle, measure the artefact in its mesh, and keep its points in `folder`."""
    # The process that owns the rig loads the mathematics only if it has to do it itself.
    from slrig.scan.reconstruct import reconstruct_bundle

    with TemporaryDirectory(dir=bundle.parent, prefix=".mesh-") as scratch:
        made = Path(scratch) / "mesh"
        reconstruct_bundle(bundle, made, listener, plan=ReconstructionPlan())
        with storage_errors(made):
            mesh = decode_mesh_ply((made / MESH).read_bytes())
    found, evidence = reading(mesh, step, take, plan)
    keep_points(evidence, folder, step.name, take)
    return found


def move_artefact(rig: Rig, plan: AcceptancePlan, step: Step) -> None:
    """Move the artefact of a step to its place by the rig's positioner, with poses of the steps' names.
    Raises UnsupportedByDeviceError if it does not know a position of the plan.
    """
    poses = () if rig.positioner is None else tuple(rig.positioner.poses)
    missing = [each.name for each in plan.steps if each.name not in poses]
    if missing or rig.positioner is None:
        has = f"a positioner with {', '.join(poses)}" if poses else "no positioner"
        message = (
            f"rig '{rig.name}' has {has}, and the test needs the positions {', '.join(missing)}; place the artefacts "
            f"manually (without {setting('scripted')}), or name the positioner's poses so"
        )
        raise UnsupportedByDeviceError(message)
    rig.positioner.move(poses.index(step.name))


def required_calibration(rig: Rig) -> Calibration:
    """The rig's calibration. Raises CalibrationError if it has none."""
    if rig.calibration is None:
        message = f"rig '{rig.name}' has no calibration, and nothing can be measured; calibrate it first"
        raise CalibrationError(message)
    return rig.calibration


SCENE = "acceptance-scene.toml"
_ALBEDO = 0.8
_BAR_SHARE = 0.25  # of a ball's radius: the rod between them
_ASIDE = 20.0  # diagonals of the volume: distance of artefacts that are not measured


def scripted_config(config: RigConfig, plan: AcceptancePlan, folder: Path) -> RigConfig:
    """The rig with the artefacts in place of its scene, which is written into `folder`, and a pose for every position.

    Raises UnsupportedByDeviceError if the rig's head has no scene, for it is not rendered then; StorageError.
    """
    if config.head is None or "scene" not in config.head.options:
        message = (
            f"rig '{config.name}' is not rendered and nothing moves its artefacts by script; leave "
            f"{setting('scripted')} out and place them manually"
        )
        raise UnsupportedByDeviceError(message)
    path = (folder / SCENE).resolve()
    with storage_errors(path):
        folder.mkdir(parents=True, exist_ok=True)
    write_file(path, scene_text(plan).encode())
    # A series of poses of a board that is not there any more would be refused.
    options = {key: value for key, value in config.head.model_dump().items() if key != "poses"}
    options |= {"scene": str(path), "pose": [_pose(step) for step in plan.steps]}
    return replace(config, head=HeadTable.model_validate(options))


def scene_text(plan: AcceptancePlan) -> str:
    """The scene file, in TOML: a sphere, a ball bar and a plane, each out of sight until a pose brings it."""
    artefacts = plan.artefacts
    aside = plan.volume_mm.mean(axis=0) + np.array([_ASIDE * plan.diagonal_mm, 0.0, 0.0])
    apart = np.array([0.0, 2 * plan.diagonal_mm, 0.0])
    radius = artefacts.ball_mm / 2
    objects = [
        _object(Artefact.SPHERE, "sphere", aside, f"radius_mm = {artefacts.diameter.value_mm / 2!r}"),
        _object(
            Artefact.BAR, "ball_bar", aside + apart,
            f"radius_mm = {radius!r}\ndistance_mm = {artefacts.distance.value_mm!r}\n"
            f"bar_radius_mm = {_BAR_SHARE * radius!r}",
        ),
        _object(Artefact.PLANE, "plane", aside - apart, f"size_mm = {[float(each) for each in artefacts.plane_mm]}"),
    ]  # fmt: skip
    return "\n\n".join(['name = "acceptance"', *objects]) + "\n"


def _object(artefact: Artefact, shape: str, position: FloatArray, rest: str) -> str:
    place = [round(float(each), 3) for each in position]
    return f'[[object]]\nname = "{artefact}"\nshape = "{shape}"\nposition_mm = {place}\nalbedo = {_ALBEDO}\n{rest}'


def _pose(step: Step) -> dict[str, object]:
    return {
        "name": step.name,
        "object": str(step.artefact),
        "position_mm": [float(each) for each in step.centre_mm],
        "rotation_deg": list(turn_deg(step)),
    }


@dataclass(frozen=True, slots=True)
class PositionJob(Job):
    """One position of an acceptance test, the `group`, with its repeats. scripted : the rig's positioner brings the
    artefact there, and the next position follows; else it is in its place.
    """

    kind: ClassVar[JobKind] = JobKind.POSITION
    promises: ClassVar[tuple[str, ...]] = (READINGS,)
    noun: ClassVar[str] = "evaluation of the position"

    group: UUID
    step: str
    scripted: bool = False
    captures: int = 1
    exposure_s: float | None = None

    def check(self, rig: RigSession) -> int:
        """See `Job`. All captures of the position lie on the disk at once. Raises PatternError, CalibrationError."""
        rig.refuse_misfit()
        if rig.facts is None:
            return 0
        return self.captures * check_plan(ScanPlan(exposure_s=self.exposure_s), rig.facts, rig.calibration)

    @property
    def capture_share(self) -> float:
        """See `Job`."""
        return 0.5

    def capture(self, rig: RigSession, run: JobRun) -> None:
        """Place the artefact if scripted, and record a bundle of each capture."""
        opened, record = rig.open_whole(), read_test(_test_of(run))
        plan = record.plan
        if required_calibration(opened).solve_id != record.calibration:
            message = (
                f"Acceptance test {record.id} is of calibration {record.calibration}, and the rig now uses "
                f"{required_calibration(opened).solve_id}. Activate the first again, or open a new test."
            )
            raise CalibrationStateError(message)
        if plan.rendered and opened.truth() is None:
            message = "exact artefacts are those of a rendered rig, and this one is not; send the certificates' values"
            raise InvalidInputError(message)
        takes = takes_of(plan, self.step)
        if self.scripted:
            run.report(f"{self.step}: place", 0.0, takes[0][0].words)
            move_artefact(opened, plan, takes[0][0])
        with storage_errors(run.recording):
            run.recording.mkdir()
        for step, take in takes:
            run.check(f"the acceptance test was cancelled before {step.name}; what was measured before is kept")
            # A repeat is captured without a move, so that it shows the scanner's scatter alone.
            capture_take(opened, plan, run.recording / bundle_name(step, take), run.part(take, len(takes), self.step))

    def compute(self, run: JobRun) -> Outcome:
        """Measure the artefact in each capture."""
        plan = read_test(_test_of(run)).plan
        takes, readings = takes_of(plan, self.step), list[Reading]()
        for step, take in takes:
            part = run.part(take, len(takes), self.step)
            readings.append(evaluated(run.bundle / bundle_name(step, take), run.folder, plan, step, take, part))
        # Where the points of a test lie, which is where this folder goes to.
        with storage_errors(run.folder):
            for file in (run.folder / "positions" / self.step).iterdir():
                file.rename(run.folder / file.name)
            shutil.rmtree(run.folder / "positions")
        write_file(run.folder / READINGS, readings_json(readings))
        return Outcome({"captures_done": len(readings)})

    def place(self, data: DataFolder, job_id: UUID) -> Path:  # noqa: ARG002 - as it is called
        """See `Job`."""
        return data.root / "acceptance" / str(self.group) / "positions" / self.step


def write_test_report(result: AcceptanceResult, folder: Path) -> None:
    """Write the reports of a test, in the worker."""
    from slrig.accept.report import write_reports

    write_reports(result, folder)


class AcceptanceTests:
    """The tests of one service, those of earlier runs among them: the `Group` of positions. Any thread may call. Raises
    StorageError.
    """

    def __init__(self, manager: JobManager, *, tolerance_mm: float | None = None, clock: Clock = utc_now) -> None:
        """tolerance_mm : what a point may be wrong by in what the rig is for, by the rig file."""
        self._manager = manager
        self._store = AcceptanceStore(manager.data)
        self._clock, self.tolerance_mm = clock, tolerance_mm
        self._lock = threading.RLock()
        self._tests = {record.id: record for record in self._store.load()}
        # Of those that are measured by script in this run of the service.
        self._holders: dict[UUID, Holder] = {}
        # Those that are to end with the position that is measured.
        self._cancelled: set[UUID] = set()
        manager.groups[JobKind.POSITION] = self

    def settle(self) -> None:
        """Forget jobs of tests that are gone. At the start, before jobs are gone on with."""
        for test_id in self._manager.store.by_parent(JobKind.POSITION).keys() - self._tests.keys():
            self._manager.store.delete_of(test_id)

    def open(self, plan_of: Callable[[Calibration, float | None], AcceptancePlan]) -> AcceptanceRecord:
        """Open a test of the rig as it is calibrated now, and of what its rig file wants. Touches no device.

        Raises DeviceBusyError if the rig is not open yet, CalibrationError if it has no calibration, InvalidInputError
        if the plan cannot be done; StorageError.
        """
        with self._lock:
            rig = self._manager.rig
            if rig.facts is None:
                message = "The rig is being opened. Try again in a moment."
                raise DeviceBusyError(message)
            calibration = rig.facts.calibration if rig.active is None else rig.active.calibration
            if calibration is None:
                message = f"rig '{rig.name}' has no calibration, and nothing can be measured; calibrate it first"
                raise CalibrationError(message)
            number = 1 + max((each.number for each in self._tests.values()), default=0)
            plan = plan_of(calibration, self.tolerance_mm)
            record = AcceptanceRecord(number, uuid4(), self._clock(), rig.name, calibration.solve_id, plan)
            self._store.save(record)
            write_calibration(self._store.folder(record.id) / CALIBRATION, calibration)
            self._tests[record.id] = record
        return record

    def get(self, test_id: UUID) -> AcceptanceRecord:
        """Return a test. Raises JobNotFoundError."""
        with self._lock:
            return with_jobs(self._found(test_id), self._manager.store.of(test_id))

    def latest(self) -> tuple[AcceptanceRecord, ...]:
        """Return all tests, newest first."""
        with self._lock:
            jobs = self._manager.store.by_parent(JobKind.POSITION)
            return tuple(with_jobs(record, jobs.get(record.id, ())) for record in reversed(self._tests.values()))

    def measure(
        self, test_id: UUID, *, wait: bool, scripted: bool, key: str | None = None, holder: Holder | None = None
    ) -> JobRecord:
        """Measure the next position, or, scripted, all that are left; return the job at once.

        Unless scripted, the artefact has to be in its place. `wait` allows it to wait behind other work. key : the
        idempotency key of the request, reserved. holder : whom a refusal names meanwhile; None the test.

        Raises JobNotFoundError, ScanStateError if there is no such test, or it is being measured, or it is over;
        RigBusyError, QueueFullError, DeviceError as a scan.
        """
        with self._lock:
            record = self.get(test_id)
            if not record.state.waiting:
                message = f"Acceptance test {test_id} is {record.state}; a position is measured while it is open."
                raise ScanStateError(message)
            begun = record.from_first_take()
            # All were measured, and only the decision is missing: the last position is measured once more.
            step = (begun.next_take or record.plan.takes[-1])[0].name
            job = self._position(record, step, scripted=scripted)
            made = self._manager.submit(job, wait=wait, key=key, holder=holder)[0]
            self._cancelled.discard(test_id)
            if holder is not None:
                self._holders[test_id] = holder
            return made

    def _position(self, record: AcceptanceRecord, step: str, *, scripted: bool) -> PositionJob:
        plan = record.plan
        return PositionJob(record.id, step, scripted, len(takes_of(plan, step)), plan.exposure_s)

    def cancel(self, test_id: UUID) -> AcceptanceRecord:
        """End a test. Returns at once; one that is over stays so. Raises JobNotFoundError, StorageError."""
        with self._lock:
            state = self.get(test_id).state
            if state.waiting:
                self._change(test_id, state=AcceptanceState.CANCELLED)
            elif state is AcceptanceState.MEASURING:
                self._cancelled.add(test_id)
            under_way = [job.id for job in self._manager.store.of(test_id) if not job.state.final]
        for job_id in under_way:
            self._manager.cancel(job_id)
        return self.get(test_id)

    def delete(self, test_id: UUID) -> None:
        """Forget a test and remove its files. Raises JobNotFoundError, ScanStateError, StorageError."""
        with self._lock:
            if self.get(test_id).state is AcceptanceState.MEASURING:
                message = f"Acceptance test {test_id} is being measured. Cancel it, then delete it."
                raise ScanStateError(message)
            self._store.delete(test_id)
            del self._tests[test_id]
            self._manager.store.delete_of(test_id)

    def file(self, test_id: UUID, name: str) -> Path:
        """Return where a report lies. Raises JobNotFoundError, ArtefactNotReadyError."""
        record = self.get(test_id)
        path = self._store.folder(test_id) / name
        if record.state is not AcceptanceState.FINISHED or not self._manager.data.owns(path):
            reason = f"has no {name} before every position is measured."
            message = f"Acceptance test {test_id} is {record.state}, and {reason}"
            raise ArtefactNotReadyError(message)
        return path

    def result(self, test_id: UUID) -> AcceptanceResult:
        """The result of a test of which every position is measured. Raises JobNotFoundError, StorageError."""
        record = self._found(test_id)
        calibration = read_calibration(self._store.folder(test_id) / CALIBRATION)
        return AcceptanceResult(
            record.rig, record.created_at, self._clock(), record.plan, calibration, record.readings,
            verdicts(record.readings, record.plan),
        )  # fmt: skip

    def folder(self, test_id: UUID) -> Path:
        """Folder of the reports and points of a test."""
        return self._store.folder(test_id)

    def _found(self, test_id: UUID) -> AcceptanceRecord:
        """A test as it is on disk."""
        with self._lock:
            record = self._tests.get(test_id)
        if record is None:
            message = f"No acceptance test {test_id} is on record here. GET /acceptance lists those that are."
            raise JobNotFoundError(message)
        return record

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """See `Group`: the readings of a position are on record, and what follows is begun."""
        if not isinstance(job, PositionJob):
            raise TypeError(job)
        if outcome is None:
            self._holders.pop(job.group, None)
            return Outcome()
        with self._lock:
            record = self._found(job.group)
            new = self._store.readings(job.group, job.step)
            others = {(each.step, each.take): each for each in record.readings if each.step != job.step}
            found = {**others, **{(each.step, each.take): each for each in new}}
            takes = [(step.name, take) for step, take in record.plan.takes]
            readings = tuple(found[each] for each in takes if each in found)
            state = AcceptanceState.CANCELLED if job.group in self._cancelled else record.state
            record = self._change(job.group, readings=readings, state=state)
            self._cancelled.discard(job.group)
            following = record.next_take
            # After a kill the next one may be on record already.
            begun = any(not each.state.final and each.id != job_id for each in self._manager.store.of(job.group))
            if following is not None and job.scripted and record.state.waiting and not begun:
                next_job = self._position(record, following[0].name, scripted=True)
                self._manager.add(next_job, holder=self._holders.get(job.group))
        place = self._store.folder(job.group) / POSITIONS / job.step
        self._manager.data.remove(place / BUNDLE)
        write_entries(place)
        if following is None and record.state.waiting:
            self._holders.pop(job.group, None)
            self._conclude(record)
        return Outcome({"captures_done": len(record.readings)})

    def _conclude(self, record: AcceptanceRecord) -> None:
        """Decide, and write the reports: every position is measured."""
        result = self.result(record.id)
        given = (result, self._store.folder(record.id))
        self._manager.worker.run(Task(write_test_report, given, what="report of the acceptance test"))
        self._change(record.id, state=AcceptanceState.FINISHED, decision=result.decision)

    def _change(self, test_id: UUID, **changes: Any) -> AcceptanceRecord:
        """Put a change on record, and return the test. Raises StorageError, and changes nothing then."""
        with self._lock:
            changed = replace(self._found(test_id), **changes)
            self._store.save(changed)
            self._tests[test_id] = changed
            return changed


def _test_of(run: JobRun) -> Path:
    """The folder of the test that a position belongs to."""
    if run.place is None:
        raise ValueError(run)
    return run.place.parent.parent

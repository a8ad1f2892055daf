"""Every kind of job: however it is cancelled or fails, it has one end with its cause, the rig is dark and free
afterwards, nothing half done stays on the disk, and the next job is none the worse.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import pytest

from slrig.accept.evaluation import Reading
from slrig.accept.job import AcceptanceTests
from slrig.accept.plan import Step
from slrig.accept.store import points_file
from slrig.calibrate.job import Calibrations, PoseRequest
from slrig.calibrate.verification import HealthStore, RigHealth, VerificationJob
from slrig.doctor import DoctorJob
from slrig.errors import DeviceGoneError, OutOfMemoryError, RigBusyError, ScanCancelledError, ScanInterruptedError
from slrig.jobs.data_folder import FILES
from slrig.jobs.listener import Listener
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.model_jobs.job import TURNTABLE, Models
from slrig.model_jobs.plan import ModelPlan, StatedAxis, TurntablePoses
from slrig.model_jobs.turntable import TurntableStore
from slrig.rig.session import ActiveCalibration
from slrig.scan.plan import PatternPlan
from tests.unit.accept.test_plan import plan_of
from tests.unit.calibrate.calibration_bench import BOARD, TameCalibrating
from tests.unit.calibrate.health_bench import a_verification
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.model_jobs.model_bench import TameCombining, kept_scan
from tests.unit.scan.bench import PIPELINE, Bench, failure_code
from tests.unit.scan.fakes import WAIT_S, tame_calibration
from tests.unit.stand_ins import stand_ins

Cancelled = Callable[[], bool]


class Computing:
    """The mathematics of every kind of job: `began` is set by it; it goes on while `gate` is clear; `error` is raised
    in place of its end.
    """

    def __init__(self) -> None:
        self.began, self.gate = threading.Event(), threading.Event()
        self.gate.set()
        self.error: Exception | None = None

    def __call__(self, cancelled: Cancelled = lambda: False) -> None:
        self.began.set()
        while not self.gate.wait(0.01):
            if cancelled():
                raise ScanCancelledError("It was cancelled.")
        if self.error is not None:
            error, self.error = self.error, None
            raise error


class Service(Bench):
    """Everything that begins jobs, over one tame rig that is calibrated."""

    def __init__(self, root: Path) -> None:
        self.computing = Computing()
        super().__init__(root, worker=TameCompute(PIPELINE, before=self.computing))
        tame = TameCalibrating()
        self.patched.enter_context(tame.patched())

        def evaluate(_bundle: Path, folder: Path, _plan: object, step: Step, take: int, _listener: Listener) -> Reading:
            points = folder / points_file(step.name, take)
            points.parent.mkdir(parents=True, exist_ok=True)
            points.touch()
            return Reading(step.name, take, {}, 0.01, 0.01, 0.04, 900, 0, 0.0)

        functions: dict[str, Callable[..., Any]] = {
            "calibration.health.verification.verify_by_board": lambda *_: a_verification(),
            "model_jobs.combining.combine_into": TameCombining(),
            "accept.job.evaluated": evaluate,
            "accept.job.write_test_report": lambda *_: None,
        }
        self.patched.enter_context(stand_ins(functions))
        health = RigHealth(self.manager.rig, HealthStore(self.store.database), self.folder)
        self.manager.groups[JobKind.VERIFICATION] = health
        self.calibrations = Calibrations(self.manager)
        self.models = Models(self.manager, turntable=TurntableStore(self.folder.root / TURNTABLE))
        self.acceptance = AcceptanceTests(self.manager)
        self.manager.rig.use_calibration(ActiveCalibration("spring", tame_calibration()))
        self.manager.start()

    def files(self) -> set[Path]:
        """All that lies in the data folder, but for the records' own files."""
        return {path for path in self.folder.root.rglob("*") if path.parent != self.folder.root or path.is_dir()}

    def close(self) -> None:
        self.computing.gate.set()
        super().close()


class Kind:
    """How jobs of a kind are begun and cancelled. Each object stands for one.

    captures : its first part has the rig and takes frames. computes : it has a second part. keeps : the frames stay
    where that failed.
    """

    captures, computes, keeps = True, True, False

    def __init__(self, service: Service) -> None:
        self.service = service
        self.prepare()

    def prepare(self) -> None:
        """Do what comes before its first job."""

    def begin(self, *, wait: bool = False) -> UUID:
        raise NotImplementedError

    def cancel(self, job_id: UUID) -> None:
        self.service.manager.cancel(job_id)

    def capturing(self) -> UUID:
        self.service.gate.clear()
        job_id = self.begin()
        assert self.service.began.wait(WAIT_S)
        return job_id

    def computing(self) -> UUID:
        self.service.computing.gate.clear()
        job_id = self.begin()
        assert self.service.computing.began.wait(WAIT_S)
        return job_id

    def over(self, job_id: UUID) -> JobRecord:
        return self.service.until(job_id)


class Scan(Kind):
    """A scan."""

    keeps = True

    def begin(self, *, wait: bool = False) -> UUID:
        return self.service.scan(wait=wait).id


class Pose(Kind):
    """A pose of a calibration."""

    def prepare(self) -> None:
        self.session = self.service.calibrations.open(BOARD).id

    def begin(self, *, wait: bool = False) -> UUID:
        return self.service.calibrations.shoot(self.session, PoseRequest(), wait=wait).id

    def cancel(self, job_id: UUID) -> None:
        poses = self.service.calibrations.register.get(self.session).poses
        number = next(pose.number for pose in poses if pose.id == job_id)
        self.service.calibrations.cancel(self.session, number)


class Solve(Pose):
    """A solve of a calibration that has one pose."""

    captures = False

    def prepare(self) -> None:
        super().prepare()
        assert self.over(super().begin()).state is JobState.SUCCEEDED
        self.service.began.clear()
        self.service.computing.began.clear()

    def begin(self, *, wait: bool = False) -> UUID:
        del wait
        self.service.calibrations.solve(self.session)
        return self.service.store.of(self.session)[-1].id

    def cancel(self, job_id: UUID) -> None:
        self.service.manager.cancel(job_id)


class Verified(Kind):
    """A verification."""

    def begin(self, *, wait: bool = False) -> UUID:
        return self.service.manager.submit(VerificationJob(BOARD), wait=wait)[0].id


class Model(Kind):
    """A model of two scans."""

    captures = False

    def prepare(self) -> None:
        self.scans = tuple(kept_scan(self.service.store, self.service.folder, angle_deg=each) for each in (0.0, 40.0))

    def begin(self, *, wait: bool = False) -> UUID:
        del wait
        plan = ModelPlan(self.scans, TurntablePoses(StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0))))
        return self.service.models.combine(plan).id


class Position(Kind):
    """One of an acceptance test, which is cancelled with it."""

    def prepare(self) -> None:
        # A test is opened on a rig that is open.
        self.service.until(self.service.scan().id)
        self.service.began.clear()
        self.service.computing.began.clear()
        self.test = self.service.acceptance.open(lambda *_: plan_of()).id

    def begin(self, *, wait: bool = False) -> UUID:
        if not self.service.acceptance.get(self.test).state.waiting:
            # It was over with its position that was cancelled.
            self.test = self.service.acceptance.open(lambda *_: plan_of()).id
        return self.service.acceptance.measure(self.test, wait=wait, scripted=False).id

    def cancel(self, job_id: UUID) -> None:
        assert job_id in {job.id for job in self.service.store.of(self.test)}
        self.service.acceptance.cancel(self.test)


class Doctor(Kind):
    """An examination of the rig, over when the rig is free."""

    computes = False

    def begin(self, *, wait: bool = False) -> UUID:
        return self.service.manager.submit(DoctorJob(PatternPlan()), wait=wait)[0].id


KINDS = (Scan, Pose, Solve, Verified, Model, Position, Doctor)


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    yield service
    service.close()


@pytest.fixture
def kind(request: pytest.FixtureRequest, service: Service) -> Kind:
    """One of KINDS, by `computing` or `capturing` below."""
    return cast("type[Kind]", request.param)(service)


IN_THE_CORE = (Scan, Pose, Solve, Model)


def parametrised(kinds: Sequence[type[Kind]]) -> pytest.MarkDecorator:
    marked = [
        pytest.param(kind, marks=() if kind in IN_THE_CORE else pytest.mark.slow, id=kind.__name__.lower())
        for kind in kinds
    ]
    return pytest.mark.parametrize("kind", marked, indirect=True)


computing = parametrised([kind for kind in KINDS if kind.computes])
capturing = parametrised([kind for kind in KINDS if kind.captures])


def assert_well(service: Service, kind: Kind, *, opened: int = 1) -> None:
    """The rig is dark, free and open, and the next job of this kind succeeds."""
    status = service.manager.status()
    assert (status.holder, status.fault) == (None, None)
    assert all(projector.dark for _, projector in service.opened)
    for each in (service.computing, service):
        each.gate.set()
    assert kind.over(kind.begin()).state is JobState.SUCCEEDED
    assert len(service.opened) <= opened
    assert list(service.folder.incoming.iterdir()) == []


@capturing
def test_a_job_that_is_cancelled_while_it_waits_never_begins(service: Service, kind: Kind) -> None:
    holder = service.held()
    before = service.files()
    waiting = kind.begin(wait=True)
    service.began.clear()
    kind.cancel(waiting)
    record = kind.over(waiting)
    assert (record.state, failure_code(record)) == (JobState.CANCELLED, "scan-cancelled")
    assert record.started_at is None
    assert record.fault is not None
    assert record.fault.message.endswith("was cancelled while it waited for the rig.")
    assert service.files() == before
    service.gate.set()
    assert service.until(holder.id).state is JobState.SUCCEEDED
    assert not service.began.is_set()
    assert_well(service, kind)


@capturing
def test_a_job_that_is_cancelled_while_it_captures_leaves_nothing(service: Service, kind: Kind) -> None:
    before = service.files()
    job_id = kind.capturing()
    with pytest.raises(RigBusyError) as busy:
        service.scan()
    started = service.store.get(job_id).started_at
    assert started is not None
    assert (busy.value.holder, busy.value.since) == (
        service.manager.status().holder, started.isoformat(timespec="seconds"),
    )  # fmt: skip
    assert "cancel it with POST /" in str(busy.value)
    assert not service.opened[0][1].dark
    kind.cancel(job_id)
    record = kind.over(job_id)
    assert (record.state, failure_code(record)) == (JobState.CANCELLED, "scan-cancelled")
    assert service.files() == before
    assert not service.computing.began.is_set()
    assert_well(service, kind)


@computing
def test_a_job_that_is_cancelled_while_it_computes_leaves_nothing(service: Service, kind: Kind) -> None:
    before = service.files()
    job_id = kind.computing()
    # Whatever computes leaves the rig to others.
    assert service.manager.status().holder is None
    kind.cancel(job_id)
    record = kind.over(job_id)
    assert record.state is JobState.CANCELLED
    assert list(service.folder.incoming.iterdir()) == []
    assert service.files() == before
    kind.cancel(job_id)
    assert kind.over(job_id) == record
    assert_well(service, kind)


@capturing
def test_a_device_that_is_lost_fails_the_job_and_is_opened_again(service: Service, kind: Kind) -> None:
    service.error = DeviceGoneError("Camera 'cam0' was unplugged.")
    record = kind.over(kind.begin())
    assert (record.state, failure_code(record)) == (JobState.FAILED, "device-gone")
    assert service.opened[0][1].dark
    assert service.opened[0][0].closed
    assert service.opened_again.wait(WAIT_S)
    assert list(service.folder.incoming.iterdir()) == []
    assert_well(service, kind, opened=2)


@computing
def test_mathematics_that_fails_fails_the_job_alone(service: Service, kind: Kind) -> None:
    service.computing.error = OutOfMemoryError("No room.")
    record = kind.over(kind.begin())
    assert (record.state, failure_code(record)) == (JobState.FAILED, "out-of-memory")
    assert list(service.folder.incoming.iterdir()) == []
    if kind.keeps:
        assert {path.name for path in service.folder.scan(record.id).iterdir()} == {"bundle", FILES}
    assert_well(service, kind)


@capturing
def test_the_end_of_the_service_interrupts_what_captures_and_leaves_what_waits(service: Service, kind: Kind) -> None:
    job_id = kind.capturing()
    waiting = service.scan(wait=True)
    service.manager.close(timeout_s=WAIT_S)
    record = kind.over(job_id)
    assert (record.state, failure_code(record)) == (JobState.INTERRUPTED, "scan-interrupted")
    assert service.store.get(waiting.id).state is JobState.QUEUED
    camera, projector = service.opened[0]
    assert (projector.dark, projector.closed, camera.closed) == (True, True, True)
    with pytest.raises(ScanInterruptedError):
        service.scan()

"""What schedules do with the rig: options refused early, the rig held in the schedule's name, results and failures."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import pytest

from slrig.accept.job import AcceptanceTests
from slrig.accept.plan import AcceptanceRequest
from slrig.calibrate.verification import HealthStore, RigHealth
from slrig.errors import (
    CalibrationError,
    DeviceError,
    PoseRefusedError,
    RigBusyError,
    ScanCancelledError,
    ScanStateError,
    ScheduleError,
    SlrigError,
    SolveRefusedError,
)
from slrig.failure import JobFailure, error_of
from slrig.jobs.records import Holder, JobKind, JobState
from slrig.schedule.scheduler import Tasks
from slrig.schedule.store import Cron, RunState, Schedule, ScheduledRun, ScheduleSpec, TaskKind
from tests.core import parametrize_core
from tests.unit.accept.test_job import PLAN, Desk, desk, desks
from tests.unit.calibrate.calibration_bench import CalibrationBench
from tests.unit.calibrate.health_bench import a_verification
from tests.unit.scan.fakes import WAIT_S
from tests.unit.stand_ins import stand_ins

__all__ = ["desk", "desks"]

BOARD = {"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}


class TaskBench(CalibrationBench):
    """Calibrations over a tame bench, verifications, and the tasks of schedules over them."""

    def __init__(self, tmp_path: Path, *, positioner: bool = True) -> None:
        super().__init__(tmp_path, positioner=positioner)
        verify = {"calibration.health.verification.verify_by_board": lambda *_: a_verification()}
        self.patched.enter_context(stand_ins(verify))
        self.health = HealthStore(self.store.database)
        self.manager.groups[JobKind.VERIFICATION] = RigHealth(self.manager.rig, self.health, self.folder)
        self.tidied: list[int] = []
        self.tasks = Tasks(
            self.manager, self.calibrations, AcceptanceTests(self.manager), cast("Any", None),
            tidy=lambda: self.tidied.append(len(self.calibrations.latest())),
        )  # fmt: skip

    def do(self, task: TaskKind, **options: Any) -> Mapping[str, Any]:
        return self.tasks(*scheduled(task, options))

    def use_a_calibration(self) -> None:
        """Have scans use a calibration whose board is known."""
        self.calibrations.activate(self.solved(poses=1))

    def open(self) -> None:
        self.manager.lend(Holder("a", "b", "/c"), lambda rig, _: rig.open())


def scheduled(task: TaskKind, options: Mapping[str, Any]) -> tuple[Schedule, ScheduledRun]:
    due = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
    schedule = Schedule(ID, ScheduleSpec(Cron("30 6 * * *", "Europe/Berlin"), task, options), due, due)
    return schedule, ScheduledRun(1, ID, due, RunState.RUNNING, None, 1, 1, due, None, None, None, None)


ID = UUID("3f2a0000-9f0e-4c57-8a39-5f8a4f0c2b11")
HOLDER = "schedule 3f2a0000, {} due 06:30"


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[TaskBench]:
    made = TaskBench(tmp_path)
    made.manager.start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TaskBench]:
    """A bench whose rig is open, for tests that change nothing."""
    made = TaskBench(tmp_path_factory.mktemp("opened"))
    made.manager.start()
    made.open()
    yield made
    made.close()


def checked(tasks: Tasks, task: TaskKind, options: Mapping[str, Any]) -> None:
    tasks.check(ScheduleSpec(Cron("* * * * *", "UTC"), task, options))


@pytest.mark.parametrize(
    ("task", "options", "words"),
    [
        ("verification", {"bord": 1}, "bord: unknown key; did you mean 'board'.*are: board, position, exposure_s"),
        ("verification", {"position": -1}, "position"),
        ("verification", {"exposure_s": "1"}, "exposure_s"),
        ("verification", {"board": {**BOARD, "corners": [4]}}, "corners"),
        ("verification", {"board": {**BOARD, "corners": [1, 3]}}, "found 1 x 3"),
        ("calibration", {}, "board: missing.*are: board, positions, exposure_s, activate"),
        ("calibration", {"board": BOARD, "activate": "yes", "poses": 3}, "activate.*poses"),
        ("acceptance", {"repeats": 0}, "repeats.*are: artefacts, volume_mm, tolerance_mm, limits"),
        ("acceptance", {"artefacts": {"plane_mm": [1, 2]}}, "sphere: missing"),
        # What can only fail on this rig.
        ("verification", {}, r"not known: no calibration that was made here is in use\. Give the schedule .*\"board\""),
        ("verification", {"board": BOARD, "position": 3}, "no 3; it has 0 to 2: near, far"),
        ("calibration", {"board": BOARD, "positions": [0, "upside down", 7]}, "no 'upside down', 7; it has 0 to 2"),
    ],
)
def test_options_with_which_no_run_can_succeed_are_refused_at_once(
    opened: TaskBench, task: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ScheduleError, match=words):
        checked(opened.tasks, TaskKind(task), options)


def test_valid_options_are_accepted(bench: TaskBench) -> None:
    bench.use_a_calibration()
    exact = {"value_mm": 30, "uncertainty_mm": 0.001}
    artefacts = {"sphere": exact, "bar": exact, "plane_mm": [160, 110], "sphere_form_mm": 0, "plane_form_mm": 0}
    for task, options in (
        (TaskKind.VERIFICATION, {}),
        (TaskKind.VERIFICATION, {"board": BOARD, "position": 2}),
        (TaskKind.CALIBRATION, {"board": BOARD, "positions": [0, "far"], "activate": True}),
        (TaskKind.ACCEPTANCE, {}),
        (TaskKind.ACCEPTANCE, {"artefacts": artefacts, "volume_mm": [[0, 0, 0], [1, 1, 1.5]], "repeats": 2}),
    ):
        checked(bench.tasks, task, options)


def test_work_that_needs_a_positioner_is_refused_where_there_is_none(tmp_path: Path) -> None:
    bench = TaskBench(tmp_path, positioner=False)
    orders: list[tuple[TaskKind, dict[str, Any]]] = [
        (TaskKind.CALIBRATION, {"board": BOARD}),
        (TaskKind.ACCEPTANCE, {}),
        (TaskKind.VERIFICATION, {"board": BOARD, "position": 0}),
    ]
    for task, options in orders:
        # It is not known before the rig is open: a run is refused then.
        checked(bench.tasks, task, options)
    bench.manager.start()
    bench.open()
    for task, options in orders:
        with pytest.raises(ScheduleError, match="no positioner, and a schedule cannot rely on a person"):
            checked(bench.tasks, task, options)
    with pytest.raises(ScheduleError, match="no positioner, and a schedule cannot rely on a person"):
        bench.do(TaskKind.CALIBRATION, board=BOARD)
    assert bench.calibrations.latest() == []
    checked(bench.tasks, TaskKind.VERIFICATION, {"board": BOARD})
    bench.close()


def test_calibration_takes_every_pose_solves_and_is_used_only_if_ordered(bench: TaskBench) -> None:
    told = bench.do(TaskKind.CALIBRATION, board=BOARD)
    assert bench.tame.visited == [0, 1, 2]
    assert bench.tame.solved == [["pose 1", "pose 2", "pose 3"]]
    assert bench.tidied == [1]
    assert (told["poses"], told["accepted"], told["refused"], told["activated"]) == (3, 3, {}, False)
    assert bench.calibrations.active is None
    told = bench.do(TaskKind.CALIBRATION, board=BOARD, positions=["far", 0], activate=True)
    assert bench.tame.visited[3:] == [1, 0]
    assert str(bench.calibrations.active) == told["calibration"]
    assert bench.calibrations.latest()[0].label == HOLDER.format("calibration")


def test_calibration_that_is_not_to_be_used_is_not_activated(bench: TaskBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = {"verdict": {"grade": "do_not_use", "summary": "do not use: 9 px", "unattended": ["it is bad"]}}
    monkeypatch.setattr("slrig.calibrate.report.summary", lambda _: bad)
    told = bench.do(TaskKind.CALIBRATION, board=BOARD, activate=True)
    assert (told["activated"], told["verdict"]) == (False, "do not use: 9 px")
    assert told["left_to_a_person"] == ["it is bad"]
    assert bench.calibrations.active is None


@pytest.mark.slow
def test_device_or_solve_that_fails_fails_the_run(bench: TaskBench) -> None:
    bench.error = DeviceError("the camera does not answer")
    with pytest.raises(DeviceError, match="the camera does not answer"):
        bench.do(TaskKind.CALIBRATION, board=BOARD)
    # It is tried again from the first pose on, and nothing is left of it.
    assert bench.calibrations.latest() == []
    assert bench.tidied == [0]
    bench.tame.unseen = True
    with pytest.raises(SolveRefusedError, match="no accepted pose"):
        bench.do(TaskKind.CALIBRATION, board=BOARD)
    (record,) = bench.calibrations.latest()
    assert len(record.poses) == 3
    bench.tame.unseen = False
    bench.tame.solve_error = SolveRefusedError("all poses are parallel")
    with pytest.raises(SolveRefusedError, match="all poses are parallel"):
        bench.do(TaskKind.CALIBRATION, board=BOARD)


def test_rig_that_cannot_be_opened_fails_the_run_with_its_cause(tmp_path: Path) -> None:
    bench = TaskBench(tmp_path)
    bench.open_error = DeviceError("no camera is plugged in")
    bench.manager.start()
    with pytest.raises(DeviceError, match="no camera is plugged in"):
        bench.do(TaskKind.CALIBRATION, board=BOARD)
    bench.open_error = None
    assert bench.do(TaskKind.CALIBRATION, board=BOARD)["accepted"] == 3
    bench.close()


def test_verification_is_of_the_board_in_use(bench: TaskBench) -> None:
    with pytest.raises(CalibrationError, match=r"that was made here is in use\. Give the schedule the option .board"):
        bench.do(TaskKind.VERIFICATION)
    bench.use_a_calibration()
    told = bench.do(TaskKind.VERIFICATION, position=2)
    assert bench.tame.visited == [2]
    latest = bench.health.latest()
    assert latest is not None
    assert told["verification"] == str(latest.id)
    assert (told["state"], told["expected_mm"]) == ("good", 0.01)
    bench.tame.unseen = True
    with pytest.raises(PoseRefusedError, match="no camera sees the board"):
        bench.do(TaskKind.VERIFICATION)


def test_busy_rig_is_refused_before_anything_is_done(bench: TaskBench) -> None:
    bench.use_a_calibration()
    before = len(bench.calibrations.latest())
    scan = bench.held()
    for task in (TaskKind.VERIFICATION, TaskKind.CALIBRATION):
        with pytest.raises(RigBusyError) as error:
            bench.do(task, board=BOARD)
        assert error.value.holder == str(scan.id)
    assert len(bench.calibrations.latest()) == before


@parametrize_core("task", [TaskKind.VERIFICATION, TaskKind.CALIBRATION])
def test_run_holds_the_rig_in_the_name_of_its_schedule_until_it_is_cancelled(bench: TaskBench, task: TaskKind) -> None:
    bench.use_a_calibration()
    schedule, _ = scheduled(task, {})
    with pytest.raises(ScanStateError, match="no run under way"):
        bench.tasks.cancel(schedule)
    bench.gate.clear()
    bench.began.clear()
    errors: list[BaseException] = []

    def do() -> None:
        with pytest.raises(ScanCancelledError) as caught:
            bench.do(task, board=BOARD)
        errors.append(caught.value)

    run = threading.Thread(target=do)
    run.start()
    assert bench.began.wait(WAIT_S)
    if task is TaskKind.VERIFICATION:
        with pytest.raises(RigBusyError, match=f"POST /schedule/{ID}/cancel") as busy:
            bench.scan()
        assert busy.value.holder == HOLDER.format(task)
    bench.tasks.cancel(schedule)
    run.join(WAIT_S)
    assert len(errors) == 1
    bench.gate.set()
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED


@pytest.mark.slow
def test_acceptance_is_measured_by_script_and_gives_its_decision(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AcceptanceRequest, "plan", lambda *_: PLAN)
    schedule, run = scheduled(TaskKind.ACCEPTANCE, {})
    tasks = Tasks(desk.manager, cast("Any", None), desk, cast("Any", None))
    told = tasks(schedule, run)
    assert desk.manager.holders == [HOLDER.format("acceptance")] * len(PLAN.steps)
    assert told["decision"] == "passes"
    assert told["quantities"]["PF"]["position"].startswith("sphere-")
    assert desk.file(UUID(told["acceptance"]), "report.html").is_file()
    desk.manager.busy = "1"
    with pytest.raises(RigBusyError):
        tasks(schedule, run)


def test_fault_of_a_busy_rig_is_that_of_a_device() -> None:
    assert type(error_of(JobFailure("rig-busy", "held"))) is DeviceError
    assert type(error_of(JobFailure("unexpected", "odd"))) is SlrigError
    assert type(error_of(JobFailure("pose-refused", "dark"))) is PoseRefusedError

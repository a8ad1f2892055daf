"""An examination: its report, its time limit, its command, and that it ends dark."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from slrig.cli import local
from slrig.cli.commands import app
from slrig.conformance import (
    CHECKS,
    CheckOutcome,
    CheckResult,
    ConformanceJob,
    ConformanceReport,
    ConformanceRun,
    Failure,
    job,
    run_checks,
)
from slrig.conformance.bench import (
    ExpectationError,
    Need,
    NotApplicableError,
    RigBench,
    check,
    measure_reference_levels,
)
from slrig.devices import Rig
from slrig.doctor import last_examination
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError
from slrig.jobs import manager as managing
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.listener import Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobState
from slrig.jobs.store import JobStore
from slrig.model import Pixels
from slrig.rig.session import RigSession
from slrig.rig.watchdog import Watchdog
from slrig.scan.plan import PatternPlan
from tests.core import parametrize_core
from tests.unit.conformance.model_rig import DeliversStale, Hangs, LightsLate, Maker, ModelProjector, StaysLit, sequence
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import WAIT_S


def owners() -> set[threading.Thread]:
    """The threads that own rigs under examination; other tests may have some of their own."""
    return {thread for thread in threading.enumerate() if thread.name == "conformance"}


@pytest.fixture
def hanging() -> Iterator[type[Hangs]]:
    """A camera whose reads hang until the test is over."""
    release, before = threading.Event(), owners()
    yield type("HangsForATest", (Hangs,), {"released": release})
    release.set()
    for thread in owners() - before:
        thread.join(10)


def test_a_device_that_never_answers_ends_the_examination_and_not_the_program(hanging: type[Hangs]) -> None:
    maker, before = Maker(hanging), owners()
    report = run_checks(maker, sequence(), limit_s=0.3)
    first = next(result for result in report.results if result.outcome is CheckOutcome.FAILED)
    after = report.results[report.results.index(first) + 1 :]
    assert "did not return in 0.3 s" in str(first.failure)
    assert after
    assert {result.outcome for result in after} == {CheckOutcome.NOT_RUN}
    assert report.stopped is not None
    assert "one owner" in report.stopped
    assert all(result.reason == report.stopped for result in after)
    assert not report.conforms
    # What was not run counts: a rig that hangs does not have a good score for it.
    assert report.score == pytest.approx(report.count(CheckOutcome.PASSED) / len(CHECKS))
    # Should it answer after all, the rig is closed then.
    hanging.released.set()
    for owner in owners() - before:
        owner.join(10)
        assert not owner.is_alive()
    assert all(rig.projector.closed.is_set() for rig in maker.rigs)  # type: ignore[attr-defined]


def test_a_rig_that_does_not_open_is_not_examined() -> None:
    def refuse() -> Rig:
        message = "the camera is held by process 4711"
        raise DeviceBusyError(message)

    calls: list[str] = []
    with pytest.raises(DeviceBusyError, match="4711"):
        run_checks(refuse, sequence(), Listener(report=lambda stage, _fraction, _detail: calls.append(stage)))
    assert calls == []


def test_a_rig_that_goes_away_ends_the_examination() -> None:
    maker = Maker()

    def open_or_fail() -> Rig:
        if len(maker.rigs) == 2:
            message = "no camera is plugged in"
            raise DeviceGoneError(message)
        return maker()

    report = run_checks(open_or_fail, sequence())
    assert report.count(CheckOutcome.FAILED) == 1
    assert report.count(CheckOutcome.NOT_RUN) > 10
    assert report.stopped is not None
    assert "no camera is plugged in" in report.stopped


def test_an_examination_that_is_interrupted_closes_the_rig() -> None:
    maker, before = Maker(), owners()

    def interrupt(_stage: str, fraction: float, _detail: str) -> None:
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_checks(maker, sequence(), Listener(report=interrupt))
    assert all(rig.projector.closed.is_set() for rig in maker.rigs)  # type: ignore[attr-defined]
    assert owners() <= before


def test_checks_have_names_and_progress_is_reported_before_and_after_each() -> None:
    calls: list[tuple[str, float, str]] = []
    assert len({each.name for each in CHECKS}) == len({each.title for each in CHECKS}) == len(CHECKS)
    first, second = CHECKS[:2]
    run_checks(Maker(), sequence(), Listener(report=lambda *what: calls.append(what)), checks=(first, second))
    assert calls == [
        *((first.title, 0.0, ""), (first.title, 0.5, "passed")),
        *((second.title, 0.5, ""), (second.title, 1.0, "passed")),
    ]


def test_one_thread_owns_the_devices() -> None:
    owners: set[int] = set()

    @check()
    def remember_the_thread(bench: RigBench) -> None:
        """Nothing."""
        assert bench.rig.cameras
        owners.add(threading.get_ident())

    maker = Maker()

    def open_rig() -> Rig:
        owners.add(threading.get_ident())
        return maker()

    with ConformanceRun(open_rig, sequence()) as examination:
        examination.run_check(remember_the_thread)
        examination.run_check(CHECKS[1])
    assert len(owners) == 1
    assert threading.get_ident() not in owners


def test_checks_share_a_rig_unless_they_want_a_fresh_one_or_the_last_one_failed() -> None:
    maker = Maker()
    shared = [each for each in CHECKS if not each.fresh and Need.WHITE_AND_BLACK not in each.needs]
    with ConformanceRun(maker, sequence()) as examination:
        assert {examination.run_check(each).outcome for each in shared} == {CheckOutcome.PASSED}
        assert len(maker.rigs) == 1
        examination.run_check(next(each for each in CHECKS if each.fresh))
        examination.run_check(shared[0])
        assert len(maker.rigs) == 3
    broken = Maker(DeliversStale)
    with ConformanceRun(broken, sequence()) as examination:
        results = [examination.run_check(each) for each in shared]
    failed = sum(result.outcome is CheckOutcome.FAILED for result in results)
    assert len(broken.rigs) == 1 + failed > 1


def test_an_error_of_a_driver_is_a_failure_that_names_the_device() -> None:
    @check()
    def raises(bench: RigBench) -> None:
        """A driver fails."""
        with bench.arm_camera(*next(bench.stepped_cameras())):
            fault = "select failed"
            raise OSError(fault)

    with ConformanceRun(Maker(), sequence()) as examination:
        result = examination.run_check(raises)
    assert result.failure == Failure(
        "no error comes from a call that the contract allows",
        "OSError: select failed",
        "a driver raises the errors of slrig.errors, and no others",
        "camera 'left', software trigger",
    )


def test_a_check_may_find_that_it_does_not_apply() -> None:
    @check()
    def does_not_apply(_stand: RigBench) -> None:
        """Nothing to ask."""
        message = "it has one exposure"
        raise NotApplicableError(message)

    report = run_checks(Maker(), sequence(), checks=(does_not_apply, CHECKS[0]))
    assert [result.outcome for result in report.results] == [CheckOutcome.NOT_APPLICABLE, CheckOutcome.PASSED]
    assert (report.applicable, report.percent, report.conforms) == (1, 100, True)
    assert report.results[0].reason == "it has one exposure"


def result(outcome: CheckOutcome) -> CheckResult:
    return CheckResult("check", "A check", outcome, 0.1)


def test_a_score_is_100_only_if_nothing_failed() -> None:
    report = ConformanceReport(
        "rig", (*(result(CheckOutcome.PASSED) for _ in range(999)), result(CheckOutcome.FAILED)), 1.0
    )
    assert (report.percent, report.conforms) == (99, False)
    assert ConformanceReport("rig", (result(CheckOutcome.NOT_APPLICABLE),), 1.0).conforms is False
    assert (
        ConformanceReport("rig", (result(CheckOutcome.PASSED), result(CheckOutcome.NOT_APPLICABLE)), 1.0).percent == 100
    )
    assert ConformanceReport("rig", (result(CheckOutcome.PASSED), result(CheckOutcome.NOT_RUN)), 1.0).percent == 50


def test_a_report_can_be_written_as_json() -> None:
    examined = [each for each in CHECKS if each.fresh or Need.POSITIONER in each.needs]
    report = run_checks(Maker(DeliversStale, StaysLit), sequence(), checks=examined)
    document = json.loads(json.dumps(report.document()))
    assert document["conforms"] is False
    # The model has no positioner.
    assert 0 < document["passed"] < document["applicable"] == len(examined) - 1
    failed = [each for each in document["checks"] if each["outcome"] == "failed"]
    assert {"asked", "found", "do", "where"} == set(failed[0]["failure"])


def images(*levels: float, noise_dn: float = 0.0) -> list[Pixels]:
    """White or black frames: the left half of the image is lit."""
    rng = np.random.default_rng(0)
    lit = np.arange(64) < 32
    made: list[Pixels] = []
    for level in levels:
        values = np.where(lit, level, 30.0) + noise_dn * rng.standard_normal((48, 64))
        made.append(np.clip(np.rint(values), 0, 255).astype(np.uint8))
    return made


def test_the_level_is_that_of_the_lit_pixels_in_any_room_light_and_noise() -> None:
    light = measure_reference_levels(images(90, 90, noise_dn=4), images(30, 30, noise_dn=4), full_scale=255)
    assert light.lit[:, :32].mean() > 0.95
    assert light.lit[:, 32:].mean() < 0.01
    for level, expected in ((90, 1.0), (30, 0.0), (60, 0.5)):
        assert light.level(images(level, noise_dn=4)[0]) == pytest.approx(expected, abs=0.05)


def test_a_camera_that_does_not_see_the_projector_is_reported() -> None:
    for white, black in ((31, 30), (30, 90)):
        with pytest.raises(ExpectationError, match="switch the lamp on"):
            measure_reference_levels(images(white, white, noise_dn=2), images(black, black, noise_dn=2), full_scale=255)


LATE = "a_frame_lies_wholly_in_its_pattern"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text('name = "small"\n[head]\ndriver = "absent"\n')
    return path


@parametrize_core(("projector", "passed"), [(ModelProjector, 2), (LightsLate, 1)])
def test_conform_prints_faults_and_remedies(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, projector: type[ModelProjector], passed: int
) -> None:
    # Two checks of all: what comes of them is tested by `test_broken_drivers`.
    few = [check for check in CHECKS if check.name in {LATE, "show_needs_a_loaded_sequence"}]
    monkeypatch.setattr(job, "run_checks", partial(run_checks, checks=few))
    monkeypatch.setattr(local, "open_rig", lambda _config: Maker(projector=projector)())
    data = tmp_path / "data"
    (data / "scans").mkdir(parents=True)
    shown = CliRunner().invoke(app, ["conform", str(rig), "--data", str(data)])
    assert shown.exit_code == (0 if passed == 2 else 1), shown.output
    assert f"{50 * passed} %: " in shown.stdout
    kept = last_examination(data, "conformance", "model")
    assert kept is not None
    assert f"{kept.found['passed']} of {kept.found['applicable']} checks" in shown.stdout
    calls = " ".join(shown.stdout.split())
    assert (f"({LATE})" in calls) == (passed == 1)
    assert ("remedy read returns frames whose whole exposure, all rows, lies after after_ns" in calls) == (passed == 1)
    # As JSON, and into a folder that is none of the service's.
    shown = CliRunner().invoke(app, ["conform", str(rig), "--json", "--data", str(tmp_path)])
    document = json.loads(shown.stdout)
    assert (document["rig"], document["conforms"], document["score"]) == ("model", passed == 2, passed / 2)
    assert (document["passed"], document["applicable"]) == (passed, 2)
    assert "is not a data folder of slrig serve" in shown.stderr


def test_a_check_that_hangs_ends_the_job_and_leaves_the_checks_before_it_on_record(
    hanging: type[Hangs], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "run_checks", partial(run_checks, limit_s=0.2))
    monkeypatch.setattr(managing, "Watchdog", partial(Watchdog, check_s=0.02))
    data = DataFolder(tmp_path / "data")
    database = Database(data.database)
    rig = RigSession("model", Maker(hanging))
    manager = JobManager(JobStore(database), data, rig, TameCompute(PIPELINE), ConformanceJob)
    manager.start()
    begun = manager.submit(ConformanceJob(PatternPlan()), wait=True)[0].id
    record = manager.wait(begun, WAIT_S)
    assert record.state is JobState.FAILED
    assert record.fault is not None
    assert "the rig: its driver has not come back from '" in record.fault.message
    report = ConformanceReport.from_document(record.summary or {})
    assert report.count(CheckOutcome.PASSED) > 0
    assert report.stopped is not None
    hung = report.stopped.split("'")[1]
    assert next(each for each in report.results if each.outcome is CheckOutcome.NOT_RUN).title == hung
    # Nobody else is given the rig as long as the call does not return.
    with pytest.raises(DeviceError, match=f"come back from '{hung}'"):
        manager.submit(ConformanceJob(PatternPlan()), wait=True)
    hanging.released.set()
    manager.close()
    database.close()
    data.release()


def test_conform_on_a_rig_that_cannot_be_opened_is_exit_code_2(rig: Path) -> None:
    shown = CliRunner().invoke(app, ["conform", str(rig)])
    assert shown.exit_code == 2
    assert "no installed package provides the head driver 'absent'" in shown.stderr

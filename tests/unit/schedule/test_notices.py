"""Notices: what is put into the outbox of runs, of the rig's health and of jobs, with what it tells of."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args
from uuid import UUID, uuid4

import pytest
from sqlalchemy.orm import Session

from slrig.config import NoticeKind
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import JobKind, JobRecord, JobState, acting_as
from slrig.jobs.store import JobStore
from slrig.schedule.notices import TOLD, NoticedHealth, tell_run
from slrig.schedule.records import Cron, Order, Run, RunState, Schedule, TaskKind
from tests.unit.jobs.tame_queue import PowerCut
from tests.unit.verify.health_bench import a_verification, hours

DUE = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
SCHEDULE = Schedule(UUID(int=7), Order(Cron("30 6 * * *", "Europe/Berlin"), TaskKind.VERIFICATION), DUE, DUE)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    made = Database(tmp_path / "slrig.sqlite")
    yield made
    made.close()


@pytest.fixture
def outbox(database: Database) -> Outbox:
    return Outbox(database, rig="bench", wanted={"webhook": get_args(NoticeKind)}, clock=lambda: DUE)


def told(outbox: Outbox) -> list[dict[str, Any]]:
    """All that waits, which then waits no longer."""
    found = []
    while (notice := outbox.oldest("webhook")) is not None:
        found.append(dict(notice.body))
        outbox.sent(notice)
    return found


def run(state: RunState, *, count: int = 1) -> Run:
    return Run(4, SCHEDULE.id, DUE, state, "rig busy: a scan", count, 1, DUE, None, None, None, None)


def test_runs_that_need_a_person_give_a_notice_and_no_others(database: Database, outbox: Outbox) -> None:
    with database.changing() as session:
        for state in RunState:
            tell_run(outbox, session, SCHEDULE, run(state, count=3))
    sent = told(outbox)
    assert len(sent) == len(TOLD)
    assert {each["kind"] for each in sent} == {"run.missed", "run.skipped", "run.failed", "run.interrupted"}
    skipped = next(each for each in sent if each["kind"] == "run.skipped")
    assert skipped["words"] == (
        "rig 'bench': verification due 2026-11-23 06:30 +0100 was skipped, 3 times: rig busy: a scan"
    )
    assert skipped["run"] == {
        "number": 4, "due": DUE.isoformat(), "state": "skipped", "reason": "rig busy: a scan", "count": 3,
    }  # fmt: skip
    assert skipped["schedule"]["id"] == str(SCHEDULE.id)
    assert (skipped["at"], skipped["rig"]) == ("2026-11-23T05:30:00.000+00:00", "bench")
    assert len({each["id"] for each in sent}) == len(sent)


def test_health_gives_a_notice_when_it_changes(database: Database, outbox: Outbox) -> None:
    health = NoticedHealth(database, outbox)
    knocked = a_verification(6.0, evidence=400.0)
    for hour, look in enumerate([a_verification(), a_verification(), knocked, knocked]):
        health.add(look, calibration="one", at=hours(hour))
    health.add(a_verification(), calibration="two", at=hours(9))
    first, second = told(outbox)
    assert (first["kind"], first["health"]["before"], first["health"]["state"]) == ("health.changed", "good", "stale")
    assert "turned by 0.050" in first["words"]
    assert (second["health"]["before"], second["health"]["state"]) == ("stale", "good")


def test_end_of_a_job_of_any_kind_gives_one_notice(database: Database, outbox: Outbox) -> None:
    parent, at = uuid4(), JobState
    fault = JobFailure("pose-refused", "no board is in view")
    made: list[tuple[JobKind, dict[str, Any], UUID | None, JobState, dict[str, str]]] = [
        (JobKind.SCAN, {}, None, at.SUCCEEDED, {"self": "/scan/{id}", "events": "/scan/{id}/events"}),
        (JobKind.SCAN, {}, parent, at.CANCELLED, {
            "self": "/scan/{id}", "events": "/scan/{id}/events", "series": "/scan/series/{parent}",
        }),
        (JobKind.POSE, {"number": 3}, parent, at.FAILED, {
            "self": "/calibration/{parent}/pose/3", "events": "/calibration/{parent}/events",
            "calibration": "/calibration/{parent}",
        }),
        (JobKind.SOLVE, {"number": 1}, parent, at.INTERRUPTED, {
            "self": "/calibration/{parent}", "events": "/calibration/{parent}/events",
            "calibration": "/calibration/{parent}",
        }),
        (JobKind.VERIFICATION, {}, None, at.SUCCEEDED, {
            "self": "/rig/verification/{id}", "events": "/rig/verification/{id}/events",
        }),
        (JobKind.POSITION, {}, parent, at.SUCCEEDED, {
            "self": "/acceptance/{parent}", "acceptance": "/acceptance/{parent}",
        }),
    ]  # fmt: skip
    for kind, plan, of, state, links in made:
        jobs = JobStore(database, kind, outbox=outbox, clock=lambda: DUE)
        with acting_as("Ann"):
            job = jobs.create(plan, rig="bench", label="by hand", parent=of)
        jobs.advance(job.id, JobState.CAPTURING)
        assert told(outbox) == [], "it has not ended"
        jobs.finish(job.id, state, fault=fault if state is at.FAILED else None)
        assert not jobs.finish(job.id, JobState.FAILED)
        (one,) = told(outbox)
        assert (one["kind"], one["job"]["kind"], one["job"]["state"]) == ("job.ended", kind, state)
        assert (one["job"]["id"], one["job"]["label"], one["job"]["requested_by"]) == (str(job.id), "by hand", "Ann")
        assert one["job"]["links"] == {
            name: link.format(id=job.id, parent=parent) for name, link in links.items()
        }, kind  # fmt: skip
        assert one["job"]["finished_at"] == one["job"]["started_at"] == "2026-11-23T05:30:00.000+00:00"
        assert one["job"]["error"] == (
            {"code": "pose-refused", "message": "no board is in view"} if state is at.FAILED else None
        )  # fmt: skip
    assert one["words"] == f"rig 'bench': position {job.id} succeeded"


def test_end_and_notice_are_recorded_together_or_not_at_all(
    database: Database, outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = JobStore(database, JobKind.SCAN, outbox=outbox)
    job = jobs.create({}, rig="bench", label=None)

    def put(*_: object, **__: object) -> None:
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(outbox, "put", put)
        with pytest.raises(PowerCut):
            jobs.finish(job.id, JobState.SUCCEEDED)
    assert jobs.get(job.id).state is JobState.QUEUED
    assert [event.kind for event in jobs.events(job.id, after=0)] == ["state"]

    ended = outbox.ended

    def cut_off(session: Session, job: JobRecord) -> None:
        ended(session, job)
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(outbox, "ended", cut_off)
        with pytest.raises(PowerCut):
            jobs.finish(job.id, JobState.SUCCEEDED)
    assert (told(outbox), outbox.news["webhook"].is_set()) == ([], False)
    jobs.finish(job.id, JobState.SUCCEEDED)
    assert outbox.news["webhook"].is_set()
    assert [each["job"]["state"] for each in told(outbox)] == ["succeeded"]


def test_kinds_that_are_not_wanted_are_not_kept(database: Database) -> None:
    outbox = Outbox(database, rig="bench", wanted={"webhook": ["run.failed"]})
    jobs = JobStore(database, JobKind.SCAN, outbox=outbox)
    jobs.finish(jobs.create({}, rig="bench", label=None).id, JobState.SUCCEEDED)
    with database.changing() as session:
        tell_run(outbox, session, SCHEDULE, run(RunState.MISSED))
        tell_run(outbox, session, SCHEDULE, run(RunState.FAILED))
    assert [each["kind"] for each in told(outbox)] == ["run.failed"]

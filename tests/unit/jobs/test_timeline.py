"""What a job did when, told by its record."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.jobs.timeline import Stage, stages_of

START = datetime(2026, 11, 20, 6, tzinfo=UTC)


class Clock:
    """Goes forward when told."""

    def __init__(self) -> None:
        self.now = START

    def __call__(self) -> datetime:
        return self.now

    def forward(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[JobStore]:
    store = JobStore(Database(tmp_path / "slrig.sqlite"), JobKind.SCAN, clock=clock)
    yield store
    store.database.close()


def spans(stages: Iterator[Stage]) -> list[tuple[str, float, float, str | None]]:
    return [(stage.name, (stage.begin - START).total_seconds(), stage.seconds, stage.inside) for stage in stages]


def test_job_that_ends_is_told_with_its_stages(store: JobStore, clock: Clock) -> None:
    told: list[JobRecord] = []
    store.after_end = told.append
    job = store.create({}, rig="bench", label=None).id
    clock.forward(2)
    store.advance(job, JobState.CAPTURING)
    clock.forward(5)
    store.progress(job, JobProgress("capture", 0.5, ""))
    store.advance(job, JobState.COMPUTING)
    clock.forward(10)
    assert told == []
    assert store.finish(job, JobState.SUCCEEDED, summary={"stages_s": {"decode": 3.0, "mesh": 6.5}})
    assert not store.finish(job, JobState.FAILED)
    (record,) = told
    assert record == store.get(job)
    assert spans(stages_of(record, store.events(job, after=0))) == [
        ("queued", 0, 2, None),
        ("capturing", 2, 5, None),
        ("computing", 7, 10, None),
        ("decode", 7, 3, "computing"),
        ("mesh", 10, 6.5, "computing"),
    ]


def test_job_that_never_began_only_waited(store: JobStore, clock: Clock) -> None:
    job = store.create({}, rig="bench", label=None).id
    clock.forward(4)
    store.finish(job, JobState.CANCELLED)
    assert spans(stages_of(store.get(job), store.events(job, after=0))) == [("queued", 0, 4, None)]

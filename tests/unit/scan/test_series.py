"""A series of scans: one request, a scan every so often, others in between."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from uuid import UUID, uuid4

import pytest

from slrig.errors import JobNotFoundError
from slrig.jobs.records import JobRecord, JobState, utc_now
from slrig.scan.plan import ScanPlan, SeriesPlace, series_of
from slrig.scan.records import plan_from_json, plan_json
from tests.unit.scan.bench import Bench

HOUR_S = 3600.0


def begun(bench: Bench, *, repeat: int, every_s: float = 0.0) -> list[JobRecord]:
    """The scans of a series that was sent."""
    first = bench.runner.submit(ScanPlan(), label="series", wait=False, repeat=repeat, every_s=every_s)
    assert first.parent is not None
    scans = bench.runner.series(first.parent)
    assert scans[0].id == first.id
    return scans


def place(record: JobRecord) -> SeriesPlace:
    found = plan_from_json(record.plan).series
    assert found is not None
    return found


def test_scans_of_a_series_are_shot_one_after_the_other(bench: Bench) -> None:
    scans = begun(bench, repeat=4)
    assert [(place(each).number, place(each).count, place(each).id) for each in scans] == [
        (number, 4, scans[0].parent) for number in (1, 2, 3, 4)
    ]
    ended = [bench.until(each.id) for each in scans]
    assert {each.state for each in ended} == {JobState.SUCCEEDED}
    starts = [each.started_at for each in ended if each.started_at is not None]
    assert starts == sorted(starts)


def test_each_scan_waits_for_its_time_and_others_pass_it(bench: Bench) -> None:
    first, second = begun(bench, repeat=2, every_s=HOUR_S)
    assert place(second).due_at - place(first).due_at == timedelta(seconds=HOUR_S)
    bench.until(first.id)
    # The rig is free, and nobody waits for it now.
    status = bench.runner.status()
    assert (status.holder, status.waiting) == (None, 0)
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert bench.store.get(second.id).state is JobState.QUEUED


def test_a_scan_begins_by_itself_when_its_time_has_come(bench: Bench) -> None:
    first, second = begun(bench, repeat=2, every_s=0.05)
    assert bench.until(second.id).state is JobState.SUCCEEDED
    started = bench.store.get(second.id).started_at
    assert started is not None
    assert started >= place(second).due_at - timedelta(milliseconds=1)
    assert bench.until(first.id).state is JobState.SUCCEEDED


def test_a_series_is_cancelled_as_a_whole_and_what_is_done_stays(bench: Bench) -> None:
    first, *others = begun(bench, repeat=3, every_s=HOUR_S)
    bench.until(first.id)
    assert first.parent is not None
    assert [each.state for each in bench.runner.cancel_series(first.parent)] == [
        JobState.SUCCEEDED, JobState.CANCELLED, JobState.CANCELLED,
    ]  # fmt: skip
    assert [bench.store.get(each.id).state for each in others] == [JobState.CANCELLED] * 2
    bench.runner.cancel_series(first.parent)
    with pytest.raises(JobNotFoundError, match="No series"):
        bench.runner.cancel_series(uuid4())


def test_a_series_goes_on_after_a_restart(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    series = UUID(int=7)
    plans = series_of(ScanPlan(), series, count=2, every_s=HOUR_S, begins_at=utc_now() - timedelta(seconds=60))
    due, later = bench.store.create_series([plan_json(each) for each in plans], rig="bench", label=None, parent=series)
    bench.runner.take_up([due.id, later.id])
    bench.runner.start()
    assert bench.until(due.id).state is JobState.SUCCEEDED
    assert bench.store.get(later.id).state is JobState.QUEUED
    bench.close()
    # And once more, as the end of a service leaves it.
    assert bench.store.get(later.id).state is JobState.QUEUED

"""Records that the disk refuses for a while: whatever is refused, every scan after it is its own."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.orm import Session

from slrig.errors import StorageError
from slrig.jobs import database, endings
from slrig.jobs.records import JobRecord, JobState
from tests.unit.scan.bench import Bench

MOST_WRITES = 12
"""More than a scan of the tame bench makes: created, three states, a few steps."""

Changing = Callable[..., AbstractContextManager[Session]]


def full(_bench: Bench, _real: Changing, **_options: Any) -> AbstractContextManager[Session]:
    message = "The service's records could not be used: database or disk is full."
    raise StorageError(message)


@contextmanager
def locked(bench: Bench, real: Changing, **options: Any) -> Iterator[Session]:
    """Another program has begun to write, and goes on for longer than anybody waits."""
    other = sqlite3.connect(bench.folder.database, isolation_level=None)
    try:
        other.execute("BEGIN IMMEDIATE")
        with real(**options) as session:
            yield session
    finally:
        other.close()


@contextmanager
def read_only(_: Bench, real: Changing, **options: Any) -> Iterator[Session]:
    with real(**options) as session:
        cursor = session.connection().connection.cursor()
        cursor.execute("PRAGMA query_only=ON")
        try:
            yield session
            session.flush()
        finally:
            cursor.execute("PRAGMA query_only=OFF")


def assert_own(bench: Bench, record: JobRecord) -> None:
    """The scan has its own files, and its own report."""
    report = json.loads((bench.folder.scan(record.id) / "report.json").read_bytes())
    assert (bench.folder.scan(record.id) / "mesh.ply").is_file()
    assert report["bundle"] == str(record.id)
    assert record.summary is not None
    assert record.summary["bundle"] == str(record.id)


@pytest.mark.parametrize("refused", [full, locked, read_only])
@pytest.mark.parametrize("lasting", [1, 3])
def test_a_refused_record_poisons_no_later_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Any, lasting: int
) -> None:
    monkeypatch.setattr(database, "PATIENCE_S", 0.01)
    monkeypatch.setattr(endings, "RETRY_S", 0.01)
    bench = Bench(tmp_path)
    bench.runner.start()
    real, writes = bench.store.database.changing, 0
    at: range = range(0)

    def changing(**options: Any) -> AbstractContextManager[Session]:
        nonlocal writes
        writes += 1
        return refused(bench, real, **options) if writes in at else real(**options)

    monkeypatch.setattr(bench.store.database, "changing", changing)
    seen = set()
    for first in range(1, MOST_WRITES + 1):
        writes, at = 0, range(first, first + lasting)
        try:
            hurt = bench.scan(wait=True)
        except StorageError:
            # It was told, and nothing was begun.
            assert first == 1
            hurt = None
        if hurt is not None:
            record = bench.until(hurt.id)
            seen.add(record.state)
            assert record.state in {JobState.SUCCEEDED, JobState.FAILED}
            if record.state is JobState.SUCCEEDED:
                assert_own(bench, record)
        at = range(0)
        for _ in range(2):
            record = bench.until(bench.scan(wait=True).id)
            assert record.state is JobState.SUCCEEDED, record.fault
            assert_own(bench, record)
    assert seen == {JobState.SUCCEEDED, JobState.FAILED}
    assert list(bench.folder.incoming.iterdir()) == []
    bench.close()

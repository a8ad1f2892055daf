"""The service's database: its tables, and the files that it refuses."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, text

from slrig.errors import StorageError
from slrig.jobs.database import Database, sqlite_engine
from slrig.jobs.tables import Base


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "slrig.sqlite"


def test_migrations_give_the_tables_that_the_code_uses(path: Path) -> None:
    for _ in range(2):
        Database(path).close()
    engine = create_engine(f"sqlite:///{path}")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        assert connection.execute(text("PRAGMA journal_mode")).scalar() == "wal"
    engine.dispose()


def test_what_a_power_cut_may_undo_is_not_brought_to_disk_by_itself(path: Path) -> None:
    database, found = Database(path), []
    for passing in (False, True, False):
        with database.changing(passing=passing) as session:
            found.append(session.scalar(text("PRAGMA synchronous")))
    database.close()
    assert found == [2, 1, 2]  # FULL, NORMAL


def test_programs_that_open_a_new_file_together_wait_for_one_another(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with sqlite3.connect(path) as other:
        other.execute("CREATE TABLE other_program (number INTEGER)")
    other.execute("BEGIN IMMEDIATE")
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        other.rollback()

    monkeypatch.setattr("slrig.jobs.database.time.sleep", wait)
    engine = sqlite_engine(path)
    with engine.connect() as connection:
        assert connection.execute(text("PRAGMA journal_mode")).scalar() == "wal"
    engine.dispose()
    other.close()
    assert len(waits) == 1


def test_file_that_is_no_database_is_refused(path: Path) -> None:
    path.write_bytes(b"not a database, for certain" * 100)
    with pytest.raises(StorageError, match=r"slrig\.sqlite"):
        Database(path)


@pytest.mark.parametrize("version", ["0001", "records99"])
def test_records_of_another_version_are_refused_and_left_as_they_are(path: Path, version: str) -> None:
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)")
        file.execute("INSERT INTO alembic_version VALUES (?)", [version])
    file.close()
    with pytest.raises(StorageError, match=rf"of version {version}.*Move that file out of the data folder.*--data"):
        Database(path)
    with sqlite3.connect(path) as file:
        assert file.execute("SELECT name FROM sqlite_master").fetchall() == [("alembic_version",)]
    file.close()

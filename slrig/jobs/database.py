"""The service's SQLite database: write-ahead log, synchronous FULL, so that what was answered survives a power cut."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.orm import Session

from slrig.errors import StorageError

PATIENCE_S = 10.0
"""How long a change waits for another program that has the file locked, as some backups do. A person who asked waits as
long."""

_PATIENCE = "slrig_patience_ms"


class Database:
    """The file with every record of the service, and its tables. Safe to call from any thread.

    A change holds the file's one write lock from its first statement on: what it reads is what it changes, whatever
    another thread or process does meanwhile.

    Raises
    ------
    StorageError
        The disk refuses: here, and wherever it is read or changed. Or another version of slrig wrote the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._writing = threading.Lock()
        self._engine = create_engine(f"sqlite:///{path}")
        event.listen(self._engine, "connect", _set_up)
        event.listen(self._engine, "begin", _begin)
        with self._refusals(), self._writer(PATIENCE_S).begin() as connection:
            _upgrade(connection, path)

    def close(self) -> None:
        """Let the file go. Idempotent."""
        self._engine.dispose()

    def _writer(self, patience_s: float) -> Engine:
        return self._engine.execution_options(**{_PATIENCE: int(1000 * patience_s)})

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the file."""
        with self._refusals(), Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def changing(self, *, patience_s: float | None = None) -> Iterator[Session]:
        """A session whose changes are kept, all of them, when the block ends without an error.

        patience_s : how long to wait for another program that has the file locked; None stands for `PATIENCE_S`.
        """
        writer = self._writer(PATIENCE_S if patience_s is None else patience_s)
        # SQLite has one writer; a lock here keeps a second thread from ever seeing "database is locked".
        with self._refusals(), self._writing, Session(writer, expire_on_commit=False) as session, session.begin():
            yield session

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except DatabaseError as error:
            if not isinstance(error, OperationalError) and type(error) is not DatabaseError:
                # A broken constraint or statement is a defect of ours, not the disk's.
                raise
            remedy = "Check that its disk has free space and can be written."
            if "locked" in str(error.orig):
                remedy = (
                    "Another program, perhaps a backup, keeps them locked: end it, or have it copy them with SQLite's "
                    "own backup, which locks nothing."
                )
            message = f"The service's records {self.path} could not be used: {error.orig}. {remedy}"
            raise StorageError(message) from error


def _set_up(connection: DBAPIConnection, _record: object) -> None:
    # The driver begins no transactions of its own: `_begin` does.
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"busy_timeout={int(1000 * PATIENCE_S)}"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin(connection: Connection) -> None:
    patience_ms = connection.get_execution_options().get(_PATIENCE)
    if patience_ms is not None:
        connection.exec_driver_sql(f"PRAGMA busy_timeout={patience_ms}")
    connection.exec_driver_sql("BEGIN" if patience_ms is None else "BEGIN IMMEDIATE")


def _upgrade(connection: Connection, path: Path) -> None:
    """Bring the tables up to date by the scripts of `slrig.jobs.migrations`. Does nothing when they are."""
    config = Config()
    config.set_main_option("script_location", "slrig.jobs:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    if found := set(MigrationContext.configure(connection).get_current_heads()) - known:
        message = (
            f"{path} was written by another version of slrig (its records are of version {', '.join(sorted(found))}), "
            "and this one cannot read it. Move that file out of the data folder: finished scans and calibrations are "
            "found again by their own files, schedules have to be made anew. Or name another folder with --data."
        )
        raise StorageError(message)
    command.upgrade(config, "head")

"""The service's SQLite database: write-ahead log, synchronous FULL, so that what was answered survives a power cut."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, create_engine, event
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.orm import Session

from slrig.errors import StorageError

_WRITING = "slrig_writing"


class Database:
    """One file, opened by one part of the service, which brings its own tables. Safe to call from any thread.

    A change holds the file's one write lock from its first statement on: what it reads is what it changes, whatever
    another thread or process does meanwhile.

    Raises
    ------
    StorageError
        The disk refuses: here, and wherever it is read or changed.
    """

    def __init__(self, path: Path, *, upgrade: Callable[[Connection], None]) -> None:
        """`upgrade` brings the part's tables up to date."""
        self.path = path
        self._writing = threading.Lock()
        self._engine = create_engine(f"sqlite:///{path}")
        event.listen(self._engine, "connect", _set_up)
        event.listen(self._engine, "begin", _begin)
        self._writer = self._engine.execution_options(**{_WRITING: True})
        with self._refusals(), self._writer.begin() as connection:
            upgrade(connection)

    def close(self) -> None:
        """Let the file go. Idempotent."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the file."""
        with self._refusals(), Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def changing(self) -> Iterator[Session]:
        """A session whose changes are kept, all of them, when the block ends without an error."""
        # SQLite has one writer; a lock here keeps a second thread from ever seeing "database is locked".
        with self._refusals(), self._writing, Session(self._writer, expire_on_commit=False) as session, session.begin():
            yield session

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except DatabaseError as error:
            if not isinstance(error, OperationalError) and type(error) is not DatabaseError:
                # A broken constraint or statement is a defect of ours, not the disk's.
                raise
            message = (
                f"The service's records {self.path} could not be used: {error.orig}. "
                "Check that its disk has free space and can be written."
            )
            raise StorageError(message) from error


def _set_up(connection: DBAPIConnection, _record: object) -> None:
    # The driver begins no transactions of its own: `_begin` does.
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=5000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin(connection: Connection) -> None:
    writing = connection.get_execution_options().get(_WRITING, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def run_migrations(connection: Connection, package: str) -> None:
    """Bring the tables behind `connection` up to date by the Alembic scripts in `package`, as "slrig.scan:migrations".

    Does nothing when they are.
    """
    config = Config()
    config.set_main_option("script_location", package)
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")

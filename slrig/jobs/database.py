"""The service's SQLite database: write-ahead log, synchronous FULL, so that what was answered outlasts a power cut."""

from __future__ import annotations

import random
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, MetaData, create_engine, event
from sqlalchemy.engine.interfaces import DBAPIConnection, DBAPICursor
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.orm import Session

from slrig.errors import StorageError
from slrig.jobs.tables import Base

PATIENCE_S = 10.0
"""How long a change waits for another program that has the file locked, as some backups do. A person who asked waits as
long."""

PASSING_PATIENCE_S = 0.2
"""How long a change waits that may be lost: the work waits meanwhile."""

_PATIENCE, _SYNCHRONOUS = "slrig_patience_ms", "slrig_synchronous"


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
        self._engine = sqlite_engine(path)
        with self._refusals(), writing(self._engine, PATIENCE_S).begin() as connection:
            if unknown := upgrade(connection, "slrig.jobs:migrations/versions", Base.metadata):
                message = (
                    f"{path} was written by another version of slrig (its records are of version {unknown}), and this "
                    "one cannot read it. Move that file out of the data folder: finished scans and calibrations are "
                    "found again by their own files, schedules have to be made anew. Or name another folder with "
                    "--data."
                )
                raise StorageError(message)

    def close(self) -> None:
        """Let the file go. Idempotent."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the file."""
        with self._refusals(), Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def changing(self, *, passing: bool = False) -> Iterator[Session]:
        """A session whose changes are kept, all of them, when the block ends without an error.

        passing : a change that a power cut may undo, as how far a job is: it reaches the disk with the next one that is
        to last, and is refused where another program has the file locked. A slow disk takes 10 ms and more to sync.
        """
        patience_s, synchronous = (PASSING_PATIENCE_S, "NORMAL") if passing else (PATIENCE_S, "FULL")
        writer = writing(self._engine, patience_s, synchronous)
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


def sqlite_engine(path: Path) -> Engine:
    """A SQLite file with a write-ahead log; what was committed survives a power cut."""
    engine = create_engine(f"sqlite:///{path}")
    event.listen(engine, "connect", _set_up)
    event.listen(engine, "begin", _begin)
    return engine


def writing(engine: Engine, patience_s: float, synchronous: str = "FULL") -> Engine:
    """The same file, whose transactions have its one write lock from their beginning; how long they wait for it.

    synchronous : of SQLite's words, which is the least that lasts through a power cut.
    """
    return engine.execution_options(**{_PATIENCE: int(1000 * patience_s), _SYNCHRONOUS: synchronous})


def _set_up(connection: DBAPIConnection, _record: object) -> None:
    # The driver begins no transactions of its own: `_begin` does.
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in (f"busy_timeout={int(1000 * PATIENCE_S)}", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    _begin_log(cursor)
    cursor.close()


def _begin_log(cursor: DBAPICursor) -> None:
    """Have the file keep a write-ahead log, as it does ever after.

    Of programs that do so at the same moment SQLite refuses all but one at once, whatever its `busy_timeout`: those
    hold locks that the one waits for. They let theirs go and ask again.
    """
    given_up = time.monotonic() + PATIENCE_S
    while True:
        try:
            cursor.execute("PRAGMA journal_mode=WAL")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > given_up:
                raise
        else:
            return
        time.sleep(random.uniform(0.001, 0.02))  # not all at the same moment again


def _begin(connection: Connection) -> None:
    options = connection.get_execution_options()
    patience_ms = options.get(_PATIENCE)
    if patience_ms is not None:
        connection.exec_driver_sql(f"PRAGMA busy_timeout={patience_ms}")
        connection.exec_driver_sql(f"PRAGMA synchronous={options[_SYNCHRONOUS]}")
    connection.exec_driver_sql("BEGIN" if patience_ms is None else "BEGIN IMMEDIATE")


def upgrade(connection: Connection, scripts: str, tables: MetaData) -> str:
    """Bring tables up to date by Alembic's scripts in `PACKAGE:FOLDER`. Does nothing when they are; changes nothing,
    and returns the versions that the scripts do not know, where another slrig made them, else "".
    """
    config = Config()
    config.set_main_option("script_location", "slrig.jobs:migrations")
    config.set_main_option("version_locations", scripts)
    config.set_main_option("path_separator", "newline")
    config.attributes.update(connection=connection, tables=tables)
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    unknown = set(MigrationContext.configure(connection).get_current_heads()) - known
    if not unknown:
        command.upgrade(config, "head")
    return ", ".join(sorted(unknown))

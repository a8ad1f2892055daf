"""The service's SQLite database and its tables: write-ahead log, synchronous FULL, so answers survive power cuts.

An unreadable row causes no error of other rows; a damaged file is moved aside, and its readable rows are copied into a
new one.
"""

from __future__ import annotations

import random
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar
from uuid import UUID, uuid4

import structlog
from sqlalchemy import (
    JSON,
    Boolean,
    Column,
    Connection,
    Engine,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
    create_engine,
    delete,
    event,
    insert,
    inspect,
    select,
)
from sqlalchemy.engine.interfaces import DBAPIConnection, DBAPICursor
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from slrig.bundle import stored_json
from slrig.errors import InvalidInputError, StorageError
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.records import UNREADABLE, JobKind, JobProgress, JobRecord, JobState

CHANGES: Mapping[str, Sequence[str]] = {
    "records2": (),
    "records3": ("ALTER TABLE job ADD COLUMN requested_by VARCHAR(80)",),
    "records4": (
        "CREATE TABLE notice (number INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, id VARCHAR(36) NOT NULL, "
        "at VARCHAR(32) NOT NULL, kind VARCHAR(32) NOT NULL, body JSON NOT NULL)",
    ),
    "records5": ("ALTER TABLE notice ADD COLUMN receiver VARCHAR(16) DEFAULT 'webhook' NOT NULL",),
    "records6": (),
    "records7": ("ALTER TABLE job ADD COLUMN attempts INTEGER DEFAULT '0' NOT NULL",),
}
"""See `upgrade`. Databases from before these call their state 0001."""


class Base(DeclarativeBase):
    """Holds the metadata."""


class JobRow(Base):
    """One job of any kind. parent : the calibration or the acceptance test that it belongs to, if it belongs to one.
    pinned : no retention removes it. attempts : how often the worker began it. requested_by : the name of the key, or
    the schedule, that requested it.
    """

    __tablename__ = "job"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
    kind: Mapped[str] = mapped_column(String(16))
    parent: Mapped[str | None] = mapped_column(String(36))
    state: Mapped[str] = mapped_column(String(16))
    label: Mapped[str | None] = mapped_column(String(200))
    rig: Mapped[str] = mapped_column(String(200))
    plan: Mapped[dict[str, Any]] = mapped_column(JSON)
    created_at: Mapped[str] = mapped_column(String(32))
    started_at: Mapped[str | None] = mapped_column(String(32))
    finished_at: Mapped[str | None] = mapped_column(String(32))
    stage: Mapped[str] = mapped_column(String(64))
    fraction: Mapped[float] = mapped_column(Float)
    detail: Mapped[str] = mapped_column(String)
    failure_code: Mapped[str | None] = mapped_column(String(64))
    failure_message: Mapped[str | None] = mapped_column(String)
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    last_event: Mapped[int] = mapped_column(Integer)
    pinned: Mapped[bool] = mapped_column(Boolean)
    attempts: Mapped[int] = mapped_column(Integer, default=0, server_default="0")
    requested_by: Mapped[str | None] = mapped_column(String(80))

    __table_args__ = (
        Index("ix_job_kind_state", "kind", "state"),
        Index("ix_job_parent", "parent"),
        {"sqlite_autoincrement": True},
    )


class EventRow(Base):
    """One event of one job; `number` counts from 1 within the job, `id` rises over the events of all jobs."""

    __tablename__ = "event"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"))
    number: Mapped[int] = mapped_column(Integer)
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = (UniqueConstraint("job_id", "number", name="uq_event_number"), {"sqlite_autoincrement": True})


class KeyRow(Base):
    """One idempotency key, with the kind of request that it came with. `job_id` is empty while the first request is
    being answered.

    No foreign key: a job may be deleted before its key expires, and a late repeat must not start it again.
    """

    __tablename__ = "idempotency_key"

    key: Mapped[str] = mapped_column(String(400), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    job_id: Mapped[str | None] = mapped_column(String(36))
    created_at: Mapped[str] = mapped_column(String(32))


class AuditRow(Base):
    """One request that changed something, or tried to, and who sent it from where."""

    __tablename__ = "audit"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    at: Mapped[str] = mapped_column(String(32))
    who: Mapped[str] = mapped_column(String(80))
    address: Mapped[str] = mapped_column(String(64))
    method: Mapped[str] = mapped_column(String(16))
    path: Mapped[str] = mapped_column(String(400))
    status: Mapped[int] = mapped_column(Integer)
    made: Mapped[str] = mapped_column(String(400))

    __table_args__ = ({"sqlite_autoincrement": True},)


class NoticeRow(Base):
    """One notice that waits to be sent to one receiver; `number` is their order, `id` what it is known by there."""

    __tablename__ = "notice"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    receiver: Mapped[str] = mapped_column(String(16))
    id: Mapped[str] = mapped_column(String(36))
    at: Mapped[str] = mapped_column(String(32))
    kind: Mapped[str] = mapped_column(String(32))
    body: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = ({"sqlite_autoincrement": True},)


class CopyRow(Base):
    """One finished job that a catalogue has not taken yet; `number` is the order in which they ended."""

    __tablename__ = "job_copy"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    at: Mapped[str] = mapped_column(String(32))
    job_id: Mapped[str] = mapped_column(String(36))
    body: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = ({"sqlite_autoincrement": True},)


class ScheduleRow(Base):
    """One schedule."""

    __tablename__ = "schedule"

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    label: Mapped[str | None] = mapped_column(String(200))
    cron: Mapped[str] = mapped_column(String(200))
    time_zone: Mapped[str] = mapped_column(String(64))
    task: Mapped[str] = mapped_column(String(16))
    options: Mapped[dict[str, Any]] = mapped_column(JSON)
    grace_s: Mapped[float] = mapped_column(Float)
    retry_s: Mapped[float] = mapped_column(Float)
    catch_up: Mapped[bool] = mapped_column(Boolean)
    enabled: Mapped[bool] = mapped_column(Boolean)
    created_at: Mapped[str] = mapped_column(String(32))
    next_due: Mapped[str] = mapped_column(String(32))


class RunRow(Base):
    """One due time of a schedule. `owner` is the process that runs it or waits with it."""

    __tablename__ = "run"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    schedule_id: Mapped[str] = mapped_column(ForeignKey("schedule.id", ondelete="CASCADE"))
    due: Mapped[str] = mapped_column(String(32))
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str | None] = mapped_column(String)
    count: Mapped[int] = mapped_column(Integer)
    attempts: Mapped[int] = mapped_column(Integer)
    deadline: Mapped[str] = mapped_column(String(32))
    next_attempt: Mapped[str | None] = mapped_column(String(32))
    started_at: Mapped[str | None] = mapped_column(String(32))
    finished_at: Mapped[str | None] = mapped_column(String(32))
    owner: Mapped[str | None] = mapped_column(String(36))
    alive_until: Mapped[str | None] = mapped_column(String(32))
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        UniqueConstraint("schedule_id", "due", name="uq_run_due"),
        Index("ix_run_state", "state"),
        {"sqlite_autoincrement": True},
    )


class VerificationRow(Base):
    """The verdict of a verification, or of a scan's redundancy, on a calibration. `found` : `Verification.document`."""

    __tablename__ = "verification"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(36), unique=True)
    at: Mapped[str] = mapped_column(String(32))
    calibration: Mapped[str] = mapped_column(String(80))
    kind: Mapped[str] = mapped_column(String(16))
    state: Mapped[str] = mapped_column(String(16))
    reasons: Mapped[list[str]] = mapped_column(JSON)
    remedy: Mapped[str | None] = mapped_column(String)
    found: Mapped[dict[str, Any]] = mapped_column(JSON)

    __table_args__ = (
        Index("ix_verification_calibration", "calibration", "number"),
        Index("ix_verification_at", "at"),
        {"sqlite_autoincrement": True},
    )


_log = structlog.get_logger(__name__)

_Row = TypeVar("_Row", bound=Base)
_Read = TypeVar("_Read")


class _UnreadableJson(dict[str, Any]):
    """Represents a text in a column of JSON that is not JSON."""


def _from_json(text: str | bytes) -> Any:
    try:
        return stored_json(text)
    except ValueError:
        return _UnreadableJson()


def readable(rows: Iterable[_Row], read: Callable[[_Row], _Read]) -> Iterator[_Read]:
    """Rows converted by `read`, without those that it cannot read: the log has these."""
    for row in rows:
        try:
            yield read(row)
        except (ValueError, TypeError, KeyError, AttributeError, InvalidInputError) as error:
            _log.error(
                "a damaged record is left out", table=row.__tablename__, row=inspect(row).identity, cause=str(error)
            )


def record_of(row: JobRow) -> JobRecord:
    """A row as the record that it is; one that cannot be read as a job that failed by `UNREADABLE`, and that no
    retention removes.
    """
    try:
        return _readable_record(row)
    except (ValueError, TypeError):
        label = row.label if isinstance(row.label, str) else None
        return JobRecord(
            number=row.number,
            id=or_none(UUID, row.id) or UUID(int=row.number),
            kind=JobKind(row.kind),
            state=JobState.FAILED,
            label=label,
            rig=str(row.rig),
            plan={},
            created_at=or_none(datetime.fromisoformat, row.created_at) or datetime.fromtimestamp(0, UTC),
            started_at=or_none(datetime.fromisoformat, row.started_at),
            finished_at=or_none(datetime.fromisoformat, row.finished_at),
            progress=JobProgress("", 0.0, ""),
            fault=UNREADABLE,
            summary=None,
            pinned=True,
            parent=or_none(UUID, row.parent),
        )


def _readable_record(row: JobRow) -> JobRecord:
    for document in (row.plan, row.summary or {}):
        if isinstance(document, _UnreadableJson) or not isinstance(document, dict):
            message = "a plan or a summary that is not a JSON object"
            raise TypeError(message)
    return JobRecord(
        number=row.number,
        id=UUID(row.id),
        kind=JobKind(row.kind),
        state=JobState(row.state),
        label=row.label,
        rig=row.rig,
        plan=row.plan,
        created_at=datetime.fromisoformat(row.created_at),
        started_at=_moment(row.started_at),
        finished_at=_moment(row.finished_at),
        progress=JobProgress(row.stage, float(row.fraction), row.detail),
        fault=None if row.failure_code is None else JobFailure(row.failure_code, row.failure_message or ""),
        summary=row.summary,
        pinned=row.pinned,
        parent=None if row.parent is None else UUID(row.parent),
        requested_by=row.requested_by,
    )


def or_none(read: Callable[[str], _Read], text: str | None) -> _Read | None:
    """The value read from a text; None where it cannot be read."""
    try:
        return None if text is None else read(text)
    except (ValueError, TypeError, AttributeError):
        return None


def _moment(stamp: str | None) -> datetime | None:
    return None if stamp is None else datetime.fromisoformat(stamp)


PATIENCE_S = 10.0
"""Longest wait of a change for another program that has the file locked, as some backups do. Requests wait as long."""

PASSING_PATIENCE_S = 0.2
"""Longest wait of a change that may be lost: the work waits meanwhile."""

_PATIENCE, _SYNCHRONOUS = "slrig_patience_ms", "slrig_synchronous"


class Database:
    """The file with every record of the service, and its tables. Safe to call from any thread.

    A change holds the file's one write lock from its first statement on: no other thread or process changes what it
    has read.

    aside : where a damaged file is moved; a new one takes its place, with what could be read of it.

    Raises
    ------
    StorageError
        The disk refuses: here, and wherever it is read or changed. Or another version of slrig wrote the file.
    """

    def __init__(self, path: Path, *, aside: Path | None = None) -> None:
        self.path = path
        self._writing = threading.Lock()
        found = _damage_of(path)
        if found is not None:
            damaged = _put_aside(path, (aside or path.parent) / f"{path.name}-damaged-{uuid4().hex[:8]}")
        self._engine = sqlite_engine(path)
        with self._refusals(), writing(self._engine, PATIENCE_S).begin() as connection:
            if unknown := upgrade(connection, Base.metadata, CHANGES):
                message = (
                    f"{path} was written by another version of slrig (its records are of version {unknown}), and this "
                    "one cannot read it. Move that file out of the data folder: finished scans and calibrations are "
                    "found again by their own files, schedules have to be made again. Or name another folder with "
                    "--data."
                )
                raise StorageError(message)
        if found is not None:
            rows = _salvage(damaged, path)
            _log.error(
                "the records were damaged; what could be read of them is kept, and finished jobs come back by "
                "their files: check the disk, and make missing schedules again",
                cause=found, moved_to=str(damaged), rows=rows,
            )  # fmt: skip

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the file."""
        with self._refusals(), Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def changing(self, *, passing: bool = False) -> Iterator[Session]:
        """A session; its changes are committed, all of them, when the block ends without an error.

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


_DAMAGES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _damage_of(path: Path) -> str | None:
    """The damage that makes a file useless as the database; None where it is sound, or not there."""
    if not path.is_file():
        return "it is a folder" if path.is_dir() else None
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=PATIENCE_S)) as file:
            return next((text for (text,) in file.execute("PRAGMA quick_check(1)") if text != "ok"), None)
    except sqlite3.DatabaseError as error:
        # Other errors, as of a disk that refuses or a file that is locked, are raised when it is opened next.
        return str(error) if (getattr(error, "sqlite_errorcode", 0) & 0xFF) in _DAMAGES else None


def _put_aside(path: Path, to: Path) -> Path:
    """Move the database with its log, and return where it is. Raises StorageError."""
    with disk_errors(path):
        to.parent.mkdir(exist_ok=True)
        for suffix in ("", "-wal", "-shm"):
            if (log := path.with_name(path.name + suffix)).exists():
                log.rename(to.with_name(to.name + suffix))
    return to


def _salvage(damaged: Path, path: Path) -> int:
    """Take over the rows of a damaged file that can be read, from both ends of each table; return how many."""
    if not damaged.is_file():
        return 0
    with (
        closing(sqlite3.connect(f"{damaged.as_uri()}?mode=rw", uri=True, timeout=PATIENCE_S)) as source,
        closing(sqlite3.connect(path, timeout=PATIENCE_S)) as new,
    ):
        source.text_factory = _text
        # So that SQLite opens a file that was cut.
        source.execute("PRAGMA writable_schema=ON")
        for table in Base.metadata.sorted_tables:
            names = ", ".join(column.name for column in table.columns)
            values = ", ".join("?" for _ in table.columns)
            for order in ("ASC", "DESC"):
                try:
                    for row in source.execute(f"SELECT {names} FROM {table.name} ORDER BY rowid {order}"):  # noqa: S608
                        new.execute(f"INSERT OR IGNORE INTO {table.name} ({names}) VALUES ({values})", row)  # noqa: S608
                except sqlite3.DatabaseError:
                    continue
                break
        taken = new.total_changes
        new.execute("DELETE FROM event WHERE job_id NOT IN (SELECT id FROM job)")
        new.execute("DELETE FROM run WHERE schedule_id NOT IN (SELECT id FROM schedule)")
        new.commit()
        return taken


def _text(found: bytes) -> str:
    return found.decode("utf-8", errors="replace")


def sqlite_engine(path: Path) -> Engine:
    """A SQLite file with a write-ahead log; what was committed survives a power cut."""
    engine = create_engine(f"sqlite:///{path}", json_deserializer=_from_json)
    event.listen(engine, "connect", _set_up)
    event.listen(engine, "begin", _begin)
    return engine


def writing(engine: Engine, patience_s: float, synchronous: str = "FULL") -> Engine:
    """The same file, with transactions that take its one write lock at their beginning, or wait so long for it.

    synchronous : of SQLite's settings, the weakest that survives a power cut.
    """
    return engine.execution_options(**{_PATIENCE: int(1000 * patience_s), _SYNCHRONOUS: synchronous})


def _set_up(connection: DBAPIConnection, _record: object) -> None:
    # The driver begins no transactions of its own: `_begin` does.
    connection.isolation_level = None
    connection.text_factory = _text
    # SQLite's own knows the case of ASCII alone.
    connection.create_function("casefold", 1, lambda text: text and text.casefold(), deterministic=True)
    cursor = connection.cursor()
    for pragma in (f"busy_timeout={int(1000 * PATIENCE_S)}", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    _begin_log(cursor)
    cursor.close()


def _begin_log(cursor: DBAPICursor) -> None:
    """Switch the file to a write-ahead log, permanently.

    Of programs that do so at the same moment SQLite refuses all but one at once, despite its `busy_timeout`: those
    hold locks that the one waits for. They release theirs and try again.
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


_VERSION = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))
"""Version of the tables; named as by Alembic, which made them once."""


def upgrade(connection: Connection, tables: MetaData, changes: Mapping[str, Sequence[str]]) -> str:
    """Bring tables up to date. Does nothing when they are; changes nothing, and returns the version that `changes` do
    not name, where another slrig made them, else "".

    changes : by each version of the tables, old to new, the SQL that makes it of the one before. Tables that it does
    not name are made as `tables` has them, and in a new database all are.
    """
    known = list(changes)
    there = inspect(connection).has_table(_VERSION.name)
    found = connection.scalar(select(_VERSION.c.version_num)) if there else None
    if found is not None and found not in known:
        return str(found)
    if found != known[-1]:
        for version in known[known.index(found) + 1 :] if found is not None else ():
            for statement in changes[version]:
                connection.exec_driver_sql(statement)
        tables.create_all(connection)
        _VERSION.create(connection, checkfirst=True)
        connection.execute(delete(_VERSION))
        connection.execute(insert(_VERSION).values(version_num=known[-1]))
    return ""

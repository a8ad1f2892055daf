"""The catalogue that rigs share: a Postgres database, or a SQLite file of one machine; and how a rig's records get
there.

No call waits for long: a database that does not answer is given up after `PATIENCE_S`, and the caller gets an error.
"""

from __future__ import annotations

import importlib.metadata
import logging
import platform
import ssl
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import structlog
from sqlalchemy import (
    URL,
    BigInteger,
    Connection,
    DateTime,
    Dialect,
    Engine,
    Float,
    Identity,
    Index,
    Integer,
    String,
    TypeDecorator,
    create_engine,
    func,
    or_,
    select,
    text,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as NoConnectionError
from sqlalchemy.orm import DeclarativeBase, Mapped, aliased, mapped_column

from slrig.calibrate.verification import RigHealth
from slrig.config import ServiceSettings, is_loopback
from slrig.errors import CatalogueError, ConfigError, ExtraMissingError, StorageError
from slrig.failure import LastingThread
from slrig.jobs.database import sqlite_engine, upgrade, writing
from slrig.jobs.manager import JobManager, RigStatus
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import Copies
from slrig.jobs.worker import READY
from slrig.printable import printable
from slrig.schedule.notices import secret_of


class Moment(TypeDecorator[datetime]):
    """A moment, in UTC. SQLite has no time zones, and keeps it without."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """See `TypeDecorator`."""
        found = None if value is None else value.astimezone(UTC)
        return found if found is None or dialect.name != "sqlite" else found.replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """See `TypeDecorator`."""
        return value if value is None or dialect.name != "sqlite" else value.replace(tzinfo=UTC)


NUMBER = BigInteger().with_variant(Integer, "sqlite")
"""Type of the rows' numbers. SQLite counts by itself in columns of type INTEGER alone."""


class CatalogueBase(DeclarativeBase):
    """Holds the metadata."""


class RigRow(CatalogueBase):
    """State of a rig at `seen_at`, by the catalogue's own clock. All else is by the rig's.

    origin : machine and data folder of the service that writes the row. words : its activity or fault, as text.
    waiting : for the rig. computing : scans that are computed, or wait for that. uncopied : jobs that ended and are not
    here yet. health : of its calibration, by the verification at `verified_at`.
    """

    __tablename__ = "rig"

    name: Mapped[str] = mapped_column(String, primary_key=True)
    origin: Mapped[str] = mapped_column(String)
    host: Mapped[str] = mapped_column(String)
    version: Mapped[str] = mapped_column(String)
    started_at: Mapped[datetime] = mapped_column(Moment)
    seen_at: Mapped[datetime] = mapped_column(Moment)
    state: Mapped[str] = mapped_column(String)
    words: Mapped[str] = mapped_column(String)
    waiting: Mapped[int] = mapped_column(Integer)
    computing: Mapped[int] = mapped_column(Integer)
    uncopied: Mapped[int] = mapped_column(Integer)
    health: Mapped[str] = mapped_column(String)
    health_message: Mapped[str] = mapped_column(String)
    verified_at: Mapped[datetime | None] = mapped_column(Moment)


class FinishedJobRow(CatalogueBase):
    """One job that ended; `number` is the order in which they came, of one rig the order in which they ended. The
    columns: see `slrig.jobs.store.catalogue_entry`.
    """

    __tablename__ = "finished_job"

    number: Mapped[int] = mapped_column(NUMBER, Identity(), primary_key=True)
    job: Mapped[str] = mapped_column(String, unique=True)
    rig: Mapped[str] = mapped_column(String)
    kind: Mapped[str] = mapped_column(String)
    label: Mapped[str | None] = mapped_column(String)
    parent: Mapped[str | None] = mapped_column(String)
    state: Mapped[str] = mapped_column(String)
    requested_by: Mapped[str | None] = mapped_column(String)
    created_at: Mapped[datetime] = mapped_column(Moment)
    started_at: Mapped[datetime | None] = mapped_column(Moment)
    finished_at: Mapped[datetime] = mapped_column(Moment)
    fault_code: Mapped[str | None] = mapped_column(String)
    fault_message: Mapped[str | None] = mapped_column(String)
    points: Mapped[int | None] = mapped_column(BigInteger)
    triangles: Mapped[int | None] = mapped_column(BigInteger)
    sigma_mm: Mapped[float | None] = mapped_column(Float)
    computed_where: Mapped[str | None] = mapped_column(String)
    computed_host: Mapped[str | None] = mapped_column(String)

    __table_args__ = (
        Index("ix_finished_job_rig", "rig", "kind", "number"),
        Index("ix_finished_job_finished", "kind", "finished_at"),
    )


BEAT_S = 20.0
"""Interval at which a rig reports its state."""

VALID_S = 3 * BEAT_S
"""Validity of a report: one may be late, and one be lost."""

STOPPED, UNSEEN = "stopped", "unseen"


@dataclass(frozen=True, slots=True)
class LastScan:
    """The scan of a rig that ended last. error : why it failed, where it did."""

    id: str
    label: str | None
    state: str
    finished_at: datetime
    error: str | None


@dataclass(frozen=True, slots=True)
class RigStanding:
    """A rig of the fleet. seen_s : seconds since its last report, by the catalogue's clock. state : ready, busy,
    opening, fault; stopped, where its service ended in good order; unseen, without a report for a minute. Its activity,
    backlog and health are unknown then: None or empty. words : its activity or fault, as text. waiting : for the rig.
    computing : scans that are reconstructed, or wait for that. uncopied : ended jobs that are still to be
    copied. verified_at : when its calibration was verified last. scans_of_day : that ended within 24 hours.
    """

    name: str
    host: str
    version: str
    started_at: datetime
    seen_at: datetime
    seen_s: float
    state: str
    words: str
    waiting: int | None
    computing: int | None
    uncopied: int | None
    health: str | None
    health_message: str
    verified_at: datetime | None
    last_scan: LastScan | None
    scans_of_day: int
    failed_of_day: int


@dataclass(frozen=True, slots=True)
class Fleet:
    """The rigs that have a catalogue in common, by their names."""

    catalogue: str
    rigs: tuple[RigStanding, ...]


PATIENCE_S = 5.0
"""For a connection, for each answer, and for a lock: on a network that works each takes milliseconds."""

_LOCK = 0x736C7269
"""Which of Postgres's advisory locks is held while tables are made: only others of ours must not use the number."""

_POOL = "catalogue"
_BOUNDS = ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout")
_MOMENTS = ("created_at", "started_at", "finished_at")


class Catalogue:
    """address : for messages. Any thread may call; two at a time have a connection.

    All calls raise CatalogueError: the database cannot be reached, refuses, or was made by a newer slrig.
    """

    def __init__(self, address: str, engine: Engine) -> None:
        self.address = address
        self._engine = engine
        self._writer = writing(engine, PATIENCE_S) if engine.dialect.name == "sqlite" else engine
        self._insert = sqlite.insert if engine.dialect.name == "sqlite" else postgresql.insert

    def open(self) -> None:
        """Connect, and make the tables, or bring them up to date, unless they are."""
        with self._changing() as connection:
            if connection.dialect.name == "postgresql":
                # Rigs that start together wait for one another; the lock ends with the transaction, however that does.
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
            unknown = upgrade(connection, CatalogueBase.metadata, {"catalogue1": ()})
        if unknown:
            message = (
                f"{self.address} was made by another slrig (its tables are of version {unknown}), and this one cannot "
                "use it. Install the newer slrig here as well, or name another database."
            )
            raise CatalogueError(message)

    def close(self) -> None:
        """Close the connections; the next call makes new ones. Idempotent."""
        self._engine.dispose()

    def copy(self, jobs: Sequence[Mapping[str, Any]]) -> None:
        """Write jobs in this order, all of them or none. Known ones are updated."""
        # Only the last entry of a job: one statement may not change a row twice.
        rows = {job["job"]: {name: _value(name, value) for name, value in job.items()} for job in jobs}
        statement = self._insert(FinishedJobRow).values(list(rows.values()))
        new = {name: statement.excluded[name] for name in next(iter(rows.values())) if name != "job"}
        with self._changing() as connection:
            connection.execute(statement.on_conflict_do_update(index_elements=["job"], set_=new))

    def known(self, jobs: Collection[str]) -> set[str]:
        """Those of these ids that the catalogue has."""
        with self._reading() as connection:
            return set(connection.scalars(select(FinishedJobRow.job).where(FinishedJobRow.job.in_(jobs))))

    def see(self, rig: Mapping[str, Any]) -> None:
        """Record a rig's state: the columns of its row except `seen_at`."""
        with self._changing() as connection:
            now = _now(connection)
            statement = self._insert(RigRow).values(seen_at=now, **rig)
            # A row that another service keeps up to date is not ours.
            mine = or_(RigRow.origin == rig["origin"], RigRow.seen_at < now - timedelta(seconds=VALID_S))
            new = {name: statement.excluded[name] for name in (*rig, "seen_at")}
            kept = connection.execute(
                statement.on_conflict_do_update(index_elements=["name"], set_=new, where=mine).returning(RigRow.name)
            ).all()
            if not kept:
                other = connection.scalar(select(RigRow.origin).where(RigRow.name == rig["name"]))
                message = (
                    f"Two services say that they are rig '{rig['name']}': this one, and {other}. Give each rig file a "
                    "name of its own."
                )
                raise CatalogueError(message)

    def fleet(self) -> Fleet:
        """Every rig, by its name."""
        scan, job = str(JobKind.SCAN), FinishedJobRow
        each = aliased(FinishedJobRow)
        of_rig = select(func.max(each.number)).where(each.rig == RigRow.name, each.kind == scan)
        newest = of_rig.correlate(RigRow).scalar_subquery()
        with self._reading() as connection:
            now = _now(connection)
            rigs = connection.execute(
                select(
                    *RigRow.__table__.columns,
                    job.job,
                    job.label,
                    job.state.label("scan_state"),
                    job.finished_at,
                    job.fault_message,
                )
                .select_from(RigRow)
                .outerjoin(job, job.number == newest)
                .order_by(RigRow.name)
            ).mappings()
            counts = connection.execute(
                select(job.rig, func.count(), func.count().filter(job.state == str(JobState.FAILED)))
                .where(job.kind == scan, job.finished_at > now - timedelta(days=1))
                .group_by(job.rig)
            ).all()
            of_day = {rig: (count, failed) for rig, count, failed in counts}
            found = tuple(_fleet_rig(row, now, *of_day.get(row["name"], (0, 0))) for row in rigs)
        return Fleet(catalogue=self.address, rigs=found)

    @contextmanager
    def _changing(self) -> Iterator[Connection]:
        with self._faults(), self._writer.begin() as connection:
            yield connection

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        with self._faults(), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (DBAPIError, NoConnectionError, OSError, struct.error) as error:
            message = f"The catalogue {self.address} cannot be used: {_cause(error)}."
            raise CatalogueError(message) from error


def open_catalogue(address: str, login: str | None, authority: Path | None) -> Catalogue:
    """The catalogue at postgresql://HOST:PORT/DATABASE or sqlite:///FILE. Does not connect yet.

    login : USER:PASSWORD. authority : a file with the certificate of the server's signer; None for those that this
    system trusts.

    Raises
    ------
    ConfigError
        The address is none, or its password would travel unencrypted.
    ExtraMissingError
        Postgres's driver is not installed.
    """
    parts = urlsplit(address)
    if parts.scheme == "sqlite" and not parts.netloc and len(parts.path) > 1:
        path = Path(parts.path[1:]).expanduser()
        return Catalogue(f"sqlite:///{path}", sqlite_engine(path))
    try:
        port = parts.port or 5432
    except ValueError:
        port = None
    database = parts.path.strip("/")
    odd = parts.username or parts.password or parts.query or parts.fragment or "/" in database
    if parts.scheme != "postgresql" or not parts.hostname or port is None or not database or odd:
        # What was found is not repeated: people write passwords there.
        message = (
            "catalogue: expected postgresql://HOST:PORT/DATABASE or sqlite:////FOLDER/FILE. User and password belong "
            "into catalogue_login_file"
        )
        raise ConfigError(message)
    user, found, password = (login or "").strip().partition(":")
    if not found or not user:
        message = (
            "catalogue: there is no login for it. Set catalogue_login_file, a file with USER:PASSWORD that only "
            "this user may read, or SLRIG_CATALOGUE_LOGIN in the environment."
        )
        raise ConfigError(message)
    try:
        import pg8000  # noqa: F401 - loaded by those who use it
    except ImportError as error:
        message = "A catalogue in Postgres needs a library that is not installed here: pip install 'slrig[fleet]'"
        raise ExtraMissingError(message) from error
    engine = create_engine(
        URL.create("postgresql+pg8000", user, password, parts.hostname, port, database),
        pool_size=2,
        max_overflow=0,
        pool_timeout=1.0,
        # A server that was started again has dropped the connections that are kept here.
        pool_pre_ping=True,
        pool_logging_name=_POOL,
        connect_args={
            "timeout": PATIENCE_S,
            "application_name": "slrig",
            "ssl_context": _tls(parts.hostname, authority),
            # The server, too, gives up what takes long, and releases the locks of a rig that is cut off.
            "startup_params": dict.fromkeys(_BOUNDS, str(int(1000 * PATIENCE_S))),
        },
    )
    # It logs each lost connection at length, with statements; we log it ourselves.
    logging.getLogger(f"sqlalchemy.pool.impl.QueuePool.{_POOL}").setLevel(logging.CRITICAL)
    return Catalogue(f"postgresql://{parts.hostname}:{port}/{database}", engine)


def catalogue_of(settings: ServiceSettings) -> Catalogue | None:
    """The catalogue that the settings name; None where they name none. Raises as `open_catalogue` does."""
    if settings.catalogue is None:
        return None
    login, _ = secret_of(settings.catalogue_login, settings.catalogue_login_file, "catalogue_login")
    return open_catalogue(settings.catalogue, login, settings.catalogue_authority)


def _tls(host: str, authority: Path | None) -> ssl.SSLContext | bool:
    """Check of the server's identity; False, without encryption, on this machine alone. Raises ConfigError."""
    if authority is None:
        return False if is_loopback(host) else ssl.create_default_context()
    try:
        return ssl.create_default_context(cafile=str(authority))
    except OSError as error:
        message = (
            f"catalogue_authority: {authority} cannot be used ({error.strerror or 'it holds no certificate'}). Name a "
            "PEM file with the certificate of who signed the database's."
        )
        raise ConfigError(message) from error


def _now(connection: Connection) -> datetime:
    """The present moment by the catalogue's own clock: those of rigs differ."""
    now: datetime = connection.execute(select(func.current_timestamp(type_=Moment))).scalar_one()
    return now


def _value(name: str, value: Any) -> Any:
    """A value as databases take it: Postgres has no text with NUL or half a surrogate pair."""
    if not isinstance(value, str):
        return value
    if name in _MOMENTS:
        return datetime.fromisoformat(value)
    return value.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()


def _fleet_rig(row: Mapping[Any, Any], now: datetime, scans: int, failed: int) -> RigStanding:
    """A rig by its last report, as far as that is still valid."""
    seen_s = max((now - row["seen_at"]).total_seconds(), 0.0)
    stopped = row["state"] == STOPPED
    current = seen_s <= VALID_S and not stopped
    last = None
    if row["job"] is not None:
        last = LastScan(row["job"], row["label"], row["scan_state"], row["finished_at"], row["fault_message"])
    return RigStanding(
        name=row["name"],
        host=row["host"],
        version=row["version"],
        started_at=row["started_at"],
        seen_at=row["seen_at"],
        seen_s=round(seen_s, 1),
        state=row["state"] if current or stopped else UNSEEN,
        words=row["words"] if current else "",
        waiting=row["waiting"] if current else None,
        computing=row["computing"] if current else None,
        uncopied=row["uncopied"] if current else None,
        health=row["health"] if current else None,
        health_message=row["health_message"] if current else "",
        verified_at=row["verified_at"],
        last_scan=last,
        scans_of_day=scans,
        failed_of_day=failed,
    )


def _cause(error: Exception) -> str:
    """Why, without statements, which hold what people wrote."""
    if isinstance(error, NoConnectionError):
        return "its connections are in use just now"
    # Of a connection that could not be made the driver names the attempt, and the system the cause.
    found: BaseException = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    root = found.__cause__ if isinstance(found.__cause__, OSError) else found
    if isinstance(root, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({root.verify_message}); see catalogue_authority"
    if isinstance(root, TimeoutError):
        return f"it did not answer within {PATIENCE_S:.0f} s"
    if isinstance(root, OSError):
        return root.strerror or type(root).__name__
    if root is error:
        return type(error).__name__
    # Postgres's own message, by the names of its protocol's fields.
    answer = root.args[0] if root.args else ""
    text = str(answer.get("M", "") if isinstance(answer, Mapping) else answer)
    return printable(text.replace("network error", "the connection was lost")).rstrip(".")


BATCH = 200
"""Jobs in one transaction, some hundred kB."""

FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 30.0
"""Between tries. A thousand rigs then try thirty times a second to reach a missing catalogue."""

_END_S = 1.0

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Copying:
    """State of the copying. fault : why it fails, None while it works. waiting, oldest_s : jobs that are not copied,
    and how long the oldest has waited.
    """

    fault: str | None
    waiting: int
    oldest_s: float


class Copier:
    """Copies a rig's state and jobs to the catalogue. Only `close` waits for it, for a second at most.

    rig_row : gives the rig's state, by the columns of its row except `seen_at` and `uncopied`. clock : seconds that
    only grow.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        copies: Copies,
        rig_row: Callable[[], Mapping[str, Any]],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._catalogue = catalogue
        self._copies = copies
        self._rig_row = rig_row
        self._clock = clock
        self._opened = False
        self._fault: str | None = "It was not reached yet"
        self._failures = 0
        self._beat_at_s = -float("inf")
        self._reported_uncopied = 0
        self._left = threading.Event()
        self._ending = threading.Event()
        self._thread = LastingThread(self._run, "slrig-catalogue")

    def start(self) -> None:
        """Begin to copy."""
        self._thread.start()

    def close(self) -> None:
        """Say that the rig is stopped, and copy no more, if that goes quickly. Idempotent."""
        self._ending.set()
        self._copies.news.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._left.set()

    def status(self) -> Copying:
        """State of the copying. Raises StorageError."""
        return Copying(self._fault, *self._copies.waiting())

    def fleet(self) -> Fleet:
        """Every rig of the catalogue. Raises CatalogueError at once where the last attempt failed."""
        if self._fault is not None:
            message = f"{self._fault}. This rig scans on, and tries again by itself."
            raise CatalogueError(message)
        with suppress(CatalogueError):
            return self._catalogue.fleet()
        # The connection may be older than the last start of the database, which says nothing of that.
        self._catalogue.close()
        try:
            return self._catalogue.fleet()
        except CatalogueError as error:
            # Others do not wait for it before it was reached again.
            self._fault = str(error).rstrip(".")
            self._copies.news.set()
            raise

    def step(self) -> float:
        """Copy what waits, and say how the rig is, if that is due. Returns the seconds until it is due again.

        Raises CatalogueError; StorageError, if the rig's own records refuse.
        """
        if not self._opened:
            self._catalogue.open()
            self._copy_what_it_lacks()
            self._opened = True
        # In the order in which they ended: a copy that was not noted as taken comes again, and makes no second row.
        while not self._left.is_set() and (copies := self._copies.oldest(BATCH)):
            self._catalogue.copy([each.job for each in copies])
            if self._left.is_set():
                break
            self._copies.taken(copies)
            self._report()
        self._report()
        return self._beat_at_s + BEAT_S - self._clock()

    def _report(self, **other: Any) -> None:
        """Report the rig's state if that is due, or once the last reported backlog is gone."""
        uncopied, _ = self._copies.waiting()
        if other or self._clock() >= self._beat_at_s + BEAT_S or (self._reported_uncopied and not uncopied):
            self._catalogue.see({**self._rig_row(), "uncopied": uncopied, **other})
            self._beat_at_s, self._reported_uncopied = self._clock(), uncopied

    def _copy_what_it_lacks(self) -> None:
        """Copy jobs that ended before this catalogue existed, or that it lost: it may be an older backup of itself."""
        ended = self._copies.ended()
        for begin in range(0, len(ended), BATCH):
            if self._left.is_set():
                return
            some = ended[begin : begin + BATCH]
            lacking = set(some) - self._catalogue.known(some)
            if lacking and (jobs := self._copies.of(lacking)):
                self._catalogue.copy(jobs)

    def _run(self) -> None:
        while True:
            self._copies.news.clear()
            wait_s = self._tried()
            if self._ending.is_set():
                break
            (self._copies.news if self._fault is None else self._ending).wait(wait_s)
            if self._ending.is_set():
                break
        if self._fault is None:
            with suppress(CatalogueError, StorageError):
                self.step()
                self._report(state=STOPPED, words="")
        self._catalogue.close()

    def _tried(self) -> float:
        try:
            wait_s = self.step()
        except Exception as error:  # noqa: BLE001 - after any error the next try may succeed
            known = isinstance(error, (CatalogueError, StorageError))
            fault = str(error).rstrip(".") if known else f"The catalogue cannot be used: {type(error).__name__}"
            wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._failures, 30), LONGEST_WAIT_S)
            self._failures += 1
            if fault != self._fault:
                _log.warning("this rig is not reported to the catalogue", cause=fault, exc_info=not known)
            self._fault, self._opened = fault, False
            self._catalogue.close()
            return wait_s
        if self._fault is not None:
            _log.info("this rig is reported to the catalogue", catalogue=self._catalogue.address)
        self._fault, self._failures = None, 0
        return wait_s


def rig_row(manager: JobManager, health_of: RigHealth, *, data: Path, started_at: datetime) -> dict[str, Any]:
    """The columns of a rig's row except `seen_at` and `uncopied`. data : the service's folder."""
    status = manager.status()
    health, latest, _ = health_of.health()
    state, text = _state(status)
    return {
        "name": status.rig,
        "origin": f"{platform.node()}:{data}",
        "host": platform.node(),
        "version": importlib.metadata.version("slrig"),
        "started_at": started_at,
        "state": state,
        "words": text,
        "waiting": status.waiting,
        "computing": len(status.computing),
        "health": str(health.state),
        "health_message": "; ".join(health.reasons),
        "verified_at": None if latest is None else latest.at,
    }


def _state(status: RigStatus) -> tuple[str, str]:
    """State of a rig, and its activity or fault as text."""
    if status.fault is not None:
        return "fault", status.fault
    if status.facts is None:
        return "opening", status.opening
    if status.reconstruction != READY and not status.preparing:
        return "fault", status.reconstruction
    return ("ready", "") if status.holder is None else ("busy", status.holder)

"""The catalogue itself: a Postgres database that rigs share, or a SQLite file of one machine.

Nothing here waits for long: a database that does not answer is given up after `PATIENCE_S`, and whoever asked is told.
"""

from __future__ import annotations

import logging
import ssl
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from alembic.util import CommandError
from sqlalchemy import URL, Connection, Engine, create_engine, func, or_, select, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as NoConnectionError
from sqlalchemy.orm import aliased

from slrig.catalogue.fleet import SEEN_S, STOPPED, UNSEEN, Fleet, LastScan, RigStanding
from slrig.catalogue.tables import CatalogueBase, FinishedJobRow, Moment, RigRow
from slrig.config import ServiceSettings, is_loopback
from slrig.errors import CatalogueError, ConfigError, ExtraMissingError
from slrig.jobs.database import sqlite_engine, upgrade, writing
from slrig.jobs.records import JobKind, JobState
from slrig.printable import printable
from slrig.schedule.receivers import secret_of

PATIENCE_S = 5.0
"""For a connection, for each answer, and for a lock: on a network that works each takes milliseconds."""

_LOCK = 0x736C7269
"""Which of Postgres's advisory locks is held while tables are made: only others of ours must not use the number."""

_POOL = "catalogue"
_BOUNDS = ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout")
_MOMENTS = ("created_at", "started_at", "finished_at")


class Catalogue:
    """address : as it is told to people. Any thread may call; two at a time have a connection.

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
            unknown = upgrade(connection, "slrig.catalogue:versions", CatalogueBase.metadata)
        if unknown:
            message = (
                f"{self.address} was made by another slrig (its tables are of version {unknown}), and this one cannot "
                "use it. Install the newer slrig here as well, or name another database."
            )
            raise CatalogueError(message)

    def close(self) -> None:
        """Let the connections go; the next call makes new ones. Idempotent."""
        self._engine.dispose()

    def copy(self, jobs: Sequence[Mapping[str, Any]]) -> None:
        """Have the catalogue know jobs in this order, all of them or none. One that it knows is brought up to date."""
        # The last word on a job stands: one statement may not change a row twice.
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
        """Note how a rig is now: the columns of its row but for `seen_at`."""
        with self._changing() as connection:
            now = _now(connection)
            statement = self._insert(RigRow).values(seen_at=now, **rig)
            # A row that somebody else keeps up to date is somebody else's.
            mine = or_(RigRow.origin == rig["origin"], RigRow.seen_at < now - timedelta(seconds=SEEN_S))
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
            found = tuple(_standing(row, now, *of_day.get(row["name"], (0, 0))) for row in rigs)
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
        except (DBAPIError, NoConnectionError, CommandError, OSError, struct.error) as error:
            message = f"The catalogue {self.address} cannot be used: {_cause(error)}."
            raise CatalogueError(message) from error


def open_catalogue(address: str, login: str | None, authority: Path | None) -> Catalogue:
    """The catalogue at postgresql://HOST:PORT/DATABASE or sqlite:///FILE. Does not connect yet.

    login : USER:PASSWORD. authority : a file with the certificate of who signed the server's; None stands for those
    that this system trusts.

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
            "catalogue: there is no login for it. Set catalogue_login_file, a file with USER:PASSWORD that nobody "
            "else may read, or SLRIG_CATALOGUE_LOGIN in the environment."
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
        pool_logging_name=_POOL,
        connect_args={
            "timeout": PATIENCE_S,
            "application_name": "slrig",
            "ssl_context": _tls(parts.hostname, authority),
            # The server, too, gives up what takes long, and lets go the locks of a rig that is cut off.
            "startup_params": dict.fromkeys(_BOUNDS, str(int(1000 * PATIENCE_S))),
        },
    )
    # It tells at length, with statements, of each connection that was lost; we tell it ourselves.
    logging.getLogger(f"sqlalchemy.pool.impl.QueuePool.{_POOL}").setLevel(logging.CRITICAL)
    return Catalogue(f"postgresql://{parts.hostname}:{port}/{database}", engine)


def catalogue_of(settings: ServiceSettings) -> Catalogue | None:
    """The catalogue that the settings name; None where they name none. Raises as `open_catalogue` does."""
    if settings.catalogue is None:
        return None
    login, _ = secret_of(settings.catalogue_login, settings.catalogue_login_file, "catalogue_login")
    return open_catalogue(settings.catalogue, login, settings.catalogue_authority)


def _tls(host: str, authority: Path | None) -> ssl.SSLContext | bool:
    """How a server proves who it is; False, without encryption, on this machine alone. Raises ConfigError."""
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


def _standing(row: Mapping[Any, Any], now: datetime, scans: int, failed: int) -> RigStanding:
    """A rig as it was when it was seen last, as far as that still says something."""
    seen_s = max((now - row["seen_at"]).total_seconds(), 0.0)
    stopped, seen = row["state"] == STOPPED, seen_s <= SEEN_S
    current = seen and not stopped
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
        return "others ask it just now"
    # Of a connection that could not be made the driver tells the attempt, and the system why.
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
    # Postgres's own words, by the names of its protocol's fields.
    answer = root.args[0] if root.args else ""
    words = str(answer.get("M", "") if isinstance(answer, Mapping) else answer)
    return printable(words.replace("network error", "the connection was lost")).rstrip(".")

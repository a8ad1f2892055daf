"""The catalogue, on SQLite and on Postgres alike; and what a service copies to it: every job that ended, once."""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import text, update
from structlog.testing import capture_logs

from slrig.catalogue import store
from slrig.catalogue import store as copying
from slrig.catalogue.store import BEAT_S, Catalogue, CatalogueBase, Copier, RigRow, open_catalogue
from slrig.errors import CatalogueError, ConfigError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import Copies, JobStore, Outbox
from tests.listening import free_port
from tests.postgres import LOGIN, PASSWORD, Postgres
from tests.unit.schedule.receivers import own_certificate


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path}/fleet.sqlite"
        return
    server: Postgres = request.getfixturevalue("postgres")
    name = f"fleet_{os.urandom(4).hex()}"
    server.execute(f"CREATE DATABASE {name}")
    yield server.address(name)
    server.execute(f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture
def catalogue(address: str) -> Iterator[Catalogue]:
    found = open_catalogue(address, LOGIN, None)
    yield found
    found.close()


NOW = datetime.now(UTC).replace(microsecond=0)


def job(rig: str = "hall-3", **other: Any) -> dict[str, Any]:
    at = NOW.isoformat(timespec="milliseconds")
    return {
        "job": str(uuid4()), "rig": rig, "kind": "scan", "label": None, "parent": None, "state": "succeeded",
        "requested_by": None, "created_at": at, "started_at": at, "finished_at": at, "fault_code": None,
        "fault_message": None, "points": 561881, "triangles": 1116597, "sigma_mm": 0.0072, "computed_where": "pool",
        "computed_host": "worker-1", **other,
    }  # fmt: skip


def row(name: str = "hall-3", **other: Any) -> dict[str, Any]:
    return {
        "name": name, "origin": f"{name}:/data", "host": name, "version": "0.1.0", "started_at": NOW, "state": "busy",
        "words": "scan 1", "waiting": 2, "computing": 1, "uncopied": 4, "health": "valid", "health_message": "",
        "verified_at": NOW, **other,
    }  # fmt: skip


def sql(catalogue: Catalogue, statement: str) -> list[Any]:
    with catalogue._writer.begin() as connection:
        result = connection.execute(text(statement))
        return [tuple(each) for each in result] if result.returns_rows else []


def unseen_for_an_hour(catalogue: Catalogue, name: str) -> None:
    # By now, and not by when this file was read: a test may be minutes later.
    an_hour_ago = datetime.now(UTC) - timedelta(hours=1, seconds=2)  # clocks of databases round
    with catalogue._writer.begin() as connection:
        connection.execute(update(RigRow).where(RigRow.name == name).values(seen_at=an_hour_ago))


def test_migrations_give_the_tables_that_the_code_uses_also_to_several_at_once(address: str) -> None:
    rigs = [open_catalogue(address, LOGIN, None) for _ in range(4)]
    with ThreadPoolExecutor(len(rigs)) as together:
        for done in [together.submit(each.open) for each in rigs]:
            done.result()
    with rigs[0]._engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), CatalogueBase.metadata) == []
    for each in rigs:
        each.close()


def test_a_job_is_one_row_however_often_it_comes(catalogue: Catalogue) -> None:
    catalogue.open()
    jobs = [job(label=f"part {number}\0\ud800") for number in range(5)]
    catalogue.copy(jobs[:3])
    lost = {**jobs[1], "state": "failed", "fault_code": "storage", "fault_message": "its files are gone"}
    catalogue.copy([jobs[1], *jobs[2:], lost])
    found = sql(catalogue, "SELECT job, label, state FROM finished_job ORDER BY number")
    assert found == [
        (each["job"], f"part {number}\\0\\ud800", "failed" if number == 1 else "succeeded")
        for number, each in enumerate(jobs)
    ]
    assert catalogue.known([jobs[0]["job"], "another"]) == {jobs[0]["job"]}


def test_fleet_lists_what_is_known_and_no_more(catalogue: Catalogue) -> None:
    catalogue.open()
    for name in ("hall-3", "hall-1", "hall-2"):
        catalogue.see(row(name, state="stopped" if name == "hall-2" else "busy"))
    earlier = (NOW - timedelta(days=2)).isoformat()
    scans = [
        job(finished_at=earlier),
        job(label="the last", state="failed", fault_message="too dark"),
        job(kind="model"),
        job("hall-1", finished_at=earlier),
    ]
    catalogue.copy(scans)
    unseen_for_an_hour(catalogue, "hall-1")
    one, two, three = catalogue.fleet().rigs
    told = (three.name, three.state, three.words, three.waiting, three.health)
    assert told == ("hall-3", "busy", "scan 1", 2, "valid")
    assert three.last_scan is not None
    assert asdict(three.last_scan) == {
        "id": scans[1]["job"], "label": "the last", "state": "failed", "finished_at": NOW, "error": "too dark",
    }  # fmt: skip
    assert (three.scans_of_day, three.failed_of_day) == (1, 1)
    assert three.seen_s < 60
    for other, state in ((one, "unseen"), (two, "stopped")):
        assert (other.state, other.words, other.waiting, other.computing, other.health) == (state, "", None, None, None)
    assert one.seen_s == pytest.approx(3600, abs=60)
    assert (one.scans_of_day, one.last_scan and one.last_scan.id) == (0, scans[3]["job"])
    assert two.last_scan is None


def test_two_services_are_not_one_rig(catalogue: Catalogue) -> None:
    catalogue.open()
    for _ in range(2):
        catalogue.see(row())
    with pytest.raises(CatalogueError, match=r"Two services say that they are rig 'hall-3'.*hall-3:/data.*name of its"):
        catalogue.see(row(origin="elsewhere:/data"))
    # The computer of a rig was exchanged.
    unseen_for_an_hour(catalogue, "hall-3")
    catalogue.see(row(origin="elsewhere:/data"))
    assert sql(catalogue, "SELECT origin FROM rig") == [("elsewhere:/data",)]


def test_tables_of_another_slrig_are_refused_and_left_as_they_are(catalogue: Catalogue) -> None:
    sql(catalogue, "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)")
    sql(catalogue, "INSERT INTO alembic_version VALUES ('catalogue99')")
    with pytest.raises(CatalogueError, match=r"another slrig.*of version catalogue99.*Install the newer"):
        catalogue.open()
    assert sql(catalogue, "SELECT version_num FROM alembic_version") == [("catalogue99",)]
    with pytest.raises(CatalogueError):
        catalogue.fleet()


@pytest.mark.slow
def test_a_rig_needs_no_right_but_to_read_and_write_rows(postgres: Postgres, tmp_path: Path) -> None:
    postgres.execute("CREATE DATABASE rights")
    owner = open_catalogue(postgres.address("rights"), LOGIN, None)
    rig = open_catalogue(postgres.address("rights"), "rig:its-own", None)
    postgres.execute("CREATE ROLE rig LOGIN PASSWORD 'its-own'")
    with pytest.raises(CatalogueError, match="permission denied"):
        rig.open()
    owner.open()
    postgres.execute("GRANT SELECT, INSERT, UPDATE ON ALL TABLES IN SCHEMA public TO rig", "rights")
    rig.open()
    rig.copy([job()])
    rig.see(row())
    assert [each.scans_of_day for each in rig.fleet().rigs] == [1]
    owner.close()
    rig.close()
    encrypted = open_catalogue(postgres.address(), LOGIN, own_certificate(tmp_path))
    with pytest.raises(CatalogueError, match="refuses SSL"):
        encrypted.open()


@pytest.mark.parametrize(
    ("address", "login", "why"),
    [
        ("mysql://db/fleet", LOGIN, "expected postgresql://"),
        ("postgresql://db", LOGIN, "expected postgresql://"),
        ("postgresql://db:port/fleet", LOGIN, "expected postgresql://"),
        (f"postgresql://slrig:{PASSWORD}@db/fleet", None, "expected postgresql://"),
        ("sqlite://", None, "expected postgresql://"),
        ("postgresql://db/fleet", None, "no login"),
        ("postgresql://db/fleet", "slrig", "no login"),
    ],
)
def test_an_address_that_cannot_be_used_is_refused_and_not_repeated(address: str, login: str | None, why: str) -> None:
    with pytest.raises(ConfigError, match=why) as refused:
        open_catalogue(address, login, None)
    assert PASSWORD not in str(refused.value)


@pytest.mark.slow
def test_a_server_that_was_started_again_costs_no_call() -> None:
    with Postgres() as server:
        catalogue = open_catalogue(server.address(), LOGIN, None)
        catalogue.open()
        server.kill()
        server.start()
        assert catalogue.fleet().rigs == ()
        server.kill()
        server.start()
        catalogue.copy([job()])
        catalogue.close()


@pytest.mark.slow
def test_a_certificate_has_to_be_of_the_authority_and_of_the_host(tmp_path: Path) -> None:
    pem = own_certificate(tmp_path)
    with Postgres(certificate=pem) as server:
        known = open_catalogue(server.address(), LOGIN, pem)
        known.open()
        with known._engine.connect() as connection:
            encrypted = "SELECT ssl FROM pg_stat_ssl WHERE pid = pg_backend_pid()"
            assert connection.scalar(text(encrypted)) is True
        known.close()
        (tmp_path / "other").mkdir()
        stranger = open_catalogue(server.address(), LOGIN, own_certificate(tmp_path / "other"))
        with pytest.raises(CatalogueError, match=r"certificate is not trusted.*see catalogue_authority"):
            stranger.open()
        misnamed = open_catalogue(server.address().replace("127.0.0.1", "localhost"), LOGIN, pem)
        with pytest.raises(CatalogueError, match="not trusted"):
            misnamed.open()
    plain = store._tls("db.hall.example", None)
    assert isinstance(plain, ssl.SSLContext)
    assert (plain.check_hostname, plain.verify_mode) == (True, ssl.CERT_REQUIRED)
    with pytest.raises(ConfigError, match="PEM file"):
        open_catalogue("postgresql://127.0.0.1/fleet", LOGIN, tmp_path / "none.pem")


def test_a_database_that_does_not_answer_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pg8000", reason="needs Postgres's driver: pip install 'slrig[fleet]'")
    monkeypatch.setattr(store, "PATIENCE_S", 0.2)
    nobody = open_catalogue(f"postgresql://127.0.0.1:{free_port()}/fleet", LOGIN, None)
    with pytest.raises(CatalogueError, match="Connection refused"):
        nobody.open()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        deaf = open_catalogue(f"postgresql://127.0.0.1:{silent.getsockname()[1]}/fleet", LOGIN, None)
        with pytest.raises(CatalogueError, match="did not answer within") as refused:
            deaf.open()
    assert PASSWORD not in str(refused.value)


class Rig:
    """The records of a rig, and what copies them."""

    def __init__(self, folder: Path, catalogue: Catalogue, *, name: str = "hall-3", copied: bool = True) -> None:
        self.name = name
        self.now_s = 0.0
        self.database = Database(folder / f"{name}.sqlite")
        self.copies = Copies(self.database)
        outbox = Outbox(self.database, copies=self.copies if copied else None)
        self.jobs = JobStore(self.database, outbox=outbox)
        self.copier = Copier(catalogue, self.copies, lambda: self.standing, clock=lambda: self.now_s)
        self.standing = {key: value for key, value in row(name).items() if key != "uncopied"}

    def end_job(self, label: str, *, deleted: bool = False) -> None:
        job = self.jobs.create({}, kind=JobKind.SCAN, rig=self.name, label=label)
        self.jobs.finish(job.id, JobState.SUCCEEDED, summary={"mesh": {"points": 3, "figures": {"triangles": 1}}})
        if deleted:
            self.jobs.delete(job.id)


@pytest.fixture
def rig(tmp_path: Path, catalogue: Catalogue) -> Iterator[Rig]:
    found = Rig(tmp_path, catalogue)
    yield found
    found.copier.close()
    found.database.close()


def labels(catalogue: Catalogue) -> list[str]:
    return [label for (label,) in sql(catalogue, "SELECT label FROM finished_job ORDER BY number")]


def test_jobs_come_once_and_in_order_whatever_their_record_becomes(
    rig: Rig, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(copying, "BATCH", 5)
    # Retention removes one, and another's files are lost, before the catalogue was ever reached.
    names = [f"part {number}" for number in range(8)]
    for name in names:
        rig.end_job(name, deleted=name == "part 1")
    lost = rig.jobs.page(before=None, limit=1)[0]
    rig.jobs.lose_files(lost.id, JobFailure("storage", "its files are gone"))
    assert rig.copies.waiting()[0] == 9
    assert rig.copier.step() == BEAT_S
    assert labels(catalogue) == names
    (last,) = sql(catalogue, "SELECT state, fault_code, points, triangles FROM finished_job WHERE label = 'part 7'")
    assert last == ("failed", "storage", None, None)
    assert rig.copies.waiting() == (0, 0.0)
    assert [(each.name, each.uncopied) for each in catalogue.fleet().rigs] == [("hall-3", 0)]


def test_a_copy_that_was_not_noted_comes_again_and_is_one_row(
    rig: Rig, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.end_job("one")
    with monkeypatch.context() as killed:
        killed.setattr(rig.copies, "taken", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            rig.copier.step()
    rig.end_job("two")
    rig.copier.step()
    assert labels(catalogue) == ["one", "two"]


def test_what_ended_without_a_catalogue_or_what_it_lost_is_brought_up(tmp_path: Path, catalogue: Catalogue) -> None:
    before = Rig(tmp_path, catalogue, copied=False)
    for name in ("one", "two", "three"):
        before.end_job(name)
    before.database.close()
    rig = Rig(tmp_path, catalogue)
    rig.end_job("four")
    rig.copier.step()
    assert labels(catalogue) == ["one", "two", "three", "four"]
    # An older backup of the catalogue was brought back, while the rig could not reach it.
    sql(catalogue, "DELETE FROM finished_job WHERE label IN ('two', 'four')")
    rig.copier._opened = False
    rig.end_job("five")
    rig.copier.step()
    assert labels(catalogue) == ["one", "three", "two", "four", "five"]
    rig.database.close()


def test_state_of_a_rig_is_copied_at_each_beat(rig: Rig, catalogue: Catalogue) -> None:
    rig.copier.step()
    rig.standing["state"] = "fault"
    rig.now_s = BEAT_S - 1
    assert rig.copier.step() == 1
    assert catalogue.fleet().rigs[0].state == "busy"
    rig.now_s = BEAT_S
    assert rig.copier.step() == BEAT_S
    assert catalogue.fleet().rigs[0].state == "fault"


def test_unreachable_catalogue_is_logged_and_holds_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copying, "FIRST_WAIT_S", 0.01)
    folder = tmp_path / "share"
    catalogue = open_catalogue(f"sqlite:///{folder}/fleet.sqlite", None, None)
    rig = Rig(tmp_path, catalogue)
    with capture_logs() as logs:
        rig.copier.start()
        rig.end_job("one")
        while rig.copier._failures < 3:
            rig.copier._ending.wait(0.01)
        assert (rig.copier.status().waiting, rig.copies.waiting()[0]) == (1, 1)
        with pytest.raises(CatalogueError, match=r"unable to open.*scans on, and tries again by itself"):
            rig.copier.fleet()
        folder.mkdir()
        copied = rig.copies.waiting()
        while copied[0]:
            rig.copier._ending.wait(0.01)
            copied = rig.copies.waiting()
        rig.copier.close()
    assert [each["event"] for each in logs] == [
        "this rig is not reported to the catalogue",
        "this rig is reported to the catalogue",
    ]
    assert labels(catalogue) == ["one"]
    assert catalogue.fleet().rigs[0].state == "stopped"
    catalogue.close()
    rig.database.close()

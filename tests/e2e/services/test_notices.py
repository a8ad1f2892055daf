"""What others get of a service through kills, once and in order: notices of jobs, and the rows of a catalogue."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slrig.client import Client
from tests.e2e.conftest import SLOW, ServiceProcess, Start, ended, followed_to, scanned, write_rig
from tests.e2e.schedules import awaited
from tests.postgres import LOGIN as DATABASE_LOGIN
from tests.postgres import PASSWORD, Postgres
from tests.unit.schedule.receivers import LOGIN, PATH, PREFIX, SECRET, Hook, Mosquitto, Subscriber, signed

pytestmark = pytest.mark.slow


def waiting(client: Client) -> list[float]:
    lines = client.system.metrics().splitlines()
    return [float(line.split()[1]) for line in lines if line.startswith("slrig_notices_waiting{")]


def test_every_end_of_a_job_arrives_once_in_order_and_signed_through_a_kill(start: Start, tmp_path: Path) -> None:
    broker = Mosquitto(tmp_path)
    # Its port; nothing listens there before the second start.
    receiver = Hook()
    receiver.close()
    secret = tmp_path / "webhook-secret"
    secret.touch(0o600)
    secret.write_text(SECRET)
    settings = {
        "SLRIG_WEBHOOK_URL": receiver.url,
        "SLRIG_WEBHOOK_SECRET_FILE": str(secret),
        "SLRIG_MQTT_URL": broker.url,
        "SLRIG_MQTT_LOGIN": LOGIN,
    }
    rig = write_rig(tmp_path / "rig", head=SLOW)
    first = start(rig, **settings)
    with first.client() as client:
        done = scanned(client, label="done")
        cancelled = client.scans.start(label="cancelled")
        followed_to(client, cancelled, "capture")
        client.post(cancelled["links"]["cancel"], None)
        assert ended(client, cancelled)["state"] == "cancelled"
        cut_off = client.scans.start(label="cut off")
        followed_to(client, cut_off, "capture")
        # Without receivers, nothing waits but the notices.
        assert waiting(client) == [2, 2]
        assert "a notice was not delivered" in first.log.read_text()
        first.kill()
    receiver = Hook(port=receiver.port)
    broker.start()
    subscriber = Subscriber(broker)
    try:
        second = start(rig, **settings)
        with second.client() as client:
            assert scanned(client, label="last")["state"] == "succeeded"
            came = [receiver.next() for _ in range(4)]
            sent = [subscriber.next() for _ in range(4)]
            awaited(lambda: waiting(client) == [0, 0], "the end of the outbox")
            assert second.stop() == 0
        assert receiver.came.empty()
        assert subscriber.came.empty()
    finally:
        subscriber.close()
        receiver.close()
        broker.stop()
    assert {topic for topic, _ in sent} == {f"{PREFIX}/job.ended"}
    assert [body for _, body in sent] == [json.loads(each["raw"]) for each in came]
    assert [(each["job"]["label"], each["job"]["state"]) for each in came] == [
        ("done", "succeeded"),
        ("cancelled", "cancelled"),
        ("cut off", "interrupted"),
        ("last", "succeeded"),
    ]
    assert {(each["kind"], each["rig"], each["job"]["kind"], each["path"]) for each in came} == {
        ("job.ended", "small", "scan", PATH)
    }
    assert came[0]["job"]["links"]["self"] == done["links"]["self"]
    assert all(signed(each) and each["headers"]["webhook-id"] == each["id"] for each in came)
    assert len({each["id"] for each in came}) == 4
    log = first.log.read_text()
    for word in (PATH.rsplit("/", 1)[1], SECRET, SECRET.removeprefix("whsec_"), LOGIN.partition(":")[2]):
        assert word not in log


def scans(service: ServiceProcess, count: int) -> list[str]:
    with service.client() as client:
        return [str(client.scan().id) for _ in range(count)]


def copied(server: Postgres, rig: str) -> list[str]:
    rows = server.execute(f"SELECT job FROM finished_job WHERE rig = '{rig}' ORDER BY number", "fleet")  # noqa: S608
    return [job for (job,) in rows]


def has_come(server: Postgres, wanted: dict[str, list[str]]) -> None:
    awaited(lambda: all(len(copied(server, rig)) >= len(ids) for rig, ids in wanted.items()), "the copies")
    assert {rig: copied(server, rig) for rig in wanted} == wanted


def test_a_killed_database_costs_no_scan_and_no_row(start: Start, tmp_path: Path) -> None:
    with Postgres() as server:
        server.execute("CREATE DATABASE fleet")
        login = tmp_path / "login"
        login.touch(0o600)
        login.write_text(DATABASE_LOGIN)
        settings = {
            "SLRIG_CATALOGUE": server.address("fleet"),
            "SLRIG_CATALOGUE_LOGIN_FILE": str(login),
            "SLRIG_KEEP_SCANS": "1",
        }
        services = {}
        for name in ("hall-1", "hall-2"):
            rig = write_rig(tmp_path / name)
            rig.write_text(rig.read_text().replace('name = "small"', f'name = "{name}"', 1))
            services[name] = start(rig, tmp_path / f"{name}-data", **settings)
        wanted = {name: scans(service, 2) for name, service in services.items()}
        has_come(server, wanted)
        server.kill()
        for name, service in services.items():
            wanted[name] += scans(service, 2)
        server.start()
        has_come(server, wanted)
        server.kill()
        wanted["hall-1"] += scans(services["hall-1"], 1)
        # The rig, too, before it could report: what it has to report is on its disk.
        services["hall-1"].kill()
        server.start()
        services["hall-1"] = start(tmp_path / "hall-1" / "rig.toml", services["hall-1"].data, **settings)
        has_come(server, wanted)
        with services["hall-2"].client() as client:
            rigs = client.system.fleet()["rigs"]
        assert [(each["name"], each["scans_of_day"], each["uncopied"]) for each in rigs] == [
            ("hall-1", 5, 0), ("hall-2", 4, 0),
        ]  # fmt: skip
        for each in services.values():
            assert each.stop() == 0
        states = server.execute("SELECT state FROM rig", "fleet")
        assert states == [["stopped"], ["stopped"]]
        logs = "".join(each.log.read_text() for each in services.values())
        assert "this rig is not reported to the catalogue" in logs
        assert PASSWORD not in logs

"""The end of a job reaches a webhook and a broker, once and in order, through a kill of the service."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slrig.client import Client
from tests.e2e.conftest import SLOW, Start, ended, followed_to, scanned, write_rig
from tests.e2e.schedules import awaited
from tests.unit.schedule.hook import PATH, SECRET, Hook, signed
from tests.unit.schedule.mosquitto import LOGIN, PREFIX, Mosquitto, Subscriber

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

"""What tells others that a job is done: notices to a webhook and a broker, and one stream of the events of all jobs."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.e2e.conftest import KEY, ServiceProcess, Start, write_rig
from tests.e2e.schedules import awaited
from tests.e2e.test_calibration_walk import BOARD, SLOW, Caller
from tests.e2e.test_schedule_walk import calibrated_rig
from tests.e2e.test_survival import ended, followed_to
from tests.unit.schedule.hook import PATH, SECRET, Hook, signed
from tests.unit.schedule.mosquitto import LOGIN, PREFIX, Mosquitto, Subscriber

pytestmark = pytest.mark.slow


@pytest.fixture
def hook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Hook]]:
    """Opens the receiver that services of this test are told of; before that nobody listens there."""
    first = Hook()
    first.close()
    secret = tmp_path / "webhook-secret"
    secret.touch(0o600)
    secret.write_text(SECRET)
    monkeypatch.setenv("SLRIG_WEBHOOK_URL", first.url)
    monkeypatch.setenv("SLRIG_WEBHOOK_SECRET_FILE", str(secret))
    opened: list[Hook] = []

    def receiver() -> Hook:
        opened.append(Hook(port=first.port))
        return opened[-1]

    yield receiver
    for each in opened:
        each.close()


@pytest.fixture
def broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mosquitto]:
    """One that services of this test are told of, and that does not listen yet."""
    made = Mosquitto(tmp_path)
    monkeypatch.setenv("SLRIG_MQTT_URL", made.url)
    monkeypatch.setenv("SLRIG_MQTT_LOGIN", LOGIN)
    yield made
    made.stop()


def waiting(caller: Caller) -> list[float]:
    """How many notices wait for each receiver, by the service's metrics."""
    lines = caller.http.get("/metrics").text.splitlines()
    return [float(line.split()[1]) for line in lines if line.startswith("slrig_notices_waiting{")]


def test_every_end_is_told_once_in_order_and_signed_through_a_kill(
    start: Start, tmp_path: Path, hook: Callable[[], Hook], broker: Mosquitto
) -> None:
    rig = write_rig(tmp_path / "rig", head=SLOW)
    first = start(rig)
    with first.client() as client, Caller(first) as caller:
        done = ended(client, client.scans.start(label="done"))
        assert done["state"] == "succeeded"
        cancelled = client.scans.start(label="cancelled")
        followed_to(client, cancelled, "capture")
        caller.post(cancelled["links"]["cancel"], 202)
        assert ended(client, cancelled)["state"] == "cancelled"
        cut_off = client.scans.start(label="cut off")
        followed_to(client, cut_off, "capture")
        # Nobody listened so far, and nothing was held up by that.
        assert waiting(caller) == [2, 2]
        assert "a notice was not delivered" in first.log.read_text()
        first.kill()
    second = start(rig)
    with second.client() as client, Caller(second) as caller:
        assert ended(client, client.scans.start(label="later"))["state"] == "succeeded"
        assert waiting(caller) == [4, 4]
        receiver = hook()
        broker.start()
        subscriber = Subscriber(broker)
        came = [receiver.next() for _ in range(4)]
        awaited(lambda: waiting(caller) == [0, 0], "the end of the outbox")
        second.kill()
    third = start(rig)
    with third.client() as client, Caller(third) as caller:
        assert ended(client, client.scans.start(label="last"))["state"] == "succeeded"
        came.append(receiver.next())
        awaited(lambda: waiting(caller) == [0, 0], "the end of the outbox")
        assert third.stop() == 0
    assert receiver.came.empty(), "something was told twice"
    told = [subscriber.next() for _ in range(5)]
    subscriber.close()
    assert subscriber.came.empty(), "something was told twice"
    assert {topic for topic, _ in told} == {f"{PREFIX}/job.ended"}
    assert [body for _, body in told] == [json.loads(each["raw"]) for each in came]
    assert [(each["job"]["label"], each["job"]["state"]) for each in came] == [
        ("done", "succeeded"),
        ("cancelled", "cancelled"),
        ("cut off", "interrupted"),
        ("later", "succeeded"),
        ("last", "succeeded"),
    ]
    assert {(each["kind"], each["rig"], each["job"]["kind"], each["path"]) for each in came} == {
        ("job.ended", "small", "scan", PATH)
    }
    assert came[0]["job"]["links"]["self"] == done["links"]["self"]
    assert all(signed(each) and each["headers"]["webhook-id"] == each["id"] for each in came)
    assert len({each["id"] for each in came}) == 5
    log = first.log.read_text()
    assert "notice" in log
    for secret in (PATH.rsplit("/", 1)[1], SECRET, SECRET.removeprefix("whsec_"), LOGIN.partition(":")[2]):
        assert secret not in log


def test_receiver_that_hangs_holds_up_neither_a_job_nor_the_end(
    start: Start, tmp_path: Path, hook: Callable[[], Hook]
) -> None:
    service = start(write_rig(tmp_path / "rig"))
    receiver = hook()
    receiver.gate.clear()
    with service.client() as client:
        for _ in range(2):
            assert ended(client, client.scans.start())["state"] == "succeeded"
        receiver.next()
        began_s = time.monotonic()
        assert service.stop() == 0
        # One second is the notice's.
        assert time.monotonic() - began_s < 10
        receiver.gate.set()


@pytest.mark.parametrize(("secret", "word"), [("whsec_c2hvcnQ=", "expected whsec_"), ("missing", "cannot be read")])
def test_secret_that_is_none_ends_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, secret: str, word: str
) -> None:
    path = tmp_path / "secret"
    if secret != "missing":  # noqa: S105 - a case
        path.touch(0o600)
        path.write_text(secret)
    monkeypatch.setenv("SLRIG_WEBHOOK_URL", "http://127.0.0.1:9/hook")
    monkeypatch.setenv("SLRIG_WEBHOOK_SECRET_FILE", str(path))
    command = ["serve", str(write_rig(tmp_path / "rig")), "--port", "0", "--data", str(tmp_path / "data")]
    refused = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "slrig.cli", *command], capture_output=True, text=True, check=False, timeout=120
    )
    told = " ".join(refused.stderr.split())
    assert (refused.returncode, refused.stdout) == (2, "")
    assert f"webhook_secret_file: {path}" in told
    assert word in told
    assert "c2hvcnQ" not in told


FINAL = {"succeeded", "failed", "cancelled", "interrupted"}


class Follower:
    """Follows a stream on a thread of its own, until it ends. leaves : at the first end of a job."""

    def __init__(self, service: ServiceProcess, path: str, last: int | None = None, *, leaves: bool = False) -> None:
        self.seen: list[tuple[int, str, dict[str, Any]]] = []
        self.began = threading.Event()
        self.fault: Exception | None = None
        self._leaves = leaves
        self._http = httpx2.Client(base_url=service.url, headers={"X-API-Key": KEY}, timeout=60)
        headers = {} if last is None else {"Last-Event-ID": str(last)}
        self._thread = threading.Thread(target=self._follow, args=(path, headers), daemon=True)
        self._thread.start()
        assert self.began.wait(60)

    def _follow(self, path: str, headers: dict[str, str]) -> None:
        try:
            with self._http.sse(path, headers=headers) as source:
                assert source.response.status_code == 200
                self.began.set()
                for event in source:
                    if event.data:
                        self.seen.append((int(event.id), event.event, json.loads(event.data)))
                        if self._leaves and self.seen[-1][1] == "state" and self.seen[-1][2]["state"] in FINAL:
                            return
        except Exception as error:  # noqa: BLE001 - it is for the test to judge
            self.fault = error

    def ends_of(self, job: str) -> list[str]:
        """The final states that were told of a job."""
        events = [data for _, kind, data in self.seen if kind == "state" and data["job"]["id"] == job]
        return [data["state"] for data in events if data["state"] in FINAL]

    def ended(self) -> Exception | None:
        """Wait for the end of the stream; what went wrong until then."""
        self._thread.join(60)
        assert not self._thread.is_alive()
        self._http.close()
        return self.fault


def test_all_jobs_are_followed_by_two_one_of_whom_comes_back(start: Start, tmp_path: Path) -> None:
    service = start(calibrated_rig(tmp_path / "rig"))
    with Caller(service) as caller, service.client() as client:
        caller.ready()
        before = ended(client, client.scans.start(label="before"))
        oldest, newest = Follower(service, "/events?after=0"), Follower(service, "/events", leaves=True)
        scan = client.scans.start(label="cancelled")
        followed_to(client, scan, "capture")
        caller.post(scan["links"]["cancel"], 202)
        assert newest.ended() is None
        verification = caller.post("/rig/verification", 202, board=BOARD, position=1)
        awaited(lambda: oldest.ends_of(verification["id"]), "the verification")
        # The number in the header is the one that counts.
        back = Follower(service, "/events?after=0", newest.seen[-1][0])
        awaited(lambda: back.ends_of(verification["id"]), "the verification, later")
        waiting_scan = client.scans.start(label="cut off")
        followed_to(client, waiting_scan, "capture")
        own = caller.http.get(f"{before['links']['events']}", headers={"Last-Event-ID": "0"}).text
        began_s = time.monotonic()
        assert service.stop() == 0
        assert time.monotonic() - began_s < 10
    assert (oldest.ended(), back.ended()) == (None, None), "a stream broke instead of ending"
    for follower in (oldest, back):
        assert follower.ends_of(waiting_scan["id"]) == ["interrupted"], "the end of the service hid the end of a job"
    assert oldest.ends_of(before["id"]) == ["succeeded"]
    assert newest.ends_of(before["id"]) == [], "it began before it came"
    assert newest.ends_of(scan["id"]) == ["cancelled"]
    # What the one saw that came back is what the other saw that stayed, no more and no less.
    theirs = newest.seen + back.seen
    assert theirs == [each for each in oldest.seen if each[0] >= theirs[0][0]]
    numbers = [number for number, _, _ in oldest.seen]
    assert numbers == sorted(set(numbers))
    # Each event is as the job's own stream has it.
    of_before = [
        (kind, {name: value for name, value in data.items() if name != "job"})
        for _, kind, data in oldest.seen
        if data["job"]["id"] == before["id"]
    ]
    assert of_before == [
        (block.split("event: ")[1].split("\n")[0], json.loads(block.split("data: ")[1].split("\n")[0]))
        for block in own.split("\n\n")
        if "data: " in block
    ]
    of_verification = [data["job"] for _, _, data in oldest.seen if data["job"]["kind"] == "verification"]
    assert of_verification[0] == {
        "id": verification["id"],
        "kind": "verification",
        "label": None,
        "links": {name: verification["links"][name] for name in ("self", "events")},
    }

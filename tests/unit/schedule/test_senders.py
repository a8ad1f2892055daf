"""Notices: what the outbox keeps of runs, health and jobs; and their senders, a signed webhook and an MQTT broker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_args
from uuid import UUID, uuid4

import pytest
import structlog
from pydantic import SecretStr
from sqlalchemy.orm import Session

from slrig.config import NoticeKind, ServiceSettings, read_settings
from slrig.errors import ConfigError, StorageError
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobRecord, JobState, acting_as
from slrig.jobs.store import JobStore, Notice, Outbox
from slrig.schedule.notices import (
    NOTICE_KINDS,
    NoticedHealth,
    Receivers,
    Sender,
    Webhook,
    WebhookEntry,
    notice_run,
    senders_of,
    signature,
    signing_key,
)
from slrig.schedule.store import Cron, RunState, Schedule, ScheduledRun, ScheduleSpec, TaskKind
from tests.samples import put_database
from tests.unit.calibrate.health_bench import a_verification, hours
from tests.unit.jobs.tame_manager import PowerCut
from tests.unit.scan.fakes import WAIT_S, SetClock
from tests.unit.schedule.receivers import PATH, SECRET, Hook, own_certificate, signed

DUE = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
SCHEDULE = Schedule(UUID(int=7), ScheduleSpec(Cron("30 6 * * *", "Europe/Berlin"), TaskKind.VERIFICATION), DUE, DUE)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    made = Database(tmp_path / "slrig.sqlite")
    yield made
    made.close()


@pytest.fixture
def outbox(database: Database) -> Outbox:
    return Outbox(database, rig="bench", wanted={"webhook": get_args(NoticeKind)}, clock=lambda: DUE)


def told(outbox: Outbox) -> list[dict[str, Any]]:
    found = []
    while (notice := outbox.oldest("webhook")) is not None:
        found.append(dict(notice.body))
        outbox.sent(notice)
    return found


def run(state: RunState, *, count: int = 1) -> ScheduledRun:
    return ScheduledRun(4, SCHEDULE.id, DUE, state, "rig busy: a scan", count, 1, DUE, None, None, None, None)


def test_runs_that_need_a_person_give_a_notice_and_no_others(database: Database, outbox: Outbox) -> None:
    with database.changing() as session:
        for state in RunState:
            notice_run(outbox, session, SCHEDULE, run(state, count=3))
    sent = told(outbox)
    assert len(sent) == len(NOTICE_KINDS)
    assert {each["kind"] for each in sent} == {"run.missed", "run.skipped", "run.failed", "run.interrupted"}
    skipped = next(each for each in sent if each["kind"] == "run.skipped")
    assert skipped["words"] == (
        "rig 'bench': verification due 2026-11-23 06:30 +0100 was skipped, 3 times: rig busy: a scan"
    )
    assert skipped["run"] == {
        "number": 4, "due": DUE.isoformat(), "state": "skipped", "reason": "rig busy: a scan", "count": 3,
    }  # fmt: skip
    assert skipped["schedule"]["id"] == str(SCHEDULE.id)
    assert (skipped["at"], skipped["rig"]) == ("2026-11-23T05:30:00.000+00:00", "bench")
    assert len({each["id"] for each in sent}) == len(sent)


def test_health_gives_a_notice_when_it_changes(database: Database, outbox: Outbox) -> None:
    health = NoticedHealth(database, outbox)
    knocked = a_verification(6.0, evidence=400.0)
    for hour, look in enumerate([a_verification(), a_verification(), knocked, knocked]):
        health.add(look, calibration="one", at=hours(hour))
    health.add(a_verification(), calibration="two", at=hours(9))
    first, second = told(outbox)
    assert (first["kind"], first["health"]["before"], first["health"]["state"]) == ("health.changed", "good", "stale")
    assert "turned by 0.050" in first["words"]
    assert (second["health"]["before"], second["health"]["state"]) == ("stale", "good")


def test_end_of_a_job_of_any_kind_gives_one_notice(database: Database, outbox: Outbox) -> None:
    parent, at = uuid4(), JobState
    fault = JobFailure("pose-refused", "no board is in view")
    made: list[tuple[JobKind, dict[str, Any], UUID | None, JobState, dict[str, str]]] = [
        (JobKind.SCAN, {}, None, at.SUCCEEDED, {"self": "/scan/{id}", "events": "/scan/{id}/events"}),
        (JobKind.SCAN, {}, parent, at.CANCELLED, {
            "self": "/scan/{id}", "events": "/scan/{id}/events", "series": "/scan/series/{parent}",
        }),
        (JobKind.POSE, {"number": 3}, parent, at.FAILED, {
            "self": "/calibration/{parent}/pose/3", "events": "/calibration/{parent}/events",
            "calibration": "/calibration/{parent}",
        }),
        (JobKind.SOLVE, {"number": 1}, parent, at.INTERRUPTED, {
            "self": "/calibration/{parent}", "events": "/calibration/{parent}/events",
            "calibration": "/calibration/{parent}",
        }),
        (JobKind.VERIFICATION, {}, None, at.SUCCEEDED, {
            "self": "/rig/verification/{id}", "events": "/rig/verification/{id}/events",
        }),
        (JobKind.POSITION, {}, parent, at.SUCCEEDED, {
            "self": "/acceptance/{parent}", "acceptance": "/acceptance/{parent}",
        }),
    ]  # fmt: skip
    for kind, plan, of, state, links in made:
        jobs = JobStore(database, outbox=outbox, clock=lambda: DUE)
        with acting_as("Ann"):
            job = jobs.create(plan, kind=kind, rig="bench", label="by hand", parent=of)
        jobs.advance(job.id, JobState.CAPTURING)
        assert told(outbox) == [], "it has not ended"
        jobs.finish(job.id, state, fault=fault if state is at.FAILED else None)
        assert not jobs.finish(job.id, JobState.FAILED)
        (one,) = told(outbox)
        assert (one["kind"], one["job"]["kind"], one["job"]["state"]) == ("job.ended", kind, state)
        assert (one["job"]["id"], one["job"]["label"], one["job"]["requested_by"]) == (str(job.id), "by hand", "Ann")
        assert one["job"]["links"] == {
            name: link.format(id=job.id, parent=parent) for name, link in links.items()
        }, kind  # fmt: skip
        assert one["job"]["finished_at"] == one["job"]["started_at"] == "2026-11-23T05:30:00.000+00:00"
        assert one["job"]["error"] == (
            {"code": "pose-refused", "message": "no board is in view"} if state is at.FAILED else None
        )  # fmt: skip
    assert one["words"] == f"rig 'bench': position {job.id} succeeded"


def test_end_and_notice_are_recorded_together_or_not_at_all(
    database: Database, outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = JobStore(database, outbox=outbox)
    job = jobs.create({}, kind=JobKind.SCAN, rig="bench", label=None)

    def put(*_: object, **__: object) -> None:
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(outbox, "put", put)
        with pytest.raises(PowerCut):
            jobs.finish(job.id, JobState.SUCCEEDED)
    assert jobs.get(job.id).state is JobState.QUEUED
    assert [event.kind for event in jobs.events(job.id, after=0)] == ["state"]

    ended = outbox.ended

    def cut_off(session: Session, job: JobRecord) -> None:
        ended(session, job)
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(outbox, "ended", cut_off)
        with pytest.raises(PowerCut):
            jobs.finish(job.id, JobState.SUCCEEDED)
    assert (told(outbox), outbox.news["webhook"].is_set()) == ([], False)
    jobs.finish(job.id, JobState.SUCCEEDED)
    assert outbox.news["webhook"].is_set()
    assert [each["job"]["state"] for each in told(outbox)] == ["succeeded"]


def test_kinds_that_are_not_wanted_are_not_kept(database: Database) -> None:
    outbox = Outbox(database, rig="bench", wanted={"webhook": ["run.failed"]})
    jobs = JobStore(database, outbox=outbox)
    jobs.finish(jobs.create({}, kind=JobKind.SCAN, rig="bench", label=None).id, JobState.SUCCEEDED)
    with database.changing() as session:
        notice_run(outbox, session, SCHEDULE, run(RunState.MISSED))
        notice_run(outbox, session, SCHEDULE, run(RunState.FAILED))
    assert [each["kind"] for each in told(outbox)] == ["run.failed"]


KEY = signing_key(SECRET, "here")
BODY = b'{"test": 2432232314}'


class Bench:
    """An outbox on a manual clock, and the sender of a webhook, stepped by the test."""

    receiver = "webhook"

    def __init__(self, folder: Path, url: str, *, most: int = 10_000) -> None:
        self.clock = SetClock()
        self.database = Database(put_database(folder / "slrig.sqlite"))
        wanted = {self.receiver: get_args(NoticeKind)}
        self.outbox = Outbox(self.database, rig="bench", wanted=wanted, clock=self.clock, most=most)
        self.sender = self.open_sender(url)

    def open_sender(self, url: str) -> Sender:
        return Webhook(self.outbox, url, KEY, clock=self.clock, timeout_s=0.5)

    @property
    def waiting(self) -> int:
        return self.outbox.waiting(self.sender.receiver)[0]

    def put(self, *names: str) -> None:
        for name in names:
            with self.database.changing() as session:
                self.outbox.put(session, "run.failed", name)

    def pass_time(self, until: timedelta) -> list[float]:
        """Step as the clock says until it has moved on by so much. Returns how long it waited between steps."""
        end, waits = self.clock.now + until, []
        while self.clock.now < end:
            wait_s = self.sender.step()
            assert wait_s is not None
            waits.append(wait_s)
            self.clock.move(seconds=wait_s)
        return waits

    def empty(self) -> None:
        """Step until nothing waits; nothing may fail."""
        while (wait_s := self.sender.step()) is not None:
            assert wait_s == 0

    def fails(self) -> str:
        """Step once; the try has to fail. Returns its cause."""
        with structlog.testing.capture_logs() as log:
            assert self.sender.step() == 1
        # Threads of other tests may still log.
        (line,) = (each for each in log if each["event"] == "a notice was not delivered")
        assert (line["host"], line["tries"]) == ("127.0.0.1", 1)
        assert "hidden-part" not in str(log)
        return str(line["cause"])

    def close(self) -> None:
        self.sender.close()
        self.database.close()


@pytest.fixture
def hook() -> Iterator[Hook]:
    made = Hook()
    yield made
    made.close()


@pytest.fixture
def bench(tmp_path: Path, hook: Hook) -> Iterator[Bench]:
    made = Bench(tmp_path, hook.url)
    yield made
    made.close()


def came(hook: Hook) -> list[dict[str, Any]]:
    return [hook.came.get() for _ in range(hook.came.qsize())]


def names(hook: Hook) -> list[str]:
    return [each["words"].removeprefix("rig 'bench': ") for each in came(hook)]


def test_signature_is_that_of_the_published_vector() -> None:
    made = signature(KEY, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, BODY)
    assert made == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
    headers = {
        "webhook-id": "msg_p5jXN8AQM9LWM0D4loKWxJek", "webhook-timestamp": "1614265330", "webhook-signature": made,
    }  # fmt: skip
    assert signed({"headers": headers, "raw": BODY}), "the tests' own reading of the specification"
    assert not signed({"headers": headers, "raw": BODY + b" "})
    assert not signed({"headers": {**headers, "webhook-timestamp": "1614265331"}, "raw": BODY})


def test_notice_is_signed_with_the_time_of_the_try_and_keeps_its_id(bench: Bench, hook: Hook) -> None:
    bench.put("of a ß")
    hook.status = 503
    bench.sender.step()
    bench.clock.move(seconds=90)
    hook.status = 200
    bench.empty()
    first, second = came(hook)
    for one in (first, second):
        assert signed(one)
        assert not signed(one, "whsec_" + "A" * 32)
        assert one["headers"]["webhook-id"] == one["id"]
        assert one["headers"]["content-type"] == "application/json"
        assert (one["path"], one["at"]) == (PATH, "2026-11-21T12:00:00.000+00:00")
    assert first["raw"] == second["raw"]
    tries = [datetime.fromtimestamp(int(each["headers"]["webhook-timestamp"]), UTC) for each in (first, second)]
    assert tries == [bench.clock.now - timedelta(seconds=90), bench.clock.now]
    bench.put("unsigned")
    Webhook(bench.outbox, hook.url, None, clock=bench.clock).step()
    (third,) = came(hook)
    assert "webhook-signature" not in third["headers"]
    assert third["headers"]["webhook-id"] == third["id"]


def test_receiver_that_is_down_for_an_hour_gets_all_once_and_in_order(bench: Bench, hook: Hook) -> None:
    hook.status = 500
    bench.put("1", "2")
    waits = bench.pass_time(timedelta(hours=1))
    assert waits[:10] == [1, 2, 4, 8, 16, 32, 64, 128, 256, 300]
    assert set(waits[10:]) == {300}
    # The first one is tried again and again, and none passes it.
    assert set(names(hook)) == {"1"}
    bench.put("3")
    count, age_s = bench.outbox.waiting("webhook")
    assert (count, age_s >= 3600) == (3, True)
    hook.status = 204
    bench.empty()
    assert names(hook) == ["1", "2", "3"]
    assert (bench.outbox.waiting("webhook"), bench.outbox.dropped) == ((0, 0.0), 0)
    # What fails next begins with a short wait again.
    hook.status = 500
    bench.put("4")
    assert bench.sender.step() == 1


def test_what_waits_outlives_a_kill_and_what_was_taken_then_comes_again_under_its_id(
    tmp_path: Path, bench: Bench, hook: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_off(_: Notice) -> None:
        raise PowerCut

    bench.put("1", "2")
    monkeypatch.setattr(bench.outbox, "sent", cut_off)
    with pytest.raises(PowerCut):
        bench.sender.step()
    again = Bench(tmp_path, hook.url)
    again.empty()
    told = came(hook)
    assert [each["words"] for each in told] == [f"rig 'bench': {name}" for name in ("1", "1", "2")]
    assert told[0]["id"] == told[1]["id"] != told[2]["id"]
    again.database.close()


def test_three_days_are_long_enough_and_the_log_says_what_went(bench: Bench, hook: Hook) -> None:
    hook.status = 500
    bench.put("old", "as old")
    bench.clock.move(hours=71)
    bench.put("young")
    with structlog.testing.capture_logs() as log:
        bench.pass_time(timedelta(hours=2))
    (dropped,) = [each for each in log if each["event"] == "notices were dropped"]
    assert (dropped["count"], dropped["cause"]) == (2, "they have waited for 72 hours")
    assert bench.outbox.dropped == 2
    came(hook)
    hook.status = 200
    bench.empty()
    assert names(hook) == ["young"]


def test_no_more_wait_than_may_and_the_oldest_go(tmp_path: Path, hook: Hook) -> None:
    bench = Bench(tmp_path, hook.url, most=3)
    bench.put("0")
    bench.empty()
    came(hook)
    with structlog.testing.capture_logs() as log:
        bench.put("1", "2", "3", "4", "5")
    assert [each["cause"] for each in log] == 2 * ["more than 3 wait"]
    assert (bench.waiting, bench.outbox.dropped) == (3, 2)
    bench.empty()
    assert names(hook) == ["3", "4", "5"]
    bench.database.close()


def test_receiver_that_is_gone_gets_nothing_more_from_this_process(tmp_path: Path, bench: Bench, hook: Hook) -> None:
    hook.status = 410
    bench.put("1")
    with structlog.testing.capture_logs() as log:
        assert bench.sender.step() == 300
    assert [each["event"] for each in log] == [
        "the receiver is gone: nothing is sent before the next start of the service"
    ]
    hook.status = 200
    bench.put("2")
    assert bench.sender.step() == 300
    assert names(hook) == ["1"]
    again = Bench(tmp_path, hook.url)
    again.empty()
    assert names(hook) == ["1", "2"]
    again.database.close()


def test_redirect_is_not_followed(bench: Bench, hook: Hook) -> None:
    hook.status, hook.headers = 307, {"Location": hook.url}
    bench.put("1")
    assert bench.fails() == "status 307"
    assert names(hook) == ["1"]
    hook.status = 303
    assert bench.sender.step() == 2
    assert names(hook) == ["1"]


HOW: dict[str, Callable[[Hook], object]] = {
    "refuses": Hook.close,
    "hangs": lambda hook: hook.gate.clear(),
    "drips": lambda hook: setattr(hook, "drips", True),
}


@pytest.mark.parametrize("how", HOW)
def test_receiver_without_an_answer_costs_one_try(bench: Bench, hook: Hook, how: str) -> None:
    HOW[how](hook)
    bench.put("1")
    # A receiver that hangs answers in the end, and so a sender that waited for it would succeed.
    bench.fails()
    assert bench.waiting == 1


def test_certificate_of_an_unknown_authority_is_refused(tmp_path: Path) -> None:
    pem = own_certificate(tmp_path)
    hook = Hook(certificate=pem)
    bench = Bench(tmp_path, hook.url)
    bench.put("1")
    assert bench.fails() == "ConnectError"
    assert hook.came.empty()
    hook.close()
    bench.database.close()


def test_notice_that_was_taken_is_not_sent_again_while_the_records_refuse(
    bench: Bench, hook: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Notice) -> None:
        raise StorageError("the disk is full")

    bench.put("1", "2")
    with monkeypatch.context() as patch:
        patch.setattr(bench.outbox, "sent", refuse)
        for _ in range(3):
            with pytest.raises(StorageError):
                bench.sender.step()
    bench.empty()
    assert names(hook) == ["1", "2"]


def test_thread_sends_what_waits_and_what_comes_and_ends_when_closed(bench: Bench, hook: Hook) -> None:
    bench.put("1")
    bench.sender.start()
    assert hook.next()["words"].endswith("1")
    bench.put("2", "3")
    assert [hook.next()["words"][-1] for _ in range(2)] == ["2", "3"]
    bench.put("4")
    bench.sender.close()
    bench.sender.close()
    assert hook.next()["words"].endswith("4")
    bench.sender._thread.join(WAIT_S)
    assert bench.waiting == 0


@pytest.mark.parametrize("how", ["refuses", "hangs"])
def test_end_of_the_service_does_not_wait_for_a_receiver(
    bench: Bench, hook: Hook, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slrig.schedule.notices._END_S", 0.01)
    HOW[how](hook)
    bench.sender = Webhook(bench.outbox, hook.url, KEY, timeout_s=WAIT_S)
    bench.sender.start()
    bench.put("1")
    if how == "hangs":
        hook.next()
    bench.put("2")
    bench.sender.close()
    thread = bench.sender._thread
    assert thread.is_alive() or how == "refuses", "it was closed while the receiver held it"
    assert bench.waiting == 2
    hook.close()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    assert bench.waiting == 2, "what is answered later is for the next start"


@pytest.mark.parametrize("secret", ["whsec_c2hvcnQ=", "whsec_" + "A" * 88, "no base64!", "whsec_", "ß"])
def test_secret_that_is_none_is_refused_and_not_repeated(secret: str, tmp_path: Path, bench: Bench) -> None:
    path = tmp_path / "secret"
    path.write_text(secret)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match=r"^webhook_secret: expected whsec_") as of_text:
        senders_of(ServiceSettings(webhook_url="http://host", webhook_secret=SecretStr(secret)), bench.outbox)
    with pytest.raises(ConfigError, match=r"^webhook_secret_file: ") as of_file:
        senders_of(ServiceSettings(webhook_url="http://host", webhook_secret_file=path), bench.outbox)
    if hidden := secret.removeprefix("whsec_"):
        assert hidden not in f"{of_text.value} {of_file.value}"


def test_secret_may_lie_in_a_file_that_only_its_owner_may_read(tmp_path: Path, bench: Bench, hook: Hook) -> None:
    path = tmp_path / "secret"
    settings = ServiceSettings(webhook_url=hook.url, webhook_secret_file=path)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        senders_of(settings, bench.outbox)
    path.write_text(f"{SECRET}\n")
    path.chmod(0o600)
    (webhook,) = senders_of(settings, bench.outbox)
    assert webhook.refusal(Notice(1, "msg_1", {})) is None
    assert signed(hook.next())
    path.chmod(0o640)
    with pytest.raises(ConfigError, match=r"may be read by others.*chmod 600"):
        senders_of(settings, bench.outbox)
    assert signing_key(SECRET.removeprefix("whsec_"), "here") == KEY


def test_settings_choose_kinds_and_hide_the_secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ServiceSettings().webhook_kinds == get_args(NoticeKind)
    assert ServiceSettings().webhook_url is None
    monkeypatch.setenv("SLRIG_WEBHOOK_KINDS", "job.ended, run.failed")
    monkeypatch.setenv("SLRIG_WEBHOOK_SECRET", SECRET)
    settings = read_settings()
    assert settings.webhook_kinds == ("job.ended", "run.failed")
    assert settings.webhook_secret == SecretStr(SECRET)
    assert SECRET not in repr(settings)
    with pytest.raises(ConfigError, match="webhook_kinds"):
        read_settings(webhook_kinds=("job.began",))
    file = tmp_path / "settings.toml"
    file.write_text('webhook_secret_file = "secret"\n')
    assert read_settings(file).webhook_secret_file == tmp_path / "secret"
    monkeypatch.delenv("SLRIG_WEBHOOK_SECRET")
    file.write_text("webhook_secret = 123456789\n")
    with pytest.raises(ConfigError, match="webhook_secret: expected a text") as error:
        read_settings(file)
    assert "123456789" not in str(error.value)


@pytest.mark.parametrize("url", ["ftp://host/hook", "host/hook", "http:///hook"])
def test_address_that_is_none_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ConfigError, match="webhook_url: expected an address that begins with http") as error:
        read_settings(webhook_url=url)
    assert url not in str(error.value)


def test_what_waits_for_a_receiver_that_is_no_longer_named_is_dropped_as_late_as_any(tmp_path: Path) -> None:
    clock, database = SetClock(), Database(tmp_path / "slrig.sqlite")
    both, one = ({name: get_args(NoticeKind) for name in names} for names in (("mqtt", "webhook"), ("webhook",)))
    for wanted, passed_h, left in ((both, 0, 1), (one, 71, 1), (one, 2, 0)):
        clock.now += timedelta(hours=passed_h)
        outbox = Outbox(database, rig="bench", wanted=wanted, clock=clock)
        with database.changing() as session:
            outbox.put(session, "run.failed", "a run")
        assert outbox.waiting("mqtt")[0] == left


def test_a_webhook_is_set_tried_and_removed_while_the_service_runs(tmp_path: Path, bench: Bench, hook: Hook) -> None:
    outbox = Outbox(bench.database, rig="bench")
    receivers = Receivers(ServiceSettings(), outbox, tmp_path)
    with pytest.raises(ConfigError, match=r"no receiver 'webhook'.*: none"):
        receivers.get("webhook")
    receivers.start()
    receivers.set_webhook(WebhookEntry(url="http://127.0.0.1:1/elsewhere", kinds=("run.failed",)))
    assert receivers.get("webhook").try_out().answer.startswith("no connection")
    receivers.set_webhook(WebhookEntry(url=hook.url, kinds=("run.failed",)))
    tried = receivers.get("webhook").try_out()
    assert (tried.taken, tried.answer, hook.next()["words"]) == (True, "status 204", tried.sent["words"])
    hook.status = 500
    assert (receivers.get("webhook").try_out().taken, hook.next()["kind"]) == (False, "test")
    hook.status = 204
    with bench.database.changing() as session:
        outbox.put(session, "run.missed", "not wanted")
        outbox.put(session, "run.failed", "wanted")
    assert hook.next()["words"] == "rig 'bench': wanted"
    receivers.close()

    again = Receivers(ServiceSettings(), outbox, tmp_path)
    assert again.get("webhook").try_out().taken
    hook.next()
    assert (tmp_path / "webhook.json").stat().st_mode & 0o077 == 0
    with bench.database.changing() as session:
        outbox.put(session, "run.failed", "too late")
    again.remove_webhook()
    assert (outbox.waiting("webhook")[0], outbox.wanted, again.senders) == (0, {}, {})
    assert not Receivers(ServiceSettings(), outbox, tmp_path).senders
    (tmp_path / "webhook.json").write_text("damaged")
    with structlog.testing.capture_logs() as log:
        assert not Receivers(ServiceSettings(), outbox, tmp_path).senders
    assert [each["event"] for each in log] == ["the webhook gets no notices: set it again"]

    outbox = Outbox(bench.database, wanted={"webhook": ["run.failed"]})
    fixed = Receivers(ServiceSettings(webhook_url=hook.url), outbox, tmp_path)
    with pytest.raises(ConfigError, match="webhook_url"):
        fixed.set_webhook(WebhookEntry(url="http://host"))

"""Notices to an MQTT broker: addresses, logins and certificates. tests/e2e/test_signals has them come in order."""

from __future__ import annotations

import builtins
import socket
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, get_args

import pytest
import structlog
from pydantic import SecretStr

from slrig.config import NoticeKind, ServiceSettings, read_settings
from slrig.errors import ConfigError
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.schedule.mqtt import Broker
from slrig.schedule.receivers import senders_of, wanted_kinds
from tests.unit.scan.fakes import SetClock
from tests.unit.schedule.hook import own_certificate
from tests.unit.schedule.mosquitto import LOGIN, Mosquitto


class Bench:
    """An outbox for a broker, which is sent to when a test says."""

    def __init__(self, folder: Path, url: str, login: str | None = LOGIN, *, timeout_s: float = 5.0) -> None:
        self.database = Database(folder / "slrig.sqlite")
        self.outbox = Outbox(self.database, rig="bench", wanted={"mqtt": get_args(NoticeKind)})
        self.broker = Broker(self.outbox, url, login, timeout_s=timeout_s)

    def put(self, words: str) -> None:
        with self.database.changing() as session:
            self.outbox.put(session, "job.ended", words)

    def empty(self) -> None:
        """Step until nothing waits; nothing may fail."""
        while (wait_s := self.broker.step()) is not None:
            assert wait_s == 0


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path)
    yield made
    made.stop()


@pytest.mark.slow
@pytest.mark.parametrize("login", ["rig:wrong", None])
def test_what_a_broker_refuses_waits(tmp_path: Path, broker: Mosquitto, login: str | None) -> None:
    broker.start()
    bench = Bench(tmp_path, broker.url, login)
    bench.put("1")
    with structlog.testing.capture_logs() as log:
        assert bench.broker.step() == 1
    # A wrong password is refused at the connection, a user without rights at the notice.
    assert [line["cause"] for line in log] == ["Not authorized"]
    assert "wrong" not in str(log)
    bench.put("2")
    bench.broker = Broker(bench.outbox, broker.url, LOGIN)
    bench.empty()
    bench.database.close()


def test_broker_that_gives_no_answer_costs_one_try(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client", reason="needs paho-mqtt: pip install 'slrig[mqtt]'")
    with socket.create_server(("127.0.0.1", 0)) as deaf, structlog.testing.capture_logs() as log:
        bench = Bench(tmp_path, f"mqtt://127.0.0.1:{deaf.getsockname()[1]}/x", timeout_s=0.2)
        bench.put("1")
        assert bench.broker.step() == 1
    assert [line["cause"] for line in log] == ["no answer"]
    bench.database.close()


@pytest.mark.slow
# The library leaves the socket of a handshake that fails to Python's collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_certificate_counts_where_its_authority_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pem = own_certificate(tmp_path)
    broker = Mosquitto(tmp_path, certificate=pem)
    broker.start()
    bench = Bench(tmp_path, broker.url)
    bench.put("1")
    with structlog.testing.capture_logs() as log:
        assert bench.broker.step() == 1
    # Threads of other tests may still log.
    assert [line["cause"] for line in log if "cause" in line] == ["SSLCertVerificationError"]
    monkeypatch.setenv("SSL_CERT_FILE", str(pem))
    bench.broker = Broker(bench.outbox, broker.url, LOGIN)
    bench.empty()
    assert bench.outbox.waiting("mqtt")[0] == 0
    bench.database.close()
    broker.stop()


@pytest.mark.parametrize(
    "url",
    [
        "http://host/rig", "mqtt://host", "mqtt://host/", "mqtt:///rig", "mqtt://ann:secret@host/rig",
        "mqtt://host:70000/rig", "mqtt://host/rig/#", "mqtt://host/+/rig", "mqtt://host/rig?x=secret",
    ],
)  # fmt: skip
def test_invalid_address_is_refused_and_not_repeated(tmp_path: Path, url: str) -> None:
    pytest.importorskip("paho.mqtt.client", reason="needs paho-mqtt: pip install 'slrig[mqtt]'")
    with pytest.raises(ConfigError, match=r"^mqtt_url: expected mqtt://HOST:PORT/PREFIX") as error:
        Bench(tmp_path, url)
    assert "secret" not in str(error.value)


def test_settings_name_a_broker_and_hide_the_login(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert wanted_kinds(ServiceSettings()) == {}
    login = tmp_path / "login"
    login.write_text(f"{LOGIN}\n")
    login.chmod(0o644)
    file = tmp_path / "settings.toml"
    file.write_text('mqtt_url = "mqtt://[::1]/rigs/"\nmqtt_login_file = "login"\n')
    settings, outbox = read_settings(file), Outbox(Database(tmp_path / "slrig.sqlite"))
    assert wanted_kinds(settings) == {"mqtt": get_args(NoticeKind)}
    with pytest.raises(ConfigError, match=r"mqtt_login_file: .* may be read by others.*chmod 600"):
        senders_of(settings, outbox)
    monkeypatch.setenv("SLRIG_MQTT_LOGIN", LOGIN)
    settings = read_settings(file)
    assert settings.mqtt_login == SecretStr(LOGIN)
    assert LOGIN not in repr(settings)

    real = builtins.__import__

    def without(name: str, *given: Any, **named: Any) -> Any:
        if name.startswith("paho"):
            raise ModuleNotFoundError(name)
        return real(name, *given, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        ConfigError, match=r"^mqtt_url needs a library.* pip install 'slrig\[mqtt\]', or leave mqtt_url out$"
    ):
        senders_of(settings, outbox)


def test_what_waits_for_a_receiver_that_is_no_longer_named_is_dropped_as_late_as_any(tmp_path: Path) -> None:
    clock, database = SetClock(), Database(tmp_path / "slrig.sqlite")
    both, one = ({name: get_args(NoticeKind) for name in names} for names in (("mqtt", "webhook"), ("webhook",)))
    for wanted, hours, left in ((both, 0, 1), (one, 71, 1), (one, 2, 0)):
        clock.now += timedelta(hours=hours)
        outbox = Outbox(database, rig="bench", wanted=wanted, clock=clock)
        with database.changing() as session:
            outbox.put(session, "run.failed", "a run")
        assert outbox.waiting("mqtt")[0] == left

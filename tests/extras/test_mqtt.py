"""Notices at a broker of MQTT 5: mosquitto, and one that does not answer."""

from __future__ import annotations

import builtins
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import SecretStr

from slrig.config import NoticeKind, ServiceSettings, read_settings
from slrig.errors import ConfigError
from slrig.extras.mqtt import Broker
from slrig.jobs.database import Database
from slrig.jobs.store import Outbox
from slrig.schedule.notices import Sender, senders_of, wanted_kinds
from tests.unit.schedule.receivers import LOGIN, Mosquitto, own_certificate
from tests.unit.schedule.test_senders import Bench

pytestmark = pytest.mark.slow


class BrokerBench(Bench):
    """An outbox on a manual clock, and the sender of a broker, stepped by the test."""

    receiver = "mqtt"

    def open_sender(self, url: str) -> Sender:
        return Broker(self.outbox, url, LOGIN)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path)
    yield made
    made.stop()


@pytest.mark.parametrize("login", ["rig:wrong", None])
def test_what_a_broker_refuses_waits(tmp_path: Path, broker: Mosquitto, login: str | None) -> None:
    broker.start()
    bench = BrokerBench(tmp_path, broker.url)
    bench.sender = Broker(bench.outbox, broker.url, login)
    bench.put("1")
    # A wrong password is refused at the connection, a user without rights at the notice.
    assert bench.fails() == "Not authorized"
    bench.put("2")
    bench.sender = Broker(bench.outbox, broker.url, LOGIN)
    bench.empty()
    bench.close()


def test_broker_that_gives_no_answer_costs_one_try(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client", reason="needs paho-mqtt: pip install 'slrig[mqtt]'")
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        url = f"mqtt://127.0.0.1:{deaf.getsockname()[1]}/x"
        bench = BrokerBench(tmp_path, url)
        bench.sender = Broker(bench.outbox, url, LOGIN, timeout_s=0.2)
        bench.put("1")
        assert bench.fails() == "no answer"
    bench.close()


# The library leaves the socket of a handshake that fails to Python's collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_certificate_of_a_broker_counts_where_its_authority_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pem = own_certificate(tmp_path)
    broker = Mosquitto(tmp_path, certificate=pem)
    broker.start()
    bench = BrokerBench(tmp_path, broker.url)
    bench.put("1")
    assert bench.fails() == "SSLCertVerificationError"
    monkeypatch.setenv("SSL_CERT_FILE", str(pem))
    bench.sender = Broker(bench.outbox, broker.url, LOGIN)
    bench.empty()
    bench.close()
    broker.stop()


@pytest.mark.parametrize(
    "url",
    [
        "http://host/rig", "mqtt://host", "mqtt://host/", "mqtt:///rig", "mqtt://ann:secret@host/rig",
        "mqtt://host:70000/rig", "mqtt://host/rig/#", "mqtt://host/+/rig", "mqtt://host/rig?x=secret",
    ],
)  # fmt: skip
def test_invalid_address_of_a_broker_is_refused_and_not_repeated(tmp_path: Path, url: str) -> None:
    pytest.importorskip("paho.mqtt.client", reason="needs paho-mqtt: pip install 'slrig[mqtt]'")
    outbox = BrokerBench(tmp_path, "mqtt://host/rig").outbox
    with pytest.raises(ConfigError, match=r"^mqtt_url: expected mqtt://HOST:PORT/PREFIX") as error:
        Broker(outbox, url, LOGIN)
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

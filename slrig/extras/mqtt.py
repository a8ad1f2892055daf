"""Notices published at a broker of MQTT 5."""

from __future__ import annotations

import re
import ssl
import time
from typing import TYPE_CHECKING

from slrig.config import ServiceSettings
from slrig.errors import ConfigError
from slrig.jobs.store import Notice, Outbox
from slrig.schedule.notices import TIMEOUT_S, Sender, secret_of

if TYPE_CHECKING:
    from paho.mqtt.reasoncodes import ReasonCode

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_ADDRESS = re.compile(
    r"(?P<scheme>mqtts?)://(?P<host>[^\s/?#@:\[\]]+|\[[\da-fA-F:.]+\])(:(?P<port>\d{1,5}))?"
    r"/(?P<prefix>[^\s+#?\0]*[^\s+#?\0/])/?"
)
_LOOP_S = 0.5


def open_broker(settings: ServiceSettings, outbox: Outbox) -> Broker:
    """Return the sender of notices to the broker of `mqtt_url`. Raises ConfigError."""
    login, _ = secret_of(settings.mqtt_login, settings.mqtt_login_file, "mqtt_login")
    return Broker(outbox, settings.mqtt_url or "", login)


class Broker(Sender):
    """Publishes each notice with QoS 1 as `PREFIX/KIND`. It needs MQTT 5: older brokers acknowledge what they discard.

    url : `mqtt://HOST:PORT/PREFIX`, or `mqtts` with TLS. login : `USER:PASSWORD`. Raises ConfigError, which does not
    repeat the address: it may hold a password.
    """

    receiver = "mqtt"

    def __init__(self, outbox: Outbox, url: str, login: str | None, *, timeout_s: float = TIMEOUT_S) -> None:
        try:
            import paho.mqtt.client  # noqa: F401 - loaded by those who use it
        except ImportError as error:
            message = "mqtt_url needs a library that is not installed: pip install 'slrig[mqtt]', or leave mqtt_url out"
            raise ConfigError(message) from error
        found = _ADDRESS.fullmatch(url)
        if found is None or int(found["port"] or 1) not in range(1, 65536):
            message = (
                "mqtt_url: expected mqtt://HOST:PORT/PREFIX, or mqtts with TLS, where PREFIX begins the topics and has "
                "no + and no #. User and password belong into mqtt_login or mqtt_login_file"
            )
            raise ConfigError(message)
        super().__init__(outbox, found["host"].strip("[]"))
        self._port = int(found["port"] or _PORTS[found["scheme"]])
        self._prefix = found["prefix"]
        self._login = None if login is None else login.strip().partition(":")
        self._tls = ssl.create_default_context() if found["scheme"] == "mqtts" else None
        self._timeout_s = timeout_s

    def refusal(self, notice: Notice) -> str | None:
        """See `Sender`."""
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        answers: list[ReasonCode] = []

        def connected(client: Client, _data: object, _flags: object, code: ReasonCode, _more: object) -> None:
            if code.is_failure:
                answers.append(code)
            else:
                client.publish(f"{self._prefix}/{notice.body['kind']}", notice.content, qos=1)

        client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
        client.on_connect = connected
        client.on_publish = lambda _client, _data, _number, code, _more: answers.append(code)
        client.connect_timeout = self._timeout_s
        if self._login is not None:
            client.username_pw_set(self._login[0], self._login[2])
        if self._tls is not None:
            client.tls_set_context(self._tls)
        end_s = time.monotonic() + self._timeout_s
        client.connect(self.host, self._port)
        try:
            while not answers and time.monotonic() < end_s:
                if client.loop(_LOOP_S) and not answers:
                    return "the connection was lost"
        finally:
            client.disconnect()
        if not answers:
            return "no answer"
        self.answer = f"the broker answered: {answers[0]}"
        return str(answers[0]) if answers[0].is_failure else None

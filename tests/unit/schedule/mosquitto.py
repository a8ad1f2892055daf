"""Debian's MQTT broker on this machine, and a subscriber of it."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.listening import free_port
from tests.npm import lacking
from tests.unit.scan.fakes import WAIT_S

PREFIX = "hall/3"
LOGIN = "rig:hidden-part:of-it"


class Mosquitto:
    """A broker that keeps what its subscribers missed, and knows one user, who may use what is below `PREFIX`.

    certificate : a file with a key and a certificate, for TLS.
    """

    def __init__(self, folder: Path, *, certificate: Path | None = None) -> None:
        pytest.importorskip("paho.mqtt.client", reason="needs paho-mqtt: pip install 'slrig[mqtt]'")
        if shutil.which("mosquitto") is None:
            lacking("needs an MQTT broker: apt install mosquitto")
        self.port = free_port()
        self.url = f"mqtt{'' if certificate is None else 's'}://127.0.0.1:{self.port}/{PREFIX}"
        self._config = folder / "mosquitto.conf"
        passwords, rights = folder / "passwords", folder / "rights"
        user, _, password = LOGIN.partition(":")
        passwords.touch(0o600)
        subprocess.run(["mosquitto_passwd", "-b", passwords, user, password], check=True)  # noqa: S603, S607
        rights.write_text(f"user {user}\ntopic {PREFIX}/#\n")
        rights.chmod(0o600)
        tls = "" if certificate is None else f"certfile {certificate}\nkeyfile {certificate}\n"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\n{tls}allow_anonymous true\npassword_file {passwords}\nacl_file {rights}\n"
            f"persistence true\npersistence_location {folder}/\nconnection_messages false\n"
            # Started by root it would become a user that this machine may not have.
            f"user {'root' if os.geteuid() == 0 else 'nobody'}\n"
        )
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            ["mosquitto", "-c", self._config],  # noqa: S607 - whichever there is
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stderr is not None
        lines = []
        for line in self._process.stderr:
            lines.append(line)
            if line.rstrip().endswith("running"):
                return
        raise AssertionError(lines)

    def stop(self) -> None:
        """Keep what subscribers missed, and end. Idempotent."""
        if self._process is not None:
            self._process.terminate()
            self._process.communicate(timeout=WAIT_S)
            self._process = None


class Subscriber:
    """Takes all below `PREFIX`. Connects again under the same name, to which the broker has kept what it missed."""

    def __init__(self, broker: Mosquitto) -> None:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        self.came: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
        self._client = Client(CallbackAPIVersion.VERSION2, client_id="subscriber", protocol=MQTTv5)
        self._client.on_message = lambda _client, _data, message: self.came.put(
            (message.topic, json.loads(message.payload))
        )
        user, _, password = LOGIN.partition(":")
        self._client.username_pw_set(user, password)
        subscribed = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe(f"{PREFIX}/#", qos=1)
        self._client.on_subscribe = lambda *_: subscribed.set()
        kept = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        kept.SessionExpiryInterval = 3600
        self._client.connect("127.0.0.1", broker.port, clean_start=False, properties=kept)
        self._client.loop_start()
        assert subscribed.wait(WAIT_S)

    def next(self) -> tuple[str, dict[str, Any]]:
        return self.came.get(timeout=WAIT_S)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

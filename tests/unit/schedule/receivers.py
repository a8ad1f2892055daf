"""Receivers of notices on this machine: a web server, and Debian's MQTT broker with a subscriber of it."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import os
import queue
import shutil
import ssl
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.listening import free_port
from tests.npm import lacking
from tests.unit.scan.fakes import WAIT_S

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"  # noqa: S105 - the one of the specification's own tests
PATH = "/hook/hidden-part"


class Hook:
    """What is sent comes out of `came`, with its headers and the raw body. While `gate` is clear it does not answer.

    port : any free one unless one is named.
    """

    def __init__(self, *, port: int = 0, certificate: Path | None = None) -> None:
        self.status = 204
        self.headers: dict[str, str] = {}
        self.drips = False
        self.gate = threading.Event()
        self.gate.set()
        self.gone = threading.Event()
        self.came: queue.Queue[dict[str, Any]] = queue.Queue()
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                hook.came.put({"path": self.path, "headers": dict(self.headers), "raw": body, **json.loads(body)})
                hook.gate.wait(WAIT_S)
                while hook.drips and not hook.gone.wait(0.02):
                    try:
                        self.wfile.write(b"H")
                    except OSError:
                        return
                self.send_response(hook.status)
                for name, value in hook.headers.items():
                    self.send_header(name, value)
                self.end_headers()

            def do_GET(self) -> None:
                hook.came.put({"path": self.path, "kind": "a redirect was followed"})

            def log_message(self, *_: object) -> None:
                return

        self.server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        # Connections that a test leaves open end with it.
        self.server.daemon_threads = True
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(certificate)
            self.server.socket = context.wrap_socket(self.server.socket, server_side=True)
        self.port: int = self.server.server_port
        self.url = f"http{'' if certificate is None else 's'}://127.0.0.1:{self.port}{PATH}"
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()

    def next(self) -> dict[str, Any]:
        return self.came.get(timeout=WAIT_S)

    def close(self) -> None:
        self.gone.set()
        self.gate.set()
        self.server.shutdown()
        self.server.server_close()


def own_certificate(folder: Path) -> Path:
    """A file with a certificate for this machine of no known authority, and its key."""
    pem, certificate = folder / "own.pem", folder / "own.crt"
    subprocess.run(  # noqa: S603 - our own command
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", pem, "-out", certificate,  # noqa: S607 - whichever there is
         "-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2"],
        check=True, capture_output=True,
    )  # fmt: skip
    pem.write_text(pem.read_text() + certificate.read_text())
    return pem


def signed(came: dict[str, Any], secret: str = SECRET) -> bool:
    """Whether what came bears the signature of a secret, by the text of Standard Webhooks 1.0.0."""
    headers = {name.lower(): value for name, value in came["headers"].items()}
    content = b".".join([headers["webhook-id"].encode(), headers["webhook-timestamp"].encode(), came["raw"]])
    key = base64.b64decode(secret.removeprefix("whsec_"))
    wanted = base64.b64encode(hmac.new(key, content, hashlib.sha256).digest())
    versions = [each.split(",", 1) for each in headers["webhook-signature"].split(" ")]
    return any(name == "v1" and hmac.compare_digest(value.encode(), wanted) for name, value in versions)


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

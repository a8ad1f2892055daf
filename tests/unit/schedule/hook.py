"""A web server on this machine that keeps what a webhook sends, and answers as a test says."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import queue
import ssl
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

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

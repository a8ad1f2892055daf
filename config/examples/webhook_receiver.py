"""Receive the service's notices, check their signatures, and print one line for each ended job.

    export SLRIG_WEBHOOK_SECRET=whsec_$(head -c 32 /dev/urandom | base64)
    python config/examples/webhook_receiver.py 8080
    SLRIG_WEBHOOK_URL=http://127.0.0.1:8080/ slrig serve rig.toml      # in another terminal, with the same secret

The signature is that of Standard Webhooks 1.0.0: HMAC-SHA256 over `id.timestamp.body`, Base64.
"""

import base64
import hmac
import json
import os
import sys
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

KEY = base64.b64decode(os.environ["SLRIG_WEBHOOK_SECRET"].removeprefix("whsec_"))
MOST_AGE_S = 300
MOST_BYTES = 1_000_000


def is_authentic(headers: dict[str, str], body: bytes) -> bool:
    """Whether a notice was signed with our key, and not long ago."""
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = "v1," + base64.b64encode(hmac.digest(KEY, signed, "sha256")).decode()
    recent = abs(datetime.now(UTC).timestamp() - int(headers["webhook-timestamp"])) < MOST_AGE_S
    return recent and any(hmac.compare_digest(expected, each) for each in headers["webhook-signature"].split())


class Receiver(BaseHTTPRequestHandler):
    """Answers 204 to a notice that is authentic; the service sends others again, and gives up after 72 hours."""

    received: ClassVar[set[str]] = set()

    def do_POST(self) -> None:
        """Check, print, answer. The same id twice is the same notice."""
        body = self.rfile.read(min(int(self.headers.get("content-length", 0)), MOST_BYTES))
        try:
            authentic = is_authentic({name.lower(): value for name, value in self.headers.items()}, body)
        except (KeyError, ValueError):
            authentic = False
        if authentic and self.headers["webhook-id"] not in self.received:
            self.received.add(self.headers["webhook-id"])
            notice = json.loads(body)
            print(f"{notice['at']} {notice['kind']}: {notice['words']}", flush=True)
        self.send_response(204 if authentic else 401)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Print notices only."""


if __name__ == "__main__":
    server = ThreadingHTTPServer(("127.0.0.1", int(sys.argv[1])), Receiver)
    print(f"listening on port {server.server_port}", flush=True)
    server.serve_forever()

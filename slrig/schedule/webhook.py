"""The webhook: one web address, which notices are sent to by POST.

Headers and signature are those of Standard Webhooks 1.0.0 (www.standardwebhooks.com), symmetric, `v1`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ssl
import threading
from urllib.parse import urlsplit

from slrig.errors import ConfigError
from slrig.jobs.outbox import Notice, Outbox
from slrig.jobs.records import Clock, utc_now
from slrig.schedule.sending import TIMEOUT_S, Sender

_GONE = 410
_KEY_BYTES = range(24, 65)


def signing_key(secret: str, source: str) -> bytes:
    """The key that a secret stands for: Base64 of 24 to 64 bytes, with or without `whsec_` before it.

    Raises ConfigError, which names the source and not the secret.
    """
    try:
        key = base64.b64decode(secret.strip().removeprefix("whsec_"), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if len(key) not in _KEY_BYTES:
        message = (
            f"{source}: expected whsec_ and Base64 of 24 to 64 random bytes. Make one: "
            """python3 -c 'import base64, os; print("whsec_" + base64.b64encode(os.urandom(32)).decode())'"""
        )
        raise ConfigError(message)
    return key


def signature(key: bytes, notice_id: str, timestamp: int, body: bytes) -> str:
    """What the header `webhook-signature` says: HMAC-SHA256 over `id.timestamp.body`.

    >>> signature(b"k" * 24, "msg_1", 1614265330, b"{}")
    'v1,KrbhoJST6Q+/bu1g6/FBBu+pIEtkrImj8aKkA5+3RXI='
    """
    digest = hmac.digest(key, f"{notice_id}.{timestamp}.".encode() + body, hashlib.sha256)
    return f"v1,{base64.b64encode(digest).decode()}"


class Webhook(Sender):
    """Takes a notice by a status of 200 to 299. key : signs each; None sends them unsigned."""

    receiver = "webhook"

    def __init__(
        self, outbox: Outbox, url: str, key: bytes | None, *, clock: Clock = utc_now, timeout_s: float = TIMEOUT_S
    ) -> None:
        # The rest of the address often holds a secret.
        super().__init__(outbox, urlsplit(url).hostname or "")
        self._url = url
        self._key = key
        self._clock = clock
        self._timeout_s = timeout_s
        self._tls: ssl.SSLContext | None = None

    def refusal(self, notice: Notice) -> str | None:
        """See `Sender`."""
        timestamp = int(self._clock().timestamp())
        headers = {"content-type": "application/json", "webhook-id": notice.id, "webhook-timestamp": str(timestamp)}
        if self._key is not None:
            headers["webhook-signature"] = signature(self._key, notice.id, timestamp, notice.content)
        status = self._status(notice.content, headers)
        self._gone = status == _GONE
        return None if 200 <= status < 300 else f"status {status}"

    def _status(self, body: bytes, headers: dict[str, str]) -> int:
        # Loaded by those who use it.
        import httpx2

        if self._tls is None:
            self._tls = httpx2.create_ssl_context()
        with httpx2.Client(verify=self._tls, timeout=self._timeout_s, follow_redirects=False) as client:
            # The client's own limit is for each piece of an answer, and one may come a byte at a time.
            whole = threading.Timer(self._timeout_s, client.close)
            whole.daemon = True
            whole.start()
            try:
                # What a receiver says beyond the status is not read.
                with client.stream("POST", self._url, content=body, headers=headers) as answer:
                    return answer.status_code
            finally:
                whole.cancel()

"""The webhook: what waits in the outbox is sent to one address, in order, one at a time, until that has taken it.

Headers and signature are those of Standard Webhooks 1.0.0 (www.standardwebhooks.com), symmetric, `v1`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import os
import ssl
import threading
from pathlib import Path
from urllib.parse import urlsplit

import structlog

from slrig.errors import ConfigError, StorageError
from slrig.jobs.outbox import Notice, Outbox
from slrig.jobs.records import Clock, utc_now

FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 300.0
TIMEOUT_S = 15.0
"""For one try, from the connection to the head of the answer."""

_END_S = 1.0
_REFUSED_S = 5.0
"""How long after the records refused they are looked at again."""

_GONE = 410
_KEY_BYTES = range(24, 65)

_log = structlog.get_logger(__name__)


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


def key_of_file(path: Path) -> bytes:
    """The key that a file holds, which nobody but its owner may read. Raises ConfigError."""
    try:
        mode, secret = path.stat().st_mode, path.read_text("ascii")
    except (OSError, ValueError) as cause:
        message = f"webhook_secret_file: {path} cannot be read: {getattr(cause, 'strerror', None) or 'it is no text'}"
        raise ConfigError(message) from cause
    if os.name == "posix" and mode & 0o077:
        message = f"webhook_secret_file: others may read {path}. Take that from them: chmod 600 {path}"
        raise ConfigError(message)
    return signing_key(secret, f"webhook_secret_file: {path}")


def signature(key: bytes, notice_id: str, timestamp: int, body: bytes) -> str:
    """What the header `webhook-signature` says: HMAC-SHA256 over `id.timestamp.body`.

    >>> signature(b"k" * 24, "msg_1", 1614265330, b"{}")
    'v1,KrbhoJST6Q+/bu1g6/FBBu+pIEtkrImj8aKkA5+3RXI='
    """
    digest = hmac.digest(key, f"{notice_id}.{timestamp}.".encode() + body, hashlib.sha256)
    return f"v1,{base64.b64encode(digest).decode()}"


class Webhook:
    """Sends notices on a thread of its own. Nothing waits for it, but `close`, for a second at most.

    A notice is sent again until it is answered with a status of 200 to 299, and then forgotten. key : signs each;
    None sends them unsigned.
    """

    def __init__(
        self, outbox: Outbox, url: str, key: bytes | None, *, clock: Clock = utc_now, timeout_s: float = TIMEOUT_S
    ) -> None:
        self._outbox = outbox
        self._url = url
        # The rest of the address often holds a secret.
        self._host = urlsplit(url).hostname
        self._key = key
        self._clock = clock
        self._timeout_s = timeout_s
        self._tls: ssl.SSLContext | None = None
        self._failures = 0
        self._gone = self._left = False
        self._taken: str | None = None
        self._ending = threading.Event()
        self._sender = threading.Thread(target=self._send_all, name="slrig-notices", daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._sender.start()

    def close(self) -> None:
        """Send no more than what waits, and that only if it goes quickly. Idempotent."""
        self._ending.set()
        self._outbox.news.set()
        if self._sender.is_alive():
            self._sender.join(_END_S)
        self._left = True

    def step(self) -> float | None:
        """Send the oldest notice that waits. Returns how many seconds to wait before the next step; None: until there
        is one more. Raises StorageError.
        """
        notice = self._outbox.oldest()
        if notice is None or self._gone:
            return None if notice is None else LONGEST_WAIT_S
        # One that could not be taken off the record is not sent again by this process.
        if notice.id != self._taken and (cause := self._refusal(notice)) is not None:
            return self._failed(notice, cause)
        self._taken, self._failures = notice.id, 0
        if not self._left:
            self._outbox.sent(notice)
        return 0.0

    def _failed(self, notice: Notice, cause: str) -> float:
        told = {"host": self._host, "cause": cause, "notice": notice.body["words"]}
        if self._gone:
            _log.error("the webhook is gone: nothing is sent before the next start of the service", **told)
            return LONGEST_WAIT_S
        wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._failures, 30), LONGEST_WAIT_S)
        self._failures += 1
        _log.warning("a notice was not delivered", tries=self._failures, again_in_s=wait_s, **told)
        return wait_s

    def _refusal(self, notice: Notice) -> str | None:
        """Send a notice once. Returns why it was not taken."""
        body = json.dumps(notice.body, separators=(",", ":"), ensure_ascii=False).encode()
        timestamp = int(self._clock().timestamp())
        headers = {"content-type": "application/json", "webhook-id": notice.id, "webhook-timestamp": str(timestamp)}
        if self._key is not None:
            headers["webhook-signature"] = signature(self._key, notice.id, timestamp, body)
        try:
            status = self._status(body, headers)
        except Exception as error:  # noqa: BLE001 - whatever it was, the next try may get through
            return type(error).__name__
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

    def _send_all(self) -> None:
        while not self._left:
            self._outbox.news.clear()
            try:
                wait_s = self.step()
            except Exception as error:  # noqa: BLE001 - a full disk may be emptied; the notices wait
                unexpected = not isinstance(error, StorageError)
                _log.error("the notices could not be looked at", cause=str(error), exc_info=unexpected)
                wait_s = _REFUSED_S
            if wait_s is None and not self._ending.is_set():
                self._outbox.news.wait()
            elif wait_s is None or (wait_s > 0 and self._ending.wait(wait_s)):
                return

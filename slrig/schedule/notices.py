"""Notices of events that would go unnoticed, such as failed runs and a rig that moved, and their receivers:
the webhook, and those of plug-ins.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ssl
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args
from urllib.parse import urlsplit

import structlog
from pydantic import Field, SecretStr
from sqlalchemy.orm import Session

from slrig.bundle import Strict, read_json_model, write_file
from slrig.calibrate.verification import HealthStore, VerificationRecord
from slrig.calibration.health import HealthState
from slrig.config import NoticeKind, ServiceSettings, WebAddress, read_private_text
from slrig.errors import ConfigError, StorageError
from slrig.failure import LastingThread
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, utc_now
from slrig.jobs.store import Notice, Outbox
from slrig.plugins import RECEIVERS, load, plugin_errors
from slrig.schedule.store import RunState, Schedule, ScheduledRun

NOTICE_KINDS: dict[RunState, NoticeKind] = {
    RunState(kind.removeprefix("run.")): kind for kind in get_args(NoticeKind) if kind.startswith("run.")
}
"""Kind of notice by the state of a run that a person has to know of."""


def notice_run(outbox: Outbox, session: Session, schedule: Schedule, run: ScheduledRun) -> None:
    """As `slrig.schedule.store.Notice`: queue a notice of a run that a person has to know of."""
    if run.state not in NOTICE_KINDS:
        return
    due = schedule.order.cron.local(run.due)
    what = f"{schedule.order.task} due {due:%Y-%m-%d %H:%M %z}"
    more = "" if run.count == 1 else f", {run.count} times"
    outbox.put(
        session,
        NOTICE_KINDS[run.state],
        f"{what} was {run.state}{more}: {run.reason or 'no reason is known'}",
        schedule={
            "id": str(schedule.id),
            "label": schedule.order.label,
            "task": str(schedule.order.task),
            "cron": schedule.order.cron.text,
            "time_zone": schedule.order.cron.time_zone,
        },
        run={
            "number": run.number,
            "due": run.due.isoformat(),
            "state": str(run.state),
            "reason": run.reason,
            "count": run.count,
        },
    )


class NoticedHealth(HealthStore):
    """The history of a rig's health, with a notice of every change."""

    def __init__(self, database: Database, outbox: Outbox) -> None:
        super().__init__(database)
        self._outbox = outbox

    def added(self, session: Session, before: VerificationRecord | None, now: VerificationRecord) -> None:
        """Queue a notice of a changed health. A first verification that finds all well needs none."""
        earlier = HealthState.UNKNOWN if before is None else before.health.state
        state = now.health.state
        if state is earlier or (before is None and state is HealthState.GOOD):
            return
        self._outbox.put(
            session,
            "health.changed",
            f"its health was {earlier} and is {state}: {'; '.join(now.health.reasons) or 'nothing is wrong'}",
            health={
                "before": str(earlier),
                "state": str(state),
                "reasons": list(now.health.reasons),
                "remedy": now.health.remedy,
                "verification": str(now.id),
                "calibration": now.calibration,
            },
        )


FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 300.0
TIMEOUT_S = 15.0
"""For one try, from the connection to the head of the answer."""

_END_S = 1.0
_REFUSED_S = 5.0
"""Time until the records are read again after they refused."""

_log = structlog.get_logger(__name__)


_CAUSES = {
    "ConnectError": "no connection: check the address, and whether something listens there",
    "ConnectionRefusedError": "no connection: nothing listens at that address and port",
    "gaierror": "there is no host of that name",
    **dict.fromkeys(("ConnectTimeout", "ReadError", "ReadTimeout", "TimeoutError"), "no answer in time"),
}
"""Meaning of the errors of a try, by their classes' names."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of a test notice. answer : of the receiver, or why there was none. sent : the notice."""

    taken: bool
    answer: str
    seconds: float
    sent: Mapping[str, Any]


class Sender(ABC):
    """Sends notices on a thread of its own. Nothing waits for it, but `close`, for a second at most.

    A notice is sent again until its receiver takes it, and then forgotten. receiver : its name in the outbox. host :
    its address, for logs. answer : the receiver's latest answer, as text.
    """

    receiver: ClassVar[str]
    answer: str = ""

    def __init__(self, outbox: Outbox, host: str) -> None:
        self.host = host
        self._outbox = outbox
        self._news = outbox.news[self.receiver]
        self._failures = 0
        self._gone = self._left = False
        self._taken: str | None = None
        self._ending = threading.Event()
        self._thread = LastingThread(self._send_all, f"slrig-notices-{self.receiver}")

    @abstractmethod
    def refusal(self, notice: Notice) -> str | None:
        """Send a notice once. Returns why it was not taken. May raise anything: the next try may get through."""

    def start(self) -> None:
        """Begin to send. Does nothing where it has begun."""
        if not self._thread.is_alive():
            self._thread.start()

    def close(self) -> None:
        """Send no more than what waits, and that only if it goes quickly. Idempotent."""
        self._ending.set()
        self._news.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._left = True

    def step(self) -> float | None:
        """Send the oldest notice that waits. Returns how many seconds to wait before the next step; None: until there
        is one more. Raises StorageError.
        """
        notice = self._outbox.oldest(self.receiver)
        if notice is None or self._gone:
            return None if notice is None else LONGEST_WAIT_S
        # One that could not be taken off the record is not sent again by this process.
        if notice.id != self._taken:
            cause = self._sent(notice)
            if cause is not None:
                return self._failed(notice, cause)
        self._taken, self._failures = notice.id, 0
        if not self._left:
            self._outbox.sent(notice)
        return 0.0

    def try_out(self) -> Trial:
        """Send one test notice, before the notices that wait."""
        notice = Notice(0, "", self._outbox.body("test", "this is a test notice; nothing has happened"))
        notice = replace(notice, id=notice.body["id"])
        begun_s = time.monotonic()
        cause = self._sent(notice)
        seconds = round(time.monotonic() - begun_s, 3)
        return Trial(cause is None, _CAUSES.get(cause or "", cause) or self.answer, seconds, notice.body)

    def _sent(self, notice: Notice) -> str | None:
        try:
            return self.refusal(notice)
        except BaseException as error:  # noqa: BLE001 - after any error the next try may get through
            return type(error).__name__

    def _failed(self, notice: Notice, cause: str) -> float:
        facts = {"receiver": self.receiver, "host": self.host, "cause": cause}
        facts["notice"] = notice.body["words"]
        if self._gone:
            _log.error("the receiver is gone: nothing is sent before the next start of the service", **facts)
            return LONGEST_WAIT_S
        wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._failures, 30), LONGEST_WAIT_S)
        self._failures += 1
        _log.warning("a notice was not delivered", tries=self._failures, again_in_s=wait_s, **facts)
        return wait_s

    def _send_all(self) -> None:
        while not self._left:
            self._news.clear()
            try:
                wait_s = self.step()
            except Exception as error:  # noqa: BLE001 - a full disk may be emptied; the notices wait
                unexpected = not isinstance(error, StorageError)
                _log.error("the notices could not be read", cause=str(error), exc_info=unexpected)
                wait_s = _REFUSED_S
            if wait_s is None and not self._ending.is_set():
                self._news.wait()
            elif wait_s is None or (wait_s > 0 and self._ending.wait(wait_s)):
                return


_GONE = 410
_MOST_BYTES = 2**14
_KEY_BYTES = range(24, 65)


def signing_key(secret: str, source: str) -> bytes:
    """The key of a secret: Base64 of 24 to 64 bytes, with or without `whsec_` before it.

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
    """The header `webhook-signature`: HMAC-SHA256 over `id.timestamp.body`.

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
        super().__init__(outbox, "")
        self.send_to(url)
        self._key = key
        self._clock = clock
        self._timeout_s = timeout_s
        self._tls: ssl.SSLContext | None = None

    def send_to(self, url: str) -> None:
        """Send to another address from now on; one that is gone is forgiven."""
        # The rest of the address often holds a secret.
        self._url, self.host = url, urlsplit(url).hostname or ""
        self._gone, self._failures = False, 0

    def refusal(self, notice: Notice) -> str | None:
        """See `Sender`."""
        timestamp = int(self._clock().timestamp())
        headers = {"content-type": "application/json", "webhook-id": notice.id, "webhook-timestamp": str(timestamp)}
        if self._key is not None:
            headers["webhook-signature"] = signature(self._key, notice.id, timestamp, notice.content)
        status = self._status(notice.content, headers)
        self._gone = status == _GONE
        self.answer = f"status {status}"
        return None if 200 <= status < 300 else self.answer

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


class WebhookEntry(Strict):
    """A webhook that was set by request, in place of none in the settings: DATA/webhook.json."""

    url: WebAddress
    kinds: Annotated[tuple[NoticeKind, ...], Field(strict=False, min_length=1)] = get_args(NoticeKind)


class Receivers:
    """The receivers of the settings, and a webhook that was set by request. Any thread may call.

    senders : by the name of the receiver; fixed : names of receivers that the settings give. Raises ConfigError: see
    `senders_of`.
    """

    def __init__(self, settings: ServiceSettings, outbox: Outbox, root: Path) -> None:
        self.senders = {sender.receiver: sender for sender in senders_of(settings, outbox)}
        self.fixed = frozenset(self.senders)
        self._settings, self._outbox, self._path = settings, outbox, root / "webhook.json"
        self._lock = threading.Lock()
        self._started = False
        # One that was removed waits for nothing, and sends to the next address.
        self._webhook: Webhook | None = None
        if Webhook.receiver not in self.fixed and self._path.is_file():
            try:
                kept = read_json_model(self._path, WebhookEntry, "webhook", max_bytes=_MOST_BYTES, error=ConfigError)
            except ConfigError as error:
                _log.error("the webhook gets no notices: set it again", cause=str(error))
            else:
                self._use(kept)

    def start(self) -> None:
        """Begin to send."""
        self._started = True
        for sender in self.senders.values():
            sender.start()

    def close(self) -> None:
        """See `Sender.close`."""
        for sender in filter(None, (*self.senders.values(), self._webhook)):
            sender.close()

    def get(self, name: str) -> Sender:
        """A receiver. Raises ConfigError."""
        if name not in self.senders:
            message = f"There is no receiver '{name}'. GET /notices lists them: {', '.join(self.senders) or 'none'}."
            raise ConfigError(message)
        return self.senders[name]

    def set_webhook(self, entry: WebhookEntry) -> None:
        """Send to this address from now on, also after a restart. Raises ConfigError: the settings have one."""
        self._require_free()
        with self._lock:
            write_file(self._path, entry.model_dump_json().encode())
            self._path.chmod(0o600)
            self._use(entry)

    def remove_webhook(self) -> None:
        """Send nothing more to the webhook that was set, nor what waits for it. Idempotent. Raises ConfigError."""
        self._require_free()
        with self._lock:
            self._path.unlink(missing_ok=True)
            self._outbox.want(Webhook.receiver, ())
            self.senders.pop(Webhook.receiver, None)

    def _require_free(self) -> None:
        if Webhook.receiver in self.fixed:
            message = "The webhook is set in the service's settings (webhook_url). Change it there."
            raise ConfigError(message)

    def _use(self, entry: WebhookEntry) -> None:
        self._outbox.want(Webhook.receiver, entry.kinds)
        if self._webhook is None:
            self._webhook = Webhook(self._outbox, entry.url, _signing_key(self._settings))
        self._webhook.send_to(entry.url)
        self.senders[Webhook.receiver] = self._webhook
        if self._started:
            self._webhook.start()


def wanted_kinds(settings: ServiceSettings) -> Mapping[str, Collection[NoticeKind]]:
    """Kinds of notices for each named receiver; all kinds for other receivers than the webhook. Raises ConfigError."""
    kinds = dict.fromkeys(_named_receivers(settings), get_args(NoticeKind))
    return kinds if settings.webhook_url is None else {"webhook": settings.webhook_kinds, **kinds}


def senders_of(settings: ServiceSettings, outbox: Outbox) -> list[Sender]:
    """One sender for each receiver. Raises ConfigError: an address or secret is invalid, or an extra is missing."""
    found: list[Sender] = []
    if settings.webhook_url is not None:
        found.append(Webhook(outbox, settings.webhook_url, _signing_key(settings)))
    for name, open_sender in _named_receivers(settings).items():
        with plugin_errors(RECEIVERS, name):
            found.append(open_sender(settings, outbox))
    return found


def _signing_key(settings: ServiceSettings) -> bytes | None:
    secret, source = secret_of(settings.webhook_secret, settings.webhook_secret_file, "webhook_secret")
    return None if secret is None else signing_key(secret, source)


def _named_receivers(settings: ServiceSettings) -> Mapping[str, Callable[[ServiceSettings, Outbox], Sender]]:
    """The plug-ins of the settings `X_url`. Raises ConfigError: one is not installed, or cannot be loaded."""
    installed = load(RECEIVERS)
    found = {name: installed[name] for name in installed if getattr(settings, f"{name}_url", None) is not None}
    if settings.mqtt_url is not None and "mqtt" not in found:
        message = "mqtt_url: no installed package sends notices there; install slrig again, or leave mqtt_url out"
        raise ConfigError(message)
    return found


def secret_of(given: SecretStr | None, path: Path | None, name: str) -> tuple[str | None, str]:
    """Return a secret, or the contents of a file that only its owner may read, and its source. Raises ConfigError."""
    if given is not None or path is None:
        return None if given is None else given.get_secret_value(), name
    source = f"{name}_file: {path}"
    return read_private_text(path, source), source

"""Who may send a request, from which page, for what, and how often; and the record of what everybody did."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from urllib.parse import urlsplit

import structlog
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.api.calibration import IMPORT_PATH
from slrig.api.keys import ALL_SCOPES, Key, KeyRing
from slrig.api.page import FILES_PATH
from slrig.api.problems import answer, problem
from slrig.api.scopes import READING, moves, needed_scope
from slrig.api.scopes import Scope as KeyScope
from slrig.api.sessions import LINK_PATH, Sessions
from slrig.errors import StorageError
from slrig.jobs.audit import Audit
from slrig.jobs.records import acting_as, utc_now

OPEN_PATHS = frozenset({"/", "/livez", "/readyz", LINK_PATH})
"""What answers without a key: the page, which asks for one, probes, which tell nothing about scans, and the link that
stands for a key."""

ANYONE = "anyone"
"""Who sends requests to a service that asks for no key."""

_NAVIGATED = "navigate"
_JSON_TYPES = frozenset({"application/json", "application/problem+json"})
_BURST_S = 4.0
"""How many seconds' worth of requests may come at once: a page with its pictures."""
_MOST_COUNTED = 1024
_LOOK_AGAIN_S = 10.0
"""How long a stream may go on that was begun with a key that has been revoked, or has expired, since then."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request, what their key is for, and until when it, or their session, is good."""

    name: str
    scopes: tuple[KeyScope, ...] = ALL_SCOPES
    expires_at: datetime | None = None


class Access:
    """Middleware that lets a request pass by the key or the session that comes with it.

    ring, sessions : None lets everybody pass. per_second : how many requests of one name, or from one address without a
    key, are answered.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        ring: KeyRing | None,
        sessions: Sessions | None,
        audit: Audit,
        per_second: float,
    ) -> None:
        self._app = app
        self._ring = ring
        self._sessions = sessions
        self._audit = audit
        self._rates = Rates(per_second)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers, method, path = Headers(scope=scope), scope["method"], scope["path"]
        address = (scope.get("client") or ("",))[0]
        caller: Caller | None = None
        try:
            by_key = _sent_key(headers) is not None
            refuse_foreign_page(headers, method, path, by_cookie=not by_key and "cookie" in headers)
            refuse_other_types(headers, method, path)
            caller = self._caller(headers, path)
            self._rates.count(address if caller is None else caller.name)
            if caller is not None:
                refuse_out_of_scope(caller, needed_scope(method, path))
        except Refused as refusal:
            await self._refuse(refusal, address, caller, method, path, scope, receive, send)
            return
        scope.setdefault("state", {})["caller"] = caller
        status, made, is_stream, looked_s, is_over = 0, "", False, time.monotonic(), False

        async def noted(message: Message) -> None:
            nonlocal status, made, is_stream, looked_s, is_over
            if message["type"] == "http.response.start":
                kept = Headers(raw=message.get("headers", []))
                status, made, is_stream = message["status"], kept.get("location", ""), "content-length" not in kept
            elif is_stream and message.get("more_body") and time.monotonic() >= looked_s + _LOOK_AGAIN_S:
                looked_s = time.monotonic()
                try:
                    self._caller(headers, path)
                except Refused as refusal:
                    is_over = True
                    # To whoever makes the stream it is as if the client had gone.
                    raise ConnectionAbortedError(str(refusal)) from refusal
            await send(message)

        name = ANYONE if caller is None else caller.name
        try:
            with acting_as(name):
                await self._app(scope, receive, noted)
        except Exception:
            if not is_over:
                raise
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        if method not in READING or path == LINK_PATH:
            await self._note(name, address, method, path, status, made)

    def _caller(self, headers: Headers, path: str) -> Caller | None:
        """Who sends a request; None for what needs no key."""
        if self._ring is None or self._sessions is None:
            return Caller(ANYONE)
        if path in OPEN_PATHS or path.startswith(f"{FILES_PATH}/"):
            return None
        try:
            return self._known(self._ring, self._sessions, headers)
        except StorageError as error:
            # A stranger is not told where the file lies.
            _log.error("keys cannot be read", error=str(error))
            detail = "The service cannot read its keys, and lets nobody in. Its log says what to do."
            raise Refused(507, error.code, detail) from error

    def _known(self, ring: KeyRing, sessions: Sessions, headers: Headers) -> Caller:
        sent = _sent_key(headers)
        if sent is not None:
            return _let_in(ring.find(sent))
        cookie = cookie_parser(headers.get("cookie", "")).get(sessions.cookie)
        session = None if cookie is None else sessions.find(cookie)
        if session is not None:
            owner = _let_in(ring.named(session.name))
            return Caller(owner.name, owner.scopes, session.expires_at)
        raise _unauthorized("none" if cookie is None else "a session that is over")

    async def _refuse(
        self,
        refusal: Refused,
        address: str,
        caller: Caller | None,
        method: str,
        path: str,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        if refusal.status == 401:
            # Strangers are not put on record: they could fill the disk with it.
            try:
                self._rates.count(address)
            except Refused as too_many:
                refusal = too_many
        elif caller is not None:
            await self._note(caller.name, address, method, path, refusal.status, "")
        response = answer(problem(refusal.status, refusal.code, str(refusal)), headers=refusal.headers)
        await response(scope, receive, send)

    async def _note(self, name: str, address: str, method: str, path: str, status: int, made: str) -> None:
        try:
            await run_in_threadpool(self._audit.note, name, address, method, path, status, made)
        except StorageError as error:
            # What was done is done: the answer stands.
            _log.warning("not put on record", who=name, method=method, path=path, status=status, error=str(error))


class Refused(Exception):  # noqa: N818 - an answer, not a fault of ours
    """A request that goes no further."""

    def __init__(self, status: int, code: str, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.code, self.headers = status, code, headers


def refuse_foreign_page(headers: Headers, method: str, path: str, *, by_cookie: bool) -> None:
    """Refuse what another site's page, or another service's of this machine, has a browser send.

    Browsers say where a request comes from: in Sec-Fetch-Site (W3C Fetch Metadata), where the address is this machine
    or encrypted, and in Origin with all that writes. A page cannot change either. A link that somebody follows may come
    from anywhere, if it moves nothing. Programs send neither header. A picture that moves light, by cookie and without
    either, must say in Referer that it is on a page of ours. Raises Refused.
    """
    site, host = headers.get("sec-fetch-site"), headers.get("host", "").lower()
    if site is not None:
        foreign = site not in {"same-origin", "none"}
    elif "origin" in headers:
        foreign = _authority(headers["origin"]) != host
    else:
        foreign = by_cookie and moves(method, path) and _authority(headers.get("referer", "")) != host
    if not foreign or (headers.get("sec-fetch-mode") == _NAVIGATED and not moves(method, path)):
        return
    where = headers.get("origin") or headers.get("referer") or "another site"
    detail = (
        f"This request was sent by a page of {where}, and the service takes requests of its own pages and of programs "
        "only. Open the service's own address in the browser, or send the request from a program."
    )
    raise Refused(403, "foreign-page", detail)


def refuse_other_types(headers: Headers, method: str, path: str) -> None:
    """Refuse a body that a form of any page could send: what is no JSON, and no file to import. Raises Refused."""
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    has_body = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
    if method in READING or path == IMPORT_PATH or kind in _JSON_TYPES or not (kind or has_body):
        return
    found = f"'{kind}'" if kind else "none"
    raise Refused(415, "unsupported-media-type", f"Content-Type: expected application/json, found {found}.")


def _authority(url: str) -> str:
    try:
        return urlsplit(url).netloc.lower()
    except ValueError:
        return ""


def _let_in(key: Key | None) -> Caller:
    if key is None:
        raise _unauthorized("another one")
    fault = key.fault(utc_now())
    if fault is not None:
        raise _unauthorized(f"one that {fault}")
    return Caller(key.name, key.scopes, key.expires_at)


def _unauthorized(found: str) -> Refused:
    detail = (
        f"This service needs an API key, and the request has {found}. Send yours as 'Authorization: Bearer KEY' or "
        "'X-API-Key: KEY'. Whoever runs the service makes one with `slrig key add NAME`."
    )
    return Refused(401, "unauthorized", detail, {"WWW-Authenticate": "Bearer"})


def refuse_out_of_scope(caller: Caller, needed: KeyScope) -> None:
    """Refuse what a key is not for. Raises Refused."""
    if needed in caller.scopes:
        return
    detail = (
        f"The key of '{caller.name}' is for {', '.join(caller.scopes)}, and this takes one to {needed}. Ask "
        f"whoever runs the service for it: `slrig key add NAME --scope {needed}`."
    )
    raise Refused(403, "scope", detail)


def _sent_key(headers: Headers) -> str | None:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token.strip():
        return token.strip()
    return headers.get("x-api-key")


class Rates:
    """How many requests each name may send: so many a second, and a few seconds' worth at once (a token bucket).

    >>> rates = Rates(1, clock=lambda: 0.0)
    >>> for _ in range(4): rates.count("ann")
    >>> rates.count("ann")
    Traceback (most recent call last):
    ...
    slrig.api.access.Refused: 'ann' sends more than 1 requests a second. Wait a second, then send fewer.
    >>> rates.count("bob")
    """

    def __init__(self, per_second: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_second = per_second
        self._clock = clock
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def count(self, name: str) -> None:
        """Count one request. Raises Refused: it is one too many."""
        now = self._clock()
        most = max(self._per_second * _BURST_S, 1.0)
        left, since = self._left.pop(name, (most, now))
        left = min(left + (now - since) * self._per_second, most)
        allowed = left >= 1.0
        self._left[name] = (left - 1.0 if allowed else left, now)
        if len(self._left) > _MOST_COUNTED:
            self._left.popitem(last=False)
        if not allowed:
            detail = f"'{name}' sends more than {self._per_second:g} requests a second. Wait a second, then send fewer."
            raise Refused(429, "too-many-requests", detail, {"Retry-After": "1"})

"""Keys, sessions, scopes and limits of requests, security headers; and the record of each writing request."""

from __future__ import annotations

import asyncio
import hashlib
import math
import os
import re
import secrets
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

import structlog
from anyio import CancelScope
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from filelock import FileLock
from pydantic import AwareDatetime, BaseModel, Field, TypeAdapter, ValidationError
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig import KEY_VARIABLE, local_key_path
from slrig.api.calibration import IMPORT_PATH
from slrig.api.problems import answer, problem, problems
from slrig.api.scopes import READING, KeyScope, moves, needed_scope
from slrig.api.shares import Shares
from slrig.api.system import FILES_PATH
from slrig.bundle import Strict, write_file
from slrig.errors import ConfigError, StorageError
from slrig.failure import disk_errors
from slrig.jobs.records import ANYONE, Clock, acting_as, utc_now
from slrig.jobs.store import Audit

LEAST_KEY_LENGTH = 16
"""A key that people made up and that is shorter than this can be guessed."""

FIRST_NAME = "owner"
"""Whom the key belongs to that the service makes at its first start."""

GIVEN_NAME = "environment"
"""Whom the key of the environment belongs to."""
LOCAL_NAME = "local"
"""Whom the key for programs of the same user belongs to, see `local_key`."""

KEY_NAME = r"^[A-Za-z0-9][A-Za-z0-9 ._@-]{0,63}$"


ALL_SCOPES = tuple(KeyScope)
_TAKEN = {GIVEN_NAME, LOCAL_NAME}
"""Names of keys that are in no file."""


class Key(Strict):
    """One key: the name of who has it, its digest, what it is for. It ends at `expires_at`, or when it is revoked."""

    name: Annotated[str, Field(pattern=KEY_NAME)]
    digest: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    scopes: Annotated[tuple[KeyScope, ...], Field(strict=False)]
    created_at: Annotated[AwareDatetime, Field(strict=False)]
    expires_at: Annotated[AwareDatetime, Field(strict=False)] | None = None
    revoked_at: Annotated[AwareDatetime, Field(strict=False)] | None = None

    def fault(self, now: datetime) -> str | None:
        """Why the key opens nothing, None where it does."""
        if self.revoked_at is not None:
            return f"was revoked on {self.revoked_at:%Y-%m-%d}"
        if self.expires_at is not None and self.expires_at <= now:
            return f"expired on {self.expires_at:%Y-%m-%d}"
        return None


class _KeyFile(Strict):
    format: Literal["slrig-keys"]
    version: Literal[1]
    keys: Annotated[tuple[Key, ...], Field(strict=False)]


_adapter = TypeAdapter(_KeyFile)


def digest(key: str) -> str:
    """The stored digest of a key."""
    return hashlib.sha256(key.encode()).hexdigest()


class KeyRing:
    """The keys in a file, and the one of the environment, which is kept nowhere.

    Raises
    ------
    ConfigError
        The given key is too short or cannot travel in a header.
    StorageError
        Here and in every call: the file cannot be read or written, or is no longer a file of keys.
    """

    def __init__(self, path: Path, *, given: str | None = None, clock: Clock = utc_now) -> None:
        self._path = path
        self._clock = clock
        self._given = None if given is None else _given_key(given, clock())
        self._local: Key | None = None
        self._stamp: tuple[int, int, int] | None = None
        self._by_digest: dict[str, Key] = {}
        self._reload()

    def find(self, sent: str) -> Key | None:
        """The key that was sent, if it is known, even one that has ended."""
        return self.by_digest(digest(sent))

    def by_digest(self, identity: str) -> Key | None:
        """The key of a digest, which is its identity: a name may pass on to another key."""
        if self._local is not None and self._local.digest == identity:
            return self._local
        self._reload()
        return self._by_digest.get(identity)

    def admit(self, key: str) -> None:
        """Accept this key, which is kept nowhere, as long as this process runs: see `local_key`."""
        self._local = Key(name=LOCAL_NAME, digest=digest(key), scopes=ALL_SCOPES, created_at=self._clock())

    def named(self, name: str) -> Key | None:
        """The newest key of a name."""
        return next((key for key in reversed(self.everybody) if key.name == name), None)

    @property
    def everybody(self) -> tuple[Key, ...]:
        """Every key, from old to new."""
        self._reload()
        return tuple(self._by_digest.values())

    def add(self, name: str, scopes: Iterable[KeyScope], *, life: timedelta | None = None) -> str:
        """Make a key and return it: it is shown only now. Raises ConfigError: the name is taken or invalid."""
        if not re.fullmatch(KEY_NAME, name):
            message = (
                f"{name!r} cannot name a key: expected up to 64 letters, digits, spaces and any of "
                "'._@-', the first a letter or a digit. Name the person or the program that gets it."
            )
            raise ConfigError(message)
        key = secrets.token_urlsafe(32)
        now = self._clock()
        made = Key(
            name=name,
            digest=digest(key),
            scopes=tuple(each for each in KeyScope if each in {KeyScope.LOOK, *scopes}),
            created_at=now,
            expires_at=None if life is None else now + life,
        )
        with self._changing() as keys:
            if any(each.name == name and each.fault(now) is None for each in keys) or name in _TAKEN:
                message = f"There is a key of the name '{name}' already. Revoke it first, or choose another name."
                raise ConfigError(message)
            keys.append(made)
        return key

    def revoke(self, name: str) -> None:
        """Revoke the key of a name. Raises ConfigError: there is none."""
        now = self._clock()
        with self._changing() as keys:
            found = [place for place, key in enumerate(keys) if key.name == name and key.fault(now) is None]
            if not found:
                known = ", ".join(sorted(key.name for key in keys if key.fault(now) is None)) or "none at all"
                message = f"There is no key '{name}' to revoke. There are: {known}."
                raise ConfigError(message)
            keys[found[0]] = keys[found[0]].model_copy(update={"revoked_at": now})

    @contextmanager
    def _changing(self) -> Iterator[list[Key]]:
        with disk_errors(self._path.parent), FileLock(self._path.with_suffix(".lock"), mode=0o600):
            keys = list(self._read())
            yield keys
            file = _KeyFile(format="slrig-keys", version=1, keys=tuple(keys))
            write_file(self._path, _adapter.dump_json(file, indent=1) + b"\n")
            self._path.chmod(0o600)

    def _reload(self) -> None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            stamp = (0, 0, 0)
        except OSError as error:
            message = f"The keys in {self._path} cannot be read: {error.strerror}. See that slrig may read the file."
            raise StorageError(message) from error
        else:
            stamp = (found.st_mtime_ns, found.st_ino, found.st_size)
        if stamp == self._stamp:
            return
        keys = self._read()
        self._by_digest = {key.digest: key for key in (*keys, *([] if self._given is None else [self._given]))}
        self._stamp = stamp

    def _read(self) -> tuple[Key, ...]:
        try:
            return _adapter.validate_json(self._path.read_bytes()).keys
        except FileNotFoundError:
            return ()
        except (OSError, ValidationError) as error:
            message = (
                f"The keys in {self._path} cannot be read: {_first_line(error)}. Restore the file from a "
                "backup, or remove it and make new keys with `slrig key add`."
            )
            raise StorageError(message) from error


def _first_line(error: OSError | ValidationError) -> str:
    if isinstance(error, OSError):
        return error.strerror or str(error)
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}"


def _given_key(given: str, now: datetime) -> Key:
    sendable = given.isascii() and given.isprintable()
    if len(given) < LEAST_KEY_LENGTH or not sendable:
        others = "" if sendable else ", and others among them"
        message = (
            f"{KEY_VARIABLE}: expected a key of {LEAST_KEY_LENGTH} or more printable ASCII characters, found "
            f"{len(given)}{others}. Unset it, and the service makes a key of its own."
        )
        raise ConfigError(message)
    return Key(name=GIVEN_NAME, digest=digest(given), scopes=ALL_SCOPES, created_at=now)


@contextmanager
def local_key(port: int) -> Iterator[str | None]:
    """A key for the block, in a file that only the user who runs this can read: for that user's programs on this
    machine, who could make keys of their own anyway. None where the file cannot be written.
    """
    path, key = local_key_path(port), secrets.token_urlsafe(32)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(f"{key}\n")
    except OSError as error:
        _log.info("programs of the same user need a key", path=str(path), cause=str(error))
        yield None
        return
    try:
        yield key
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def first_key(ring: KeyRing, *, fresh: bool) -> str | None:
    """The key that a service makes at its start, to be shown once: where there is none, or where a `fresh` one is
    requested, which replaces an earlier one of this kind. None where none is made.
    """
    if fresh:
        owner = ring.named(FIRST_NAME)
        if owner is not None and owner.revoked_at is None:
            ring.revoke(FIRST_NAME)
    elif ring.everybody:
        return None
    return ring.add(FIRST_NAME, ALL_SCOPES)


LINK_PATH = "/session/link"
SESSION_LIFE = timedelta(hours=12)
"""A working day."""
LINK_LIFE = timedelta(minutes=15)
MOST_SESSIONS = 256
_MOST_LINKS = 8

router = APIRouter(prefix="/session", tags=["session"])


@dataclass(frozen=True, slots=True)
class Session:
    """One browser that is logged in. name, key : of the key that it is logged in by, the latter its digest."""

    name: str
    key: str
    expires_at: datetime


class Sessions:
    """Open sessions of browsers, and links that open one. Used on the event loop's thread, or before it runs."""

    def __init__(self, ring: KeyRing, *, cookie: str, clock: Clock = utc_now) -> None:
        self.ring = ring
        # Cookies do not distinguish ports: two services of one machine need two names.
        self.cookie = cookie
        self._clock = clock
        self._open: dict[str, Session] = {}
        self._shares = Shares("sessions", MOST_SESSIONS, "Log out in a browser that is not used.", retry_s=60)
        self._links: dict[str, Session] = {}

    def link(self, name: str, key: str) -> str:
        """A secret that opens one session by a key, within a quarter of an hour. Of one key the newest few count."""
        secret, now = secrets.token_urlsafe(32), self._clock()
        self._links = {each: link for each, link in self._links.items() if link.expires_at > now}
        earlier = [each for each, link in self._links.items() if link.key == key]
        for each in earlier[: max(len(earlier) - _MOST_LINKS + 1, 0)]:
            del self._links[each]
        self._links[digest(secret)] = Session(name, key, now + LINK_LIFE)
        return secret

    def follow(self, secret: str) -> tuple[str, Session] | None:
        """Open the session of a link, once; None where it was followed before, is too old, or its key has ended."""
        link, now = self._links.pop(digest(secret), None), self._clock()
        good = link is not None and link.expires_at > now and self._good(link.key, now)
        return self.open(link.name, link.key) if link is not None and good else None

    def open(self, name: str, key: str) -> tuple[str, Session]:
        """Open a session by a key: the secret for the cookie, and the session. Where the key has its share of them, its
        oldest ends for this one. Raises HTTPException 429: it has none, and others have all.
        """
        now = self._clock()
        # In their order, and without those of keys that have ended; each key is read once.
        good = {key: self._good(key, now) for key in {session.key for session in self._open.values()}}
        self._open = {
            each: session for each, session in self._open.items() if good[session.key] and session.expires_at > now
        }
        try:
            self._shares.require(name, Counter(session.name for session in self._open.values()))
        except HTTPException:
            oldest = next((each for each, session in self._open.items() if session.key == key), None)
            if oldest is None:
                raise
            del self._open[oldest]
        secret = secrets.token_urlsafe(32)
        session = Session(name, key, now + SESSION_LIFE)
        self._open[digest(secret)] = session
        return secret, session

    def find(self, secret: str) -> Session | None:
        """The session of a cookie."""
        found = self._open.get(digest(secret))
        return found if found is not None and found.expires_at > self._clock() else None

    def _good(self, identity: str, now: datetime) -> bool:
        key = self.ring.by_digest(identity)
        return key is not None and key.fault(now) is None

    def close(self, secret: str) -> None:
        """Log out. Idempotent."""
        self._open.pop(digest(secret), None)


def _require_sessions(request: Request) -> Sessions:
    """Return the sessions of this service. Raises HTTPException 409: it needs no key."""
    sessions: Sessions | None = request.app.state.sessions
    if sessions is None:
        raise HTTPException(409, "This service needs no key, so there is nothing to log in to.")
    return sessions


class SessionBody(BaseModel):
    """Whom the service takes the sender for, what that name may do, and until when; null is without end."""

    name: str
    scopes: tuple[KeyScope, ...]
    expires_at: datetime | None


@router.get("")
async def look_at_session(request: Request) -> SessionBody:
    """Return whom the service takes you for."""
    caller = request.state.caller
    return SessionBody(name=caller.name, scopes=caller.scopes, expires_at=caller.expires_at)


@router.post("", status_code=201)
async def open_session(request: Request, response: Response) -> SessionBody:
    """Log a browser in: send the key in a header, as always, and go on with the cookie that comes back."""
    caller, sessions = request.state.caller, _require_sessions(request)
    secret, session = sessions.open(caller.name, caller.key)
    _set_cookie(request, response, sessions, secret)
    return SessionBody(name=caller.name, scopes=caller.scopes, expires_at=session.expires_at)


@router.delete("", status_code=204)
async def close_session(request: Request, response: Response) -> None:
    """Log a browser out."""
    sessions: Sessions | None = request.app.state.sessions
    if sessions is not None:
        sessions.close(request.cookies.get(sessions.cookie, ""))
        response.delete_cookie(sessions.cookie, path="/", httponly=True, samesite="strict")


class LinkBody(BaseModel):
    """A path of this service that logs one browser in, once, within a quarter of an hour."""

    path: str


@router.post("/links", status_code=201, responses=problems(409))
async def make_link(request: Request) -> LinkBody:
    """Make a link by which a browser logs in as you: a program opens it for the person before it."""
    caller, sessions = request.state.caller, _require_sessions(request)
    return LinkBody(path=f"{LINK_PATH}?token={sessions.link(caller.name, caller.key)}")


@router.get(
    "/link",
    response_class=Response,
    status_code=303,
    responses={303: {"description": "logged in; on to the page of the service"}, **problems(401)},
    openapi_extra={"security": []},
)
async def follow_link(request: Request, token: Annotated[str, Query(max_length=200)]) -> Response:
    """Log a browser in by the link that `slrig serve` prints or POST makes. It works once, for a quarter of an hour."""
    sessions: Sessions | None = request.app.state.sessions
    opened = None if sessions is None else sessions.follow(token)
    if sessions is None or opened is None:
        message = (
            "This link was followed before, or is older than a quarter of an hour. Send your key in a header to POST "
            "/session, or start the service again for a new link."
        )
        raise HTTPException(401, message)
    response = RedirectResponse("/", 303)
    _set_cookie(request, response, sessions, opened[0])
    return response


def _set_cookie(request: Request, response: Response, sessions: Sessions, secret: str) -> None:
    response.set_cookie(
        sessions.cookie,
        secret,
        max_age=round(SESSION_LIFE.total_seconds()),
        path="/",
        httponly=True,
        samesite="strict",
        # Behind a proxy the browser's own connection is encrypted, and its Origin says so.
        secure=request.url.scheme == "https" or request.headers.get("origin", "").startswith("https:"),
    )


PROBES = frozenset({"/livez", "/readyz"})
OPEN_PATHS = frozenset({"/", *PROBES, LINK_PATH})
"""Paths that answer without a key: the page, which asks for one, probes, which show nothing of scans, and the link that
replaces a key."""

_NAVIGATED = "navigate"
_JSON_TYPES = frozenset({"application/json", "application/problem+json"})
_BURST_S = 4.0
"""Seconds' worth of requests that may come at once: a page with its pictures."""
_MOST_COUNTED = 1024
_NOTED_EVERY_S = 60.0
"""Interval of records that a key sends too many requests: one for each would fill the record."""
_MOST_HELD = 128
_HELD_S = 1.0
"""Delay of the refusal of a request that is one too many: it slows clients that repeat at once."""
_CHECK_AGAIN_S = 5.0
"""Longest time that a stream goes on after its key was revoked or has expired."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request, the scopes of their key, and the end of that or of their session. key : its digest, ""
    where none is needed.
    """

    name: str
    scopes: tuple[KeyScope, ...] = ALL_SCOPES
    expires_at: datetime | None = None
    key: str = ""


class Access:
    """Middleware that admits a request by its key or session.

    ring, sessions : None admits all. per_second : answered requests of one name, or from one address without a key.
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
        self._held = Shares("refused requests", _MOST_HELD, "Wait.")

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
            if caller is not None:
                self._rates.count(caller.key, caller.name)
                refuse_out_of_scope(caller, needed_scope(method, path))
            elif path not in PROBES:
                # Behind a proxy all strangers have one address, and a monitor takes 429 for the service's end.
                self._rates.count(address, address)
        except Refused as refusal:
            if caller is not None and refusal.status == 429:
                with suppress(HTTPException), acting_as(caller.name), self._held.take():
                    await asyncio.sleep(_HELD_S)
            await self._refuse(refusal, address, caller, method, path, scope, receive, send)
            return
        scope.setdefault("state", {})["caller"] = caller
        status, made, life = 0, "", CancelScope()
        next_check: asyncio.TimerHandle | None = None

        def check_later() -> None:
            nonlocal next_check
            next_check = asyncio.get_running_loop().call_later(_CHECK_AGAIN_S, check)

        def check() -> None:
            try:
                self._caller(headers, path)
            except Refused:
                life.cancel()
            else:
                check_later()

        async def noted(message: Message) -> None:
            nonlocal status, made
            await send(message)
            if message["type"] == "http.response.start":
                kept = Headers(raw=message.get("headers", []))
                status, made = message["status"], kept.get("location", "")
                if "content-length" not in kept:
                    # It may be a stream, and last.
                    check_later()

        name = ANYONE if caller is None else caller.name
        try:
            with acting_as(name, key="" if caller is None else caller.key), life:
                await self._app(scope, receive, noted)
        finally:
            if next_check is not None:
                next_check.cancel()
        if life.cancelled_caught:
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        if method not in READING or path == LINK_PATH:
            await self._note(name, address, method, path, status, made)

    def _caller(self, headers: Headers, path: str) -> Caller | None:
        """The sender of a request; None for paths that need no key."""
        if self._ring is None or self._sessions is None:
            return Caller(ANYONE)
        if path in OPEN_PATHS or path.startswith(f"{FILES_PATH}/"):
            return None
        try:
            return self._known(self._ring, self._sessions, headers)
        except StorageError as error:
            # The path of the file stays hidden from strangers.
            _log.error("keys cannot be read", error=str(error))
            detail = "The service cannot read its keys, and refuses all requests. Its log says what to do."
            raise Refused(507, error.code, detail) from error

    def _known(self, ring: KeyRing, sessions: Sessions, headers: Headers) -> Caller:
        sent = _sent_key(headers)
        if sent is not None:
            return _admitted(ring.find(sent))
        cookie = cookie_parser(headers.get("cookie", "")).get(sessions.cookie)
        session = None if cookie is None else sessions.find(cookie)
        if session is not None:
            owner = _admitted(ring.by_digest(session.key))
            return replace(owner, expires_at=session.expires_at)
        raise _unauthorized("This service needs an API key." if cookie is None else "The session is over.")

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
                self._rates.count(address, address)
            except Refused as too_many:
                refusal = too_many
        elif caller is not None and refusal.noted:
            await self._note(caller.name, address, method, path, refusal.status, "")
        response: Response = answer(problem(refusal.status, refusal.code, str(refusal)), headers=refusal.headers)
        if refusal.status == 401 and method == "GET" and "text/html" in Headers(scope=scope).get("accept", ""):
            # A person with a browser, who can log in at the page.
            response = RedirectResponse("/", status_code=303)
        await response(scope, receive, send)

    async def _note(self, name: str, address: str, method: str, path: str, status: int, made: str) -> None:
        try:
            await run_in_threadpool(self._audit.note, name, address, method, path, status, made)
        except StorageError as error:
            # The request was served: its answer stays.
            _log.warning("not put on record", who=name, method=method, path=path, status=status, error=str(error))


class Refused(Exception):  # noqa: N818 - an answer, not a fault of ours
    """A request that goes no further."""

    def __init__(
        self, status: int, code: str, detail: str, headers: dict[str, str] | None = None, *, noted: bool = True
    ) -> None:
        super().__init__(detail)
        self.status, self.code, self.headers, self.noted = status, code, headers, noted


def refuse_foreign_page(headers: Headers, method: str, path: str, *, by_cookie: bool) -> None:
    """Refuse what another site's page, or another service's of this machine, has a browser send.

    Browsers say where a request comes from: in Sec-Fetch-Site (W3C Fetch Metadata), where the address is this machine
    or encrypted, and in Origin with all that writes. A page cannot change either. A link may be followed
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
    """Refuse a body that a form of any page could send: neither JSON nor a file to import. Raises Refused."""
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


def _admitted(key: Key | None) -> Caller:
    if key is None:
        raise _unauthorized("Unknown API key.")
    fault = key.fault(utc_now())
    if fault is not None:
        raise _unauthorized(f"This API key {fault}.")
    return Caller(key.name, key.scopes, key.expires_at, key.digest)


def _unauthorized(found: str) -> Refused:
    detail = (
        f"{found} Send a key as 'Authorization: Bearer KEY' or 'X-API-Key: KEY'. The operator of the service makes "
        "one with `slrig key add NAME`."
    )
    return Refused(401, "unauthorized", detail, {"WWW-Authenticate": "Bearer"})


def refuse_out_of_scope(caller: Caller, needed: KeyScope) -> None:
    """Refuse what a key is not for. Raises Refused."""
    if needed in caller.scopes:
        return
    detail = (
        f"The key of '{caller.name}' is for {', '.join(caller.scopes)}, and this takes one to {needed}. Ask the "
        f"operator of the service for one: `slrig key add NAME --scope {needed}`."
    )
    raise Refused(403, "scope", detail)


def _sent_key(headers: Headers) -> str | None:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token.strip():
        return token.strip()
    return headers.get("x-api-key")


class Rates:
    """Limit of the requests of each key, or address without one: so many a second, and a few seconds' worth at once (a
    token bucket).

    >>> rates = Rates(1, clock=lambda: 0.0)
    >>> for _ in range(4): rates.count("key of ann", "ann")
    >>> rates.count("key of ann", "ann")
    Traceback (most recent call last):
    ...
    slrig.api.auth.Refused: 'ann' sends more than 1 requests a second. Wait a second, then send fewer.
    >>> rates.count("key of bob", "bob")
    """

    def __init__(self, per_second: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_second = per_second
        self._clock = clock
        self._left: OrderedDict[str, tuple[float, float, float]] = OrderedDict()

    def count(self, sender: str, name: str) -> None:
        """Count one request of a sender, called so in the refusal. Raises Refused: it is one too many."""
        now = self._clock()
        most = max(self._per_second * _BURST_S, 1.0)
        left, since, noted = self._left.pop(sender, (most, now, -math.inf))
        left = min(left + (now - since) * self._per_second, most)
        allowed, note = left >= 1.0, now >= noted + _NOTED_EVERY_S
        self._left[sender] = (left - 1.0, now, noted) if allowed else (left, now, now if note else noted)
        if len(self._left) > _MOST_COUNTED:
            self._left.popitem(last=False)
        if not allowed:
            detail = f"'{name}' sends more than {self._per_second:g} requests a second. Wait a second, then send fewer."
            raise Refused(429, "too-many-requests", detail, {"Retry-After": "1"}, noted=note)


LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")

_TOO_LONG = 413
_PASS_OVER_S = 1.0
"""A body of 100 MB is here by then on a usual network; who sends more, or slowly, may find the connection reset."""

_HEADERS = {
    # What is sent as a picture or as text is never run.
    "X-Content-Type-Options": "nosniff",
    # Our pages load from here alone, and no page may frame them.
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    # No other site's page shows our pictures, holds our window, or learns which page a link was on.
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class SecurityHeaders:
    """Middleware that adds them, where an answer says nothing of its own."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                # A report has a stricter policy of its own.
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers if scope["type"] == "http" else send)


class BodyLimits:
    """Middleware: how long a body may be. `most_bytes` holds for every path but those of `longer`."""

    def __init__(self, app: ASGIApp, *, most_bytes: int, longer: Mapping[str, int]) -> None:
        self._usual = RequestBodyLimitMiddleware(app, max_body_size=most_bytes)
        self._longer = {path: RequestBodyLimitMiddleware(app, max_body_size=most) for path, most in longer.items()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        limited = self._longer.get(scope["path"], self._usual) if scope["type"] == "http" else self._usual

        async def after_the_body(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == _TOO_LONG:
                await _pass_over(scope, receive)
            await send(message)

        await limited(scope, receive, after_the_body)


async def _pass_over(scope: Scope, receive: Receive) -> None:
    """Take what a client is still sending, for a moment: a connection that is closed with bytes unread is reset, and
    a proxy then loses the answer. One that waits for a permission to send has sent nothing.
    """
    if any(name == b"expect" for name, _ in scope["headers"]):
        return
    with suppress(TimeoutError):
        async with asyncio.timeout(_PASS_OVER_S):
            while (await receive()).get("more_body", False):
                pass

"""Who may talk to the service, by which name, and how much at once: whoever has the key."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Mapping
from pathlib import Path

from starlette.datastructures import Headers
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from slrig import KEY_VARIABLE
from slrig.api.problems import answer, problem
from slrig.bundle.storage import write_file
from slrig.errors import ConfigError

OPEN_PATHS = frozenset({"/livez", "/readyz"})
"""What answers without a key: probes, which tell nothing about scans."""

LEAST_KEY_LENGTH = 16
"""A key that people made up and that is shorter than this can be guessed."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")


def digest(key: str) -> str:
    """What is kept of a key: its SHA-256. A key has 256 random bits, so it needs no salt and no slow hash."""
    return hashlib.sha256(key.encode()).hexdigest()


def claim_key(path: Path, *, given: str | None, fresh: bool) -> tuple[str, str | None]:
    """Return the digest of the service's key, and the key itself if it was made just now, to be shown once.

    `given` is a key from the environment, used as it is and kept nowhere; else the digest in `path`; `fresh`, or no
    such file, makes a new key.

    Raises
    ------
    ConfigError
        The given key is too short or cannot travel in a header, or a fresh one is asked for beside it.
    StorageError
        The digest cannot be written.
    """
    if given:
        _refuse_bad_key(given, fresh=fresh)
        return digest(given), None
    if not fresh and path.is_file():
        return path.read_text(encoding="ascii").strip(), None
    key = secrets.token_urlsafe(32)
    write_file(path, f"{digest(key)}\n".encode("ascii"))
    path.chmod(0o600)
    return digest(key), key


def _refuse_bad_key(given: str, *, fresh: bool) -> None:
    if fresh:
        message = f"--new-key asks for a new key, and {KEY_VARIABLE} holds the one to use. Leave out one of the two."
        raise ConfigError(message)
    sendable = given.isascii() and given.isprintable()
    if len(given) < LEAST_KEY_LENGTH or not sendable:
        others = "" if sendable else ", and others among them"
        message = (
            f"{KEY_VARIABLE}: expected a key of {LEAST_KEY_LENGTH} or more printable ASCII characters, found "
            f"{len(given)}{others}. Unset it, and the service makes a key of its own."
        )
        raise ConfigError(message)


class KeyCheck:
    """Middleware that lets only requests with the key pass: `Authorization: Bearer KEY` or `X-API-Key: KEY`."""

    def __init__(self, app: ASGIApp, *, key_digest: str) -> None:
        self._app = app
        self._digest = key_digest

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it."""
        if scope["type"] == "http" and scope["path"] not in OPEN_PATHS:
            sent = _sent_key(Headers(scope=scope))
            if sent is None or not hmac.compare_digest(digest(sent), self._digest):
                detail = (
                    f"This service needs its API key, and the request has {'none' if sent is None else 'another one'}. "
                    "Send the key that was printed at the first start as 'Authorization: Bearer KEY' or 'X-API-Key: "
                    "KEY'; if it is lost, start the service with --new-key."
                )
                refusal = answer(problem(401, "unauthorized", detail), headers={"WWW-Authenticate": "Bearer"})
                await refusal(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _sent_key(headers: Headers) -> str | None:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token.strip():
        return token.strip()
    return headers.get("x-api-key")


class BodyLimits:
    """Middleware: how long a body may be. `most_bytes` holds for every path but those of `longer`."""

    def __init__(self, app: ASGIApp, *, most_bytes: int, longer: Mapping[str, int]) -> None:
        self._usual = RequestBodyLimitMiddleware(app, max_body_size=most_bytes)
        self._longer = {path: RequestBodyLimitMiddleware(app, max_body_size=most) for path, most in longer.items()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        limited = self._longer.get(scope["path"], self._usual) if scope["type"] == "http" else self._usual
        await limited(scope, receive, send)

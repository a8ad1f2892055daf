"""/session: a browser's session. A key, or the one-time link that `slrig serve` prints, is exchanged for a cookie.

A browser sends a cookie with what a page cannot put a key into: pictures, event streams, downloads. Scripts cannot read
it (HttpOnly), and no other site's page has it sent (SameSite=Strict). Sessions live as long as the service.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from slrig.api.keys import KeyRing, digest
from slrig.api.openapi import problems
from slrig.api.scopes import Scope
from slrig.jobs.records import Clock, utc_now

LINK_PATH = "/session/link"
SESSION_LIFE = timedelta(hours=12)
"""A working day."""
LINK_LIFE = timedelta(minutes=15)
MOST_SESSIONS = 256
"""The oldest goes when there are more."""

router = APIRouter(prefix="/session", tags=["session"])


@dataclass(frozen=True, slots=True)
class Session:
    """One browser that is logged in: by whose key, and until when. ends : what is left when that key ends."""

    name: str
    expires_at: datetime


class Sessions:
    """Who is logged in. Lives on the event loop's thread, but for `link`, which is made before the loop runs."""

    def __init__(self, ring: KeyRing, *, cookie: str, clock: Clock = utc_now) -> None:
        self.ring = ring
        # Cookies do not tell ports apart: two services of one machine need two names.
        self.cookie = cookie
        self._clock = clock
        self._open: OrderedDict[str, Session] = OrderedDict()
        self._links: dict[str, Session] = {}

    def link(self, name: str) -> str:
        """A secret that opens one session by the key of a name."""
        secret = secrets.token_urlsafe(32)
        self._links[digest(secret)] = Session(name, self._clock() + LINK_LIFE)
        return secret

    def follow(self, secret: str) -> tuple[str, Session] | None:
        """Open the session of a link, once; None where it was followed before, or is too old."""
        link = self._links.pop(digest(secret), None)
        return None if link is None or link.expires_at <= self._clock() else self.open(link.name)

    def open(self, name: str) -> tuple[str, Session]:
        """Open a session by the key of a name: the secret for the cookie, and what it stands for."""
        secret = secrets.token_urlsafe(32)
        session = Session(name, self._clock() + SESSION_LIFE)
        self._open[digest(secret)] = session
        while len(self._open) > MOST_SESSIONS:
            self._open.popitem(last=False)
        return secret, session

    def find(self, secret: str) -> Session | None:
        """The session that a cookie stands for."""
        found = self._open.get(digest(secret))
        return found if found is not None and found.expires_at > self._clock() else None

    def close(self, secret: str) -> None:
        """Log out. Idempotent."""
        self._open.pop(digest(secret), None)


class SessionBody(BaseModel):
    """Whom the service takes the sender for, what that name may do, and until when; null is without end."""

    name: str
    scopes: tuple[Scope, ...]
    expires_at: datetime | None


@router.get("")
async def look_at_session(request: Request) -> SessionBody:
    """Return whom the service takes you for."""
    caller = request.state.caller
    return SessionBody(name=caller.name, scopes=caller.scopes, expires_at=caller.expires_at)


@router.post("", status_code=201)
async def open_session(request: Request, response: Response) -> SessionBody:
    """Log a browser in: send the key in a header, as always, and go on with the cookie that comes back."""
    caller = request.state.caller
    sessions: Sessions | None = request.app.state.sessions
    if sessions is None:
        raise HTTPException(409, "This service asks nobody for a key, so there is nothing to log in to.")
    secret, session = sessions.open(caller.name)
    _set_cookie(request, response, sessions, secret)
    return SessionBody(name=caller.name, scopes=caller.scopes, expires_at=session.expires_at)


@router.delete("", status_code=204)
async def close_session(request: Request, response: Response) -> None:
    """Log a browser out."""
    sessions: Sessions | None = request.app.state.sessions
    if sessions is not None:
        sessions.close(request.cookies.get(sessions.cookie, ""))
        response.delete_cookie(sessions.cookie, path="/", httponly=True, samesite="strict")


@router.get(
    "/link",
    response_class=Response,
    status_code=303,
    responses={303: {"description": "logged in; on to the page of the service"}, **problems(401)},
    openapi_extra={"security": []},
)
async def follow_link(request: Request, token: Annotated[str, Query(max_length=200)]) -> Response:
    """Log a browser in by the link that `slrig serve` prints. It works once, for a quarter of an hour."""
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

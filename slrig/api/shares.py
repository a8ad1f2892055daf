"""Shares of limited resources among requests, and results made once for all requests of the same."""

from __future__ import annotations

import asyncio
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Hashable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any, TypeVar

from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from slrig.jobs.records import ANYONE, actor, has_share

_Made = TypeVar("_Made")


class Shares:
    """Places of one kind, of which everybody has a share, by `slrig.jobs.records.has_share`. Lives on the event loop's
    thread.

    what : the places, as a refusal calls them. remedy : what to do when there is none. at_once : how many of one name
    go on at once, of those that wait for their `turn`. taken : how many places each name has.
    """

    def __init__(
        self, what: str, total: int, remedy: str, *, status: int = 429, retry_s: int = 5, at_once: int = 1
    ) -> None:
        self._what, self._total, self._remedy, self._status, self._retry_s = what, total, remedy, status, retry_s
        self._turns: defaultdict[str, asyncio.Semaphore] = defaultdict(lambda: asyncio.Semaphore(at_once))
        self.taken: Counter[str] = Counter()

    def require(self, who: str, taken: Counter[str]) -> None:
        """Raise HTTPException unless a name may have one place more, of which so many are taken by whom."""
        if has_share(self._total, who, list(taken.elements())):
            return
        detail = (
            f"{who} has {taken[who]} of {self._total} {self._what}, others have {taken.total() - taken[who]}, and "
            f"no one gets more than are left for all others. {self._remedy}"
        )
        raise HTTPException(self._status, detail, headers={"Retry-After": str(self._retry_s)})

    @contextmanager
    def take(self) -> Iterator[None]:
        """Hold a place within the block for the current caller. Raises HTTPException: there is none."""
        who = actor() or ANYONE
        self.require(who, self.taken)
        self.taken[who] += 1
        try:
            yield
        finally:
            self.taken[who] -= 1
            # Without those who have none.
            self.taken += Counter()

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Hold a place, and wait in it, on no thread, for the turn. Raises HTTPException: there is none."""
        with self.take():
            async with self._turns[actor() or ANYONE]:
                yield


class Makings:
    """Results made on request, on a thread, once for all concurrent requests of the same. Lives on the event loop's
    thread. shares : of requests that make something; those that only wait need none.
    """

    def __init__(self, shares: Shares) -> None:
        self.shares = shares
        self._makings: dict[Hashable, asyncio.Future[Any]] = {}

    async def of(self, what: Hashable, make: Callable[[], _Made], *, fresh_s: float = 0.0) -> _Made:
        """The result of `make`, or of another call of it for the same that is under way or has just succeeded.

        Raises its errors, and HTTPException: there is no place to make it.
        """
        if what not in self._makings:
            self._makings[what] = asyncio.ensure_future(self._make(what, make, fresh_s))
        # A client that leaves does not end it for others.
        made: _Made = await asyncio.shield(self._makings[what])
        return made

    async def _make(self, what: Hashable, make: Callable[[], _Made], fresh_s: float) -> _Made:
        kept_s = 0.0
        try:
            async with self.shares.turn():
                made = await run_in_threadpool(make)
            kept_s = fresh_s
            return made
        finally:
            asyncio.get_running_loop().call_later(kept_s, self._makings.pop, what)

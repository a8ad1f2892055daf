"""Shares of what requests take from one another, and what is made once for all who ask for the same."""

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
            f"nobody gets more than are left for all others. {self._remedy}"
        )
        raise HTTPException(self._status, detail, headers={"Retry-After": str(self._retry_s)})

    @contextmanager
    def take(self) -> Iterator[None]:
        """Have a place within the block, for whoever asks now. Raises HTTPException: there is none."""
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
        """Have a place, and wait in it, on no thread, for the turn. Raises HTTPException: there is none."""
        with self.take():
            async with self._turns[actor() or ANYONE]:
                yield


class Makings:
    """What is made on request, on a thread, once for all who ask for the same meanwhile. Lives on the event loop's
    thread. shares : of those who make something; who only waits for it needs none.
    """

    def __init__(self, shares: Shares) -> None:
        self.shares = shares
        self._makings: dict[Hashable, asyncio.Future[Any]] = {}

    async def of(self, what: Hashable, make: Callable[[], _Made], *, fresh_s: float = 0.0) -> _Made:
        """What `make` returns, or another call of it for the same, which is under way or ended well just before.

        Raises what that raises, and HTTPException: there is no place to make it.
        """
        if what not in self._makings:
            self._makings[what] = asyncio.ensure_future(self._make(what, make, fresh_s))
        # One who goes away ends it for nobody else.
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

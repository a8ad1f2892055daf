"""How requests travel: over httpx2's blocking client, or its asynchronous one. All that the two clients differ in.

Everything else is written once, as coroutines over a wire. Those over `Blocking` never wait for an event loop, so that
one step runs them to their end.
"""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator
from contextlib import aclosing
from typing import Any, TypeVar

import httpx2

T = TypeVar("T")


class Blocking:
    """The wire of `Client`. pause : what waits."""

    def __init__(self, http: httpx2.Client, pause: Callable[[float], None] = time.sleep) -> None:
        self.http = http
        self._pause = pause

    async def send(self, request: httpx2.Request, *, stream: bool = False) -> httpx2.Response:
        """Send a request. stream : return before the body has come. Raises httpx2.TransportError."""
        return self.http.send(request, stream=stream)

    async def read(self, response: httpx2.Response) -> None:
        """Read the whole body of a streamed answer."""
        response.read()

    async def pieces(self, response: httpx2.Response) -> AsyncGenerator[bytes]:
        """The body of a streamed answer, as it comes."""
        for piece in response.iter_bytes():
            yield piece

    async def events(self, response: httpx2.Response) -> AsyncGenerator[httpx2.ServerSentEvent]:
        """The events of a streamed answer, as they come."""
        for event in httpx2.EventSource(response):
            yield event

    async def shut(self, response: httpx2.Response) -> None:
        """Let go of a streamed answer."""
        response.close()

    async def pause(self, seconds: float) -> None:
        """Wait."""
        self._pause(seconds)

    async def apart(self, work: Callable[[], T]) -> T:
        """Do what keeps the processor or the disk busy, beside the event loop if there is one."""
        return work()

    def drive(self, steps: Coroutine[Any, Any, T]) -> T:
        """What a caller gets of a coroutine: its result, or itself to be awaited."""
        try:
            steps.send(None)
        except StopIteration as over:
            result: T = over.value
            return result
        steps.close()
        message = "an operation of a blocking client waited for an event loop"
        raise RuntimeError(message)

    def drive_each(self, steps: AsyncGenerator[T]) -> Iterator[T]:
        """What a caller gets of an asynchronous generator: an iterator, or one that is asynchronous."""
        try:
            while True:
                try:
                    yield self.drive(anext(steps))
                except StopAsyncIteration:
                    return
        finally:
            self.drive(steps.aclose())


class Awaited:
    """The wire of `AsyncClient`, on asyncio's event loop. Its methods are those of `Blocking`."""

    def __init__(self, http: httpx2.AsyncClient) -> None:
        self.http = http

    async def send(self, request: httpx2.Request, *, stream: bool = False) -> httpx2.Response:
        """See `Blocking`."""
        return await self.http.send(request, stream=stream)

    async def read(self, response: httpx2.Response) -> None:
        """See `Blocking`."""
        await response.aread()

    async def pieces(self, response: httpx2.Response) -> AsyncGenerator[bytes]:
        """See `Blocking`."""
        async for piece in response.aiter_bytes():
            yield piece

    async def events(self, response: httpx2.Response) -> AsyncGenerator[httpx2.ServerSentEvent]:
        """See `Blocking`."""
        async for event in httpx2.EventSource(response):
            yield event

    async def shut(self, response: httpx2.Response) -> None:
        """See `Blocking`."""
        await response.aclose()

    async def pause(self, seconds: float) -> None:
        """See `Blocking`."""
        import asyncio

        await asyncio.sleep(seconds)

    async def apart(self, work: Callable[[], T]) -> T:
        """See `Blocking`."""
        import asyncio

        return await asyncio.to_thread(work)

    def drive(self, steps: Coroutine[Any, Any, T]) -> Coroutine[Any, Any, T]:
        """See `Blocking`."""
        return steps

    async def drive_each(self, steps: AsyncGenerator[T]) -> AsyncIterator[T]:
        """See `Blocking`."""
        async with aclosing(steps):
            async for each in steps:
                yield each

"""Tests that are coroutine functions, each on a loop of its own."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, ParamSpec

P = ParamSpec("P")
LONGEST_S = 60.0
"""How long a test may wait for what must come; one that passes never waits so long."""


def on_loop(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """Decorator that runs such a test."""

    async def limited(*args: P.args, **options: P.kwargs) -> None:
        async with asyncio.timeout(LONGEST_S):
            await test(*args, **options)

    @wraps(test)
    def run(*args: P.args, **options: P.kwargs) -> None:
        asyncio.run(limited(*args, **options))

    return run

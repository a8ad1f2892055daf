"""What tests of drivers open is closed after them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

OPENED: list[Any] = []


@pytest.fixture(autouse=True)
def closed_afterwards() -> Iterator[None]:
    yield
    while OPENED:
        OPENED.pop().close()

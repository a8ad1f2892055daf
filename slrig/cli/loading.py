"""Loading of modules by commands."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Import modules within the block, without a search for garbage: what they make stays.

    A search of a hundred thousand objects takes a tenth of a second, now and each later time.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()

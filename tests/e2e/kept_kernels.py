"""Loads the compiled kernels that the disk keeps, of the modules that are imported: for a process that is forked from.

A kernel is usually loaded when it is first called. None is called here: a process that forks has to have no threads.
"""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Any

from slrig import kernels

_SIGNATURE = 3
"""Its place in what numba keeps of a kernel."""


def load_kept_kernels() -> int:
    """Load each kernel for every signature that it was compiled for; how many that were."""
    return sum(_load(dispatcher) for dispatcher, _ in kernels._entries)


def _load(dispatcher: Any) -> int:
    cache = dispatcher._cache
    files = cache._cache_file
    loaded = 0
    for path in Path(cache.cache_path).glob(f"{glob.escape(files._base)}.{files._digest_of_sources()}.*.nbc"):
        given = tuple(files._load_data(path.name)[_SIGNATURE].args)
        # One that was compiled by another kind of processor, or with other options, has another name.
        if path.name == files._name(cache._index_key(given, dispatcher.targetctx.codegen())):
            dispatcher.compile(given)
            loaded += 1
    return loaded


load_kept_kernels()

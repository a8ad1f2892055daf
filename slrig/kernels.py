"""Compiled kernels: compilation, cache, count, and execution on all cores.

numba compiles a kernel on its first call, and keeps it on disk. A kernel runs on one core and releases the
interpreter's lock; `in_bands` calls one for bands of rows on all cores at once. numba's own parallel loops are not
used: they take three to four times as long to compile, do not compile everywhere (numba 0.68 on Python 3.12 and 3.13
fails at sums over nested loops), and the threads of GNU OpenMP busy-wait.
"""

from __future__ import annotations

import ctypes
import gc
import glob
import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import structlog
from numba import config, njit
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

_BANDS_PER_CORE = 4  # rows take different times; with four bands the last core ends only a few per cent late
_MUCH_BYTES = 2**30
"""A scan of 1.3 megapixels holds two thirds of it; below, taking memory again costs more than is saved."""
_STATM = Path("/proc/self/statm")

_log = structlog.get_logger(__name__)
_kernels: list[tuple[Dispatcher, bool]] = []


def kernel(function: Callable[..., Any] | None = None, /, *, in_every_scan: bool = True, **options: Any) -> Any:
    """Compile a function that Python calls, on its first call, and keep the result on disk.

    in_every_scan : True if a scan by a camera and a calibrated projector needs it, so that it is prepared ahead;
    options : further ones of `numba.njit`.
    """

    def decorate(python_function: Callable[..., Any]) -> Any:
        compiled = _compile(python_function, options)
        if isinstance(compiled, Dispatcher):
            _kernels.append((compiled, in_every_scan))
        return compiled

    return decorate if function is None else decorate(function)


def kernel_part(function: Callable[..., Any] | None = None, /, *, borrows: bool = False, **options: Any) -> Any:
    """Compile a function that kernels call: it becomes part of theirs.

    borrows : True if it makes no array and returns none, so that references to its arguments need no counting. numba
    omits the counting by itself for arguments that are arrays, but not for fields of a tuple argument (numba issue
    2350). All cores share these counters, so the counting may take more than half of the time.
    """
    options = {"_nrt": not borrows, **options}
    return (lambda each: _compile(each, options)) if function is None else _compile(function, options)


class KernelCount(NamedTuple):
    """Number of kernels for every scan that are compiled or loaded in this process, and number of all of them."""

    done: int
    total: int


def count_prepared() -> KernelCount:
    """Count the kernels of the imported modules."""
    needed = [dispatcher for dispatcher, in_every_scan in _kernels if in_every_scan]
    return KernelCount(sum(bool(each.overloads) for each in needed), len(needed))


def are_all_cached() -> bool:
    """True if the disk holds every kernel for every scan, of the imported modules and their present sources.

    One signature each is enough: nothing has to be compiled ahead then.
    """
    return all(_is_cached(dispatcher) for dispatcher, in_every_scan in _kernels if in_every_scan)


@contextmanager
def report_compilations(report: Callable[[str], None]) -> Iterator[None]:
    """Call `report` with the name of each kernel or part when its compilation begins, on the compiling thread."""
    listener = _CompilationListener(report)
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)


@contextmanager
def rare_garbage_collection() -> Iterator[None]:
    """Search for reference cycles less often while kernels are compiled.

    The compiler makes millions of objects that live on. Searching through them at Python's usual rate takes a good part
    of the time and frees next to nothing.
    """
    usual = gc.get_threshold()
    gc.set_threshold(50_000, 20, 20)
    try:
        yield
    finally:
        gc.set_threshold(*usual)


def in_bands(
    compiled: Callable[..., Any], count: int, /, *given: Any, rows_at_least: int = 1, rows_at_most: int | None = None
) -> list[Any]:
    """Call compiled(first, last, *given) for bands that make up range(count), on all cores; return the results in
    order.

    rows_at_least : smallest band, if a call costs more than its rows. rows_at_most : largest band, if rows take memory.
    Bands may write to different rows of one array only.
    """
    share = -(-count // (_BANDS_PER_CORE * config.NUMBA_NUM_THREADS)) if config.NUMBA_NUM_THREADS > 1 else count
    share = max(rows_at_least, min(share, rows_at_most or count), 1)
    borders = [*range(0, count, share), count]
    if len(borders) <= 2 or config.NUMBA_NUM_THREADS == 1:
        return [compiled(first, last, *given) for first, last in pairwise(borders)] or [compiled(0, count, *given)]
    bands = [_pool().submit(compiled, first, last, *given) for first, last in pairwise(borders)]
    wait(bands)
    return [band.result() for band in bands]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(config.NUMBA_NUM_THREADS, thread_name_prefix="slrig-kernel")


def _compile(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    # Division by zero is infinite or NaN, as in numpy: missing values are NaN, and no kernel raises.
    compiled: Any = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    if _is_compiled(compiled):  # with NUMBA_DISABLE_JIT it is the function itself
        compiled._cache = _KernelCache(function)  # noqa: SLF001 - numba has no other place to choose a cache
    return compiled


def _is_cached(compiled: Any) -> bool:
    return bool(compiled.overloads) or compiled._cache.is_cached()  # noqa: SLF001 - see `_compile`


def _is_compiled(function: Any) -> bool:
    return isinstance(function, Dispatcher)


class _CompilationListener(event.Listener):  # type: ignore[misc] # numba is untyped
    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report

    def on_start(self, started: event.Event) -> None:
        self._report(started.data["dispatcher"].py_func.__qualname__.lstrip("_"))

    def on_end(self, ended: event.Event) -> None:
        pass


class _KernelCache(FunctionCache):  # type: ignore[misc] # numba is untyped
    """numba's cache with files that two processes may write at once, and that depend on the sources of a kernel's
    parts.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        state: dict[str, Any] = self.__dict__
        state["_cache_file"] = _KeyedFiles(function, state["_cache_file"])

    def is_cached(self) -> bool:
        """True if the disk holds code compiled from the present sources."""
        files: _KeyedFiles = self.__dict__["_cache_file"]
        return files.is_cached()

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code. If the disk refuses, the next start compiles again, but nothing fails."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.warning("a compiled kernel cannot be kept", path=self.cache_path, cause=str(error))


class _KeyedFiles(IndexDataCacheFile):  # type: ignore[misc] # numba is untyped
    """One file for each compiled signature, with a name that depends on all its inputs.

    numba's own cache numbers its files in an index that two processes may write at the same time; one may then name the
    code of another signature (numba issue 4807). Without an index, equal names mean equal contents.
    """

    def __init__(self, function: Callable[..., Any], numbered: IndexDataCacheFile) -> None:
        self.__dict__.update(numbered.__dict__)
        self._function = function
        self._base = str(vars(numbered)["_index_name"]).removesuffix(".nbi")
        self._sources = ""

    def save(self, key: Any, data: Any) -> None:
        name = self._name(key)
        self._save_data(name, data)
        for old in Path(self._cache_path).glob(f"{glob.escape(self._base)}.*.nbc"):
            if not old.name.startswith(f"{self._base}.{self._sources}."):
                old.unlink(missing_ok=True)

    def load(self, key: Any) -> Any:
        try:
            return self._load_data(self._name(key))
        except (OSError, EOFError, pickle.UnpicklingError):
            return None

    def is_cached(self) -> bool:
        return any(Path(self._cache_path).glob(f"{glob.escape(self._base)}.{self._digest_of_sources()}.*.nbc"))

    def flush(self) -> None:
        for old in Path(self._cache_path).glob(f"{glob.escape(self._base)}.*.nbc"):
            old.unlink(missing_ok=True)

    def _name(self, key: Any) -> str:
        return f"{self._base}.{self._digest_of_sources()}.{_digest(key)}.nbc"

    def _digest_of_sources(self) -> str:
        if not self._sources:
            self._sources = _digest((self._version, config.BOUNDSCHECK, sorted(_sources(self._function, set()))))
        return self._sources


def _digest(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def _sources(function: Callable[..., Any], visited: set[Callable[..., Any]]) -> set[tuple[str, int, int]]:
    """Name, time and size of the source files of a kernel and of the parts that it calls."""
    visited.add(function)
    file = Path(function.__code__.co_filename)
    files = {(file.name, file.stat().st_mtime_ns, file.stat().st_size)} if file.is_file() else set()
    for name in function.__code__.co_names:
        part = function.__globals__.get(name)
        if isinstance(part, Dispatcher) and part.py_func not in visited:
            files |= _sources(part.py_func, visited)
    return files


def trim_malloc() -> None:
    """Return free memory to the system before the next step, if this process holds more than a gigabyte.

    glibc keeps a third of the memory that a large scan has freed. Does nothing without Linux and glibc.
    """
    trim = _trim()
    if trim is not None and _resident_bytes() > _MUCH_BYTES:
        trim(0)


@cache
def _trim() -> Any:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def _resident_bytes() -> int:
    """Return the resident memory of this process; 0 if the system does not report it."""
    with suppress(OSError):
        return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0

"""Compiled kernels: how they are compiled, kept between runs, counted, and shared out over the cores.

A kernel is compiled by numba when it is first called and kept on disk. Kernels run on one core and let go of the
interpreter's lock; `in_bands` calls one for bands of rows on all cores at once. numba's own parallel loops are not
used: they take three to four times as long to compile, do not compile everywhere (numba 0.68 on Python 3.12 and 3.13
fails at sums over nested loops), and the threads of GNU OpenMP spin beside other work.
"""

from __future__ import annotations

import glob
import hashlib
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import structlog
from numba import config, njit
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

_BANDS_PER_CORE = 4  # rows differ in what there is to do; the last core to end is then a few per cent late

_log = structlog.get_logger(__name__)
_entries: list[tuple[Dispatcher, bool]] = []


def kernel(function: Callable[..., Any] | None = None, /, *, in_every_scan: bool = True, **options: Any) -> Any:
    """Compile a function that Python calls, on its first call, and keep what was compiled.

    in_every_scan : whether a scan by a camera and a calibrated projector needs it, so that it is prepared ahead;
    options : further ones of `numba.njit`.
    """

    def made(each: Callable[..., Any]) -> Any:
        compiled = _compiled(each, options)
        if isinstance(compiled, Dispatcher):
            _entries.append((compiled, in_every_scan))
        return compiled

    return made if function is None else made(function)


def kernel_part(function: Callable[..., Any] | None = None, /, *, borrows: bool = False, **options: Any) -> Any:
    """Compile a function that kernels call: it becomes part of theirs.

    borrows : it makes no array and returns none, so that references to those it is given need no counting. numba leaves
    that out by itself where arrays are arguments, and not where they are fields of a tuple that is one (numba issue
    2350): a count per field and call, which all cores share, may be more than half of the time.
    """
    options = {"_nrt": not borrows, **options}
    return (lambda each: _compiled(each, options)) if function is None else _compiled(function, options)


class Prepared(NamedTuple):
    """How many of the kernels that every scan needs are compiled or loaded in this process, and how many there are."""

    done: int
    total: int


def prepared() -> Prepared:
    """Count the kernels of the modules that are imported."""
    needed = [dispatcher for dispatcher, in_every_scan in _entries if in_every_scan]
    return Prepared(sum(bool(each.overloads) for each in needed), len(needed))


def all_kept() -> bool:
    """Whether the disk has every kernel that every scan needs, of the modules that are imported, as their sources are
    now: for one signature at least, so that nothing has to be compiled ahead.
    """
    return all(_is_kept(dispatcher) for dispatcher, in_every_scan in _entries if in_every_scan)


@contextmanager
def compilations_told(tell: Callable[[str], None]) -> Iterator[None]:
    """Call `tell` with the name of each kernel or part whose compilation begins, on the thread that compiles."""
    listener = _Listener(tell)
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)


def in_bands(
    compiled: Callable[..., Any], count: int, /, *given: Any, rows_at_least: int = 1, rows_at_most: int | None = None
) -> list[Any]:
    """Call compiled(first, last, *given) for bands that make up range(count), on all cores; their answers, in order.

    rows_at_least : bands are not made smaller than this, where calling costs more than there is to do. rows_at_most :
    nor larger than this, where each takes memory by its rows. Bands may write to different rows of one array only.
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


def _compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    # Division by zero is infinite or NaN, as in numpy: unmeasured is NaN, and no kernel raises.
    compiled: Any = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    if _is_compiled(compiled):  # with NUMBA_DISABLE_JIT it is the function itself
        compiled._cache = _KernelCache(function)  # noqa: SLF001 - numba has no other place to choose a cache
    return compiled


def _is_kept(compiled: Any) -> bool:
    return bool(compiled.overloads) or compiled._cache.kept()  # noqa: SLF001 - see `_compiled`


def _is_compiled(function: Any) -> bool:
    return isinstance(function, Dispatcher)


class _Listener(event.Listener):  # type: ignore[misc] # numba is untyped
    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell

    def on_start(self, begun: event.Event) -> None:
        self._tell(begun.data["dispatcher"].py_func.__qualname__.lstrip("_"))

    def on_end(self, ended: event.Event) -> None:
        pass


class _KernelCache(FunctionCache):  # type: ignore[misc] # numba is untyped
    """numba's cache with files that two processes may write at once, and that know the sources of a kernel's parts."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        state: dict[str, Any] = self.__dict__
        state["_cache_file"] = _KeyedFiles(function, state["_cache_file"])

    def kept(self) -> bool:
        """Whether something that was compiled of the present sources is on the disk."""
        files: _KeyedFiles = self.__dict__["_cache_file"]
        return files.kept()

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save what was compiled. A disk that refuses costs the next start its time, and fails nothing."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.warning("a compiled kernel cannot be kept", path=self.cache_path, cause=str(error))


class _KeyedFiles(IndexDataCacheFile):  # type: ignore[misc] # numba is untyped
    """One file for each compiled signature, named by all that it depends on.

    numba's own numbers its files in an index that two processes may write at the same time; one may then name the
    code of another signature (numba issue 4807). Here there is no index, and equal names mean equal contents.
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

    def kept(self) -> bool:
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


def _sources(function: Callable[..., Any], seen: set[Callable[..., Any]]) -> set[tuple[str, int, int]]:
    """Path, time and size of the source files of a kernel and of the parts that it calls."""
    seen.add(function)
    file = Path(function.__code__.co_filename)
    found = {(file.name, file.stat().st_mtime_ns, file.stat().st_size)} if file.is_file() else set()
    for name in function.__code__.co_names:
        part = function.__globals__.get(name)
        if isinstance(part, Dispatcher) and part.py_func not in seen:
            found |= _sources(part.py_func, seen)
    return found

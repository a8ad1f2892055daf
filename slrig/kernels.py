"""Compiled kernels: compilation, cache, count, and execution on all cores.

numba compiles a kernel on its first call, and keeps it on disk. A wheel for one platform brings kernels along
(config/deploy/wheel.py makes it): an archive for each of two levels of x86-64, with members named like the files of
the cache, by all that went into them. All kernels are compiled for the level of the processor, not for its model,
so that one machine's kernels run on others. A kernel runs on one core and releases the
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
import platform
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding
import numba
import numpy as np
import structlog
from numba import config, njit
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

_BANDS_PER_CORE = 4  # rows take different times; with four bands the last core ends only a few per cent late
_MUCH_BYTES = 2**30
"""A scan of 1.3 megapixels holds two thirds of it; below, taking memory again costs more than is saved."""
_STATM = Path("/proc/self/statm")
_SHIPPED = Path(__file__).with_name("compiled")
_V2 = {"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"}
_V3 = _V2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"}
CPU_LEVELS = {"x86-64-v3": _V3, "x86-64-v2": _V2}
"""Levels of the x86-64 psABI for which kernels are shipped, best first, and the features that LLVM names for each."""

_log = structlog.get_logger(__name__)
_kernels: list[tuple[Dispatcher, bool]] = []


def best_cpu_level() -> str | None:
    """Name by which LLVM knows the level of this processor: of x86-64 or, on aarch64, "generic"; None for others."""
    if platform.machine() == "aarch64":
        return "generic"
    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # not known to LLVM
        return None
    has = {name for name, there in features.items() if there}
    return next((level for level, needed in CPU_LEVELS.items() if needed <= has), None)


def _choose_cpu_level() -> None:
    """Make numba compile for the level, unless NUMBA_CPU_NAME says otherwise. In the environment, because numba reads
    that again when another of its variables changes; child processes inherit it.
    """
    level = best_cpu_level()
    if level is not None and "NUMBA_CPU_NAME" not in os.environ:
        os.environ.update(NUMBA_CPU_NAME=level, NUMBA_CPU_FEATURES="")
        config.reload_config()


_choose_cpu_level()


def shipped_archive_name() -> str:
    """Name of the archive of the kernels that fit here: by Python, numba, llvmlite and the CPU compiled for."""
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    return f"{sys.implementation.cache_tag}-{versions}-{config.CPU_NAME or 'this-processor'}.zip"


def why_compiled() -> str | None:
    """Return why kernels are compiled here and none are taken from the wheel; None if an archive fits."""
    there = sorted(each.name for each in _SHIPPED.glob("*.zip"))
    if shipped_archive_name() in there:
        return None
    if not there:
        return "slrig was installed without compiled kernels"
    return f"the compiled kernels that came with slrig are {', '.join(there)}; {shipped_archive_name()} would fit"


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


def kernels_not_cached() -> list[str]:
    """Names of kernels of the imported modules that neither the disk nor the wheel holds for any signature."""
    return [each.py_func.__qualname__ for each, _ in _kernels if not _is_cached(each)]


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
    compiled: Any = njit(nogil=True, error_model="numpy", **options)(function)
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

    It searches its folder on the first use: of two hundred kernels and parts that are loaded a run calls a few.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __getattr__(self, name: str) -> Any:
        """Called for what numba sets in `__init__`, before the first use."""
        if "_cache_file" in self.__dict__:
            raise AttributeError(name)
        state = dict(vars(FunctionCache(self._function)))
        self.__dict__.update(state, _cache_file=_KeyedFiles(self._function, state["_cache_file"]))
        return getattr(self, name)

    def is_cached(self) -> bool:
        """True if the disk holds code compiled from the present sources."""
        return bool(self._cache_file.is_cached())

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code, without the text of the inferred types: a third of the bytes, with the folder of the
        source. If the disk refuses, the next start compiles again, but nothing fails.
        """
        try:
            super().save_overload(sig, data._replace(type_annotation=""))
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
        name = self._name(key)
        try:
            return self._load_data(name)
        except (OSError, EOFError, pickle.UnpicklingError):
            return _shipped().load(name)

    def is_cached(self) -> bool:
        begin = f"{self._base}.{self._digest_of_sources()}."
        return _shipped().has(begin) or any(
            name.startswith(begin) and name.endswith(".nbc")
            for name in os.listdir(self._cache_path)  # noqa: PTH208 - fast
        )

    def flush(self) -> None:
        for old in Path(self._cache_path).glob(f"{glob.escape(self._base)}.*.nbc"):
            old.unlink(missing_ok=True)

    def _name(self, key: Any) -> str:
        return f"{self._base}.{self._digest_of_sources()}.{_digest(key)}.nbc"

    def _digest_of_sources(self) -> str:
        if not self._sources:
            versions = (self._version, llvmlite.__version__, config.BOUNDSCHECK, config.USING_SVML)
            self._sources = _digest((versions, sorted(_sources(self._function, set()))))
        return self._sources


class _Shipped(NamedTuple):
    """Kernels that came with slrig. archive : None if none fit."""

    archive: zipfile.ZipFile | None
    names: frozenset[str]

    def has(self, begin: str) -> bool:
        """True if the name of a kernel begins so."""
        return any(name.startswith(begin) for name in self.names)

    def load(self, name: str) -> Any:
        """Return the compiled code of this name; None if there is none, or it is damaged."""
        if self.archive is None or name not in self.names:
            return None
        try:
            return pickle.loads(self.archive.read(name))  # noqa: S301 - as trustworthy as the code next to it
        except (OSError, EOFError, zipfile.BadZipFile, zlib.error, pickle.UnpicklingError) as error:
            _log.warning("a compiled kernel of slrig's cannot be read; reinstall slrig", name=name, cause=str(error))
            return None


@cache
def _shipped() -> _Shipped:
    path = _SHIPPED / shipped_archive_name()
    try:
        archive = zipfile.ZipFile(path)
    except FileNotFoundError:
        return _Shipped(None, frozenset())
    except (OSError, zipfile.BadZipFile) as error:
        _log.warning("the compiled kernels of slrig cannot be read; reinstall slrig", path=str(path), cause=str(error))
        return _Shipped(None, frozenset())
    return _Shipped(archive, frozenset(archive.namelist()))


def _digest(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def _sources(function: Callable[..., Any], visited: set[Callable[..., Any]]) -> set[tuple[str, str]]:
    """Sources of a kernel and the parts that it calls: names and digests of their files, and the constants that they
    take from others.
    """
    visited.add(function)
    file = Path(function.__code__.co_filename)
    found = {(file.name, _digest_of_file(file))} if file.is_file() else set()
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            if value.py_func not in visited:
                found |= _sources(value.py_func, visited)
        elif isinstance(value, np.ndarray):
            found.add((name, _digest((value.dtype.str, value.shape, value.tobytes()))))
        elif isinstance(value, bool | int | float | complex | str | tuple):
            found.add((name, repr(value)))
    return found


def _names(code: CodeType) -> Iterator[str]:
    """Names that a function and those within it take from outside."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _digest_of_file(path: Path) -> str:
    stat = path.stat()
    return _digest_of_contents(path, stat.st_mtime_ns, stat.st_size)


@cache
def _digest_of_contents(path: Path, _time_ns: int, _bytes: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


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

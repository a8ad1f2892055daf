"""Kernels: kept between runs by many processes at once, shared out over the cores, beside other work."""

from __future__ import annotations

import errno
import importlib.util
import os
import platform
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding
import numba
import numpy as np
import pytest
from numba import config
from numba.core.errors import NumbaError

from slrig import kernels
from slrig.disk import prepare_kernel_cache
from slrig.kernels import (
    CPU_LEVELS,
    are_all_cached,
    best_cpu_level,
    in_bands,
    kernel,
    kernel_part,
    report_compilations,
    shipped_archive_name,
    why_compiled,
)

ROOT = Path(__file__).resolve().parents[2]
_ADDS = """
from slrig.kernels import kernel, kernel_part

@kernel_part
def more(value):
    return value + {added}

@kernel(in_every_scan=False)
def sums(values):
    if len(values) == 0:
        raise ValueError("nothing")
    total = values[0] * 0
    for i in range(len(values)):
        total += more(values[i])
    return total
"""


def loaded(path: Path) -> Any:
    """The module in a file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def made(folder: Path, *, added: int, name: str = "adding") -> Any:
    """The module of a kernel that sums values, each with `added` more, as its file says."""
    path = folder / f"{name}.py"
    path.write_text(_ADDS.format(added=added))
    # The file system may stamp two writes with one time.
    os.utime(path, ns=(added, added))
    return loaded(path)


def compiled_by(call: Callable[[], object]) -> list[str]:
    told: list[str] = []
    with report_compilations(told.append):
        call()
    return told


@kernel(in_every_scan=False)
def _square(first: int, last: int, values: Any, out: Any) -> int:
    for i in range(first, last):
        out[i] = values[i] * values[i]
    return last - first


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [0, 1, 5, 1000])
@pytest.mark.parametrize(("least", "most"), [(1, 10**9), (64, 10**9), (1, 60)])
def test_bands_cover_every_row_once(
    monkeypatch: pytest.MonkeyPatch, count: int, least: int, most: int, threads: int
) -> None:
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    values, out = np.arange(count, dtype=np.float64), np.full(count, np.nan)
    answers = in_bands(_square, count, values, out, rows_at_least=least, rows_at_most=most)
    assert sum(answers) == count
    assert all(rows >= min(least, count) for rows in answers[:-1])
    assert max(answers, default=0) <= most
    np.testing.assert_array_equal(out, values**2)


def test_an_error_of_a_kernel_in_a_band_reaches_the_caller() -> None:
    def failing(first: int, last: int) -> None:
        message = f"rows {first} to {last}"
        raise ValueError(message)

    with pytest.raises(ValueError, match="rows"):
        in_bands(failing, 1000)


def test_dividing_by_zero_is_infinite_as_in_numpy() -> None:
    @kernel(in_every_scan=False)
    def ratio(a: float, b: float) -> float:
        return a / b

    assert ratio(1.0, 0.0) == np.inf


def test_a_compiled_kernel_is_cached_and_a_changed_one_is_compiled_again(tmp_path: Path) -> None:
    values = np.array([1.0, 2.0])
    first = made(tmp_path, added=1)
    assert compiled_by(lambda: first.sums(values)) == ["sums", "more"]
    again = made(tmp_path, added=1)
    assert compiled_by(lambda: again.sums(values)) == []
    assert again.sums(values) == 5
    changed = made(tmp_path, added=10)
    assert compiled_by(lambda: changed.sums(values)) == ["sums", "more"]
    assert changed.sums(values) == 23


def test_nothing_is_prepared_ahead_once_every_kernel_is_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def is_cached(added: int) -> bool:
        monkeypatch.setattr(kernels, "_kernels", [(made(tmp_path, added=added).sums, True)])
        return are_all_cached()

    assert not is_cached(1)
    made(tmp_path, added=1).sums(np.arange(3.0))
    assert is_cached(1)
    # Its source changed: what lies there is of another kernel.
    assert not is_cached(2)
    monkeypatch.setattr(kernels, "_kernels", [(made(tmp_path, added=2).sums, False)])
    assert are_all_cached()


def test_a_kernel_is_compiled_again_if_only_a_part_in_another_file_changed(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(
        "from slrig.kernels import kernel\n\ndef of(more):\n    globals()['more'] = more\n\n"
        "@kernel(in_every_scan=False)\ndef sums(values):\n    return more(values[0])\n"
    )
    for added in (1, 10):
        part = made(tmp_path, added=added, name="part")
        caller = loaded(tmp_path / "caller.py")
        caller.of(part.more)
        assert caller.sums(np.array([1.0])) == 1 + added


def test_a_kernel_is_compiled_again_if_its_file_was_cut(tmp_path: Path) -> None:
    values = np.array([1.0, 2.0])
    made(tmp_path, added=1).sums(values)
    kept = [*tmp_path.rglob("adding.sums*.nbc")]
    assert len(kept) == 1
    kept[0].write_bytes(kept[0].read_bytes()[:100])
    again = made(tmp_path, added=1)
    assert compiled_by(lambda: again.sums(values)) == ["sums"]
    assert again.sums(values) == 5


def shipped(folder: Path, monkeypatch: pytest.MonkeyPatch, *, name: str | None = None) -> Path:
    """An archive of the kernels that a folder's cache holds, as a wheel has it; the cache is emptied."""
    archive = folder / (shipped_archive_name() if name is None else name)
    kept = [*folder.rglob("*.nbc")]
    with zipfile.ZipFile(archive, "w") as packed:
        for each in kept:
            packed.write(each, each.name)
            each.unlink()
    monkeypatch.setattr(kernels, "_SHIPPED", folder)
    kernels._shipped.cache_clear()
    return archive


@pytest.fixture
def shipping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a kernel that was compiled elsewhere, at another time, and came in a wheel."""
    (tmp_path / "built").mkdir()
    made(tmp_path / "built", added=1).sums(np.array([1.0, 2.0]))
    shipped(tmp_path / "built", monkeypatch)
    (tmp_path / "installed").mkdir()
    yield tmp_path / "installed"
    kernels._shipped.cache_clear()


def test_a_kernel_that_came_in_the_wheel_is_not_compiled(shipping: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.array([1.0, 2.0])
    installed = made(shipping, added=1)
    os.utime(shipping / "adding.py", ns=(99, 99))
    monkeypatch.setattr(kernels, "_kernels", [(installed.sums, True)])
    assert are_all_cached()
    assert kernels.kernels_not_cached() == []
    assert compiled_by(lambda: installed.sums(values)) == []
    assert installed.sums(values) == 5
    assert why_compiled() is None
    # Another signature, and another source, are not in there.
    assert compiled_by(lambda: installed.sums(values.astype(np.float32))) == ["sums", "more"]
    changed = made(shipping, added=10)
    assert compiled_by(lambda: changed.sums(values)) == ["sums", "more"]
    assert changed.sums(values) == 23


_COMPILE = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import wheel
wheel.compile_kernels(Path(), "x86-64-v2", Path())
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the level is one of x86-64")
def test_kernels_of_a_wheel_are_the_same_bytes_in_whatever_folder_and_order_they_were_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders = {"here": (np.float64, np.int64), "somewhere/else": (np.int64, np.float64)}
    compiling = []
    for name, kinds in orders.items():
        folder = tmp_path / name
        folder.mkdir(parents=True)
        adding = made(folder, added=1)
        # numba names the module in what it keeps only if it can be imported.
        monkeypatch.setitem(sys.modules, "adding", adding)
        for kind in kinds:
            adding.sums(np.array([1, 2], kind))
        search = {"PYTHONPATH": f"{folder}:{ROOT}", "PYTHONHASHSEED": "0", "NUMBA_CPU_FEATURES": ""}
        command = [sys.executable, "-c", _COMPILE, str(ROOT / "config" / "deploy")]
        compiling.append(subprocess.Popen(command, cwd=folder, env=os.environ | search))  # noqa: S603 - our own
    assert [each.wait(timeout=300) for each in compiling] == [0, 0]
    first, second = (next((tmp_path / name).glob("*.zip")) for name in orders)
    assert len(zipfile.ZipFile(first).namelist()) == 4
    assert first.read_bytes() == second.read_bytes()
    assert str(tmp_path).encode() not in b"".join(map(zipfile.ZipFile(first).read, zipfile.ZipFile(first).namelist()))


@pytest.mark.parametrize("kind", ["cut", "flipped", "none", "other versions"])
def test_a_kernel_is_compiled_where_what_came_in_the_wheel_does_not_fit(
    shipping: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    archive = shipping.parent / "built" / shipped_archive_name()
    whole = archive.read_bytes()
    if kind == "cut":
        archive.write_bytes(whole[:-100])
    elif kind == "flipped":
        # In every kernel, and not in the list at the end.
        flipped = range(100, len(whole) - 1000, 97)
        archive.write_bytes(bytes(each ^ 8 if at in flipped else each for at, each in enumerate(whole)))
    elif kind == "none":
        archive.unlink()
    else:
        monkeypatch.setattr(numba, "__version__", "0.1.0")
    kernels._shipped.cache_clear()
    values = np.array([1.0, 2.0])
    installed = made(shipping, added=1)
    assert compiled_by(lambda: installed.sums(values))[:1] == ["sums"]
    assert installed.sums(values) == 5
    if kind in {"none", "other versions"}:
        assert ("without compiled kernels" if kind == "none" else "numba-0.1.0") in (why_compiled() or "")


def test_a_constant_that_a_kernel_takes_from_elsewhere_is_part_of_its_key(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(
        "from slrig.kernels import kernel\n\ndef of(limit):\n    globals()['LIMIT'] = limit\n\n"
        "@kernel(in_every_scan=False)\ndef above(values):\n    return sum([LIMIT for each in values])\n"
    )
    for limit in (2.0, 3.0):
        caller = loaded(tmp_path / "caller.py")
        caller.of(limit)
        assert caller.above(np.zeros(2)) == 2 * limit


@pytest.mark.parametrize("level", [*CPU_LEVELS, None])
def test_the_level_of_a_processor_is_the_best_that_it_has_whole(
    monkeypatch: pytest.MonkeyPatch, level: str | None
) -> None:
    has = dict.fromkeys({"sse2", *(CPU_LEVELS[level] if level else {"ssse3"})}, True) | {"avx512f": False}
    monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", lambda: has)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    assert best_cpu_level() == level


def test_a_full_disk_fails_no_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    module = made(tmp_path, added=1)
    monkeypatch.setattr(module.sums._cache._cache_file, "_save_data", refuse)
    assert module.sums(np.array([1.0, 2.0])) == 5


_CALL = """
import sys, numpy as np
sys.path.insert(0, {folder!r})
import adding
sys.stdin.readline()
for kind in sys.argv[1:]:
    values = np.array([1, 2]).astype(kind)
    assert adding.sums(values) == 5, kind
"""


@pytest.mark.slow
def test_processes_that_compile_at_once_leave_each_signature_its_own_code(tmp_path: Path) -> None:
    """Numba issue 4807: two processes number their files alike, and the index names the other one's code."""
    made(tmp_path, added=1)
    kinds = ["f8", "f4", "i8", "i4", "i2", "u8", "u4", "u2"]
    call = [sys.executable, "-c", _CALL.format(folder=str(tmp_path))]
    orders = (kinds, kinds[::-1], kinds[4:] + kinds[:4])
    racing = [subprocess.Popen([*call, *order], stdin=subprocess.PIPE, text=True) for order in orders]  # noqa: S603 - our own
    for process in racing:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.close()
    assert [process.wait(timeout=300) for process in racing] == [0, 0, 0]
    # Whatever order their writes came in, a fresh process loads eight signatures and every one is right.
    assert len([*tmp_path.rglob("adding.sums*.nbc")]) == len(kinds)
    fresh = subprocess.run([*call, *kinds], input="go\n", text=True, timeout=300, check=False)  # noqa: S603 - our own
    assert fresh.returncode == 0


_MESHES_IN_3_S = """
import time
import numpy as np
from slrig.meshing.flips import optimise_edges
points = np.array([[0, 0, 0], [9, 0, 0], [0, 1, 0], [3, 1, 5]], dtype=np.float64)
faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
optimise_edges(points, faces)
end, count = time.monotonic() + 3, 0
while time.monotonic() < end:
    optimise_edges(points, faces)
    count += 1
print(count)
"""


@pytest.mark.realtime
def test_kernels_share_a_busy_machine() -> None:
    def meshes() -> int:
        call = [sys.executable, "-c", _MESHES_IN_3_S]
        run = subprocess.run(call, capture_output=True, timeout=120, check=True)  # noqa: S603 - our own
        return int(run.stdout)

    quiet = meshes()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        loaded = meshes()
    finally:
        for process in busy:
            process.kill()
            process.wait()
    # Half of each core would be 2. Where threads wait for one another by spinning it was 500.
    assert quiet / loaded < 10


class _Held(NamedTuple):
    values: Any
    factors: Any


@kernel_part(borrows=True)
def _product(held: Any, at: int) -> float:
    product: float = held.values[at] * held.factors[at]
    return product


@kernel_part(borrows=True)
def _makes_an_array(held: Any) -> Any:
    return np.zeros(len(held.values))


@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled")
def test_a_part_that_borrows_reads_the_arrays_of_a_tuple_and_makes_none() -> None:
    held = _Held(np.array([2.0, -1.0]), np.array([3.0, 4.0]))
    assert _product(held, 1) == -4.0
    with pytest.raises(NumbaError, match="array"):
        _makes_an_array(held)


def test_kernel_cache_moves_only_when_the_package_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(os, "access", lambda *_: True)
    prepare_kernel_cache(tmp_path / "cache")
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setattr(os, "access", lambda *_: False)
    prepare_kernel_cache(tmp_path / "cache")
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "cache")
    assert (tmp_path / "cache").is_dir()

"""Free memory goes back where a process holds much, and nowhere else."""

from __future__ import annotations

import mmap
import sys
from pathlib import Path

import pytest

from slrig import memory

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from Linux's /proc")


@LINUX
@pytest.mark.parametrize(
    ("much", "statm", "calls"), [(0, memory._STATM, [0]), (2**60, memory._STATM, []), (0, Path("absent"), [])]
)
def test_memory_goes_back_where_much_is_held(
    monkeypatch: pytest.MonkeyPatch, much: int, statm: Path, calls: list[int]
) -> None:
    called: list[int] = []
    monkeypatch.setattr(memory, "_MUCH_BYTES", much)
    monkeypatch.setattr(memory, "_STATM", statm)
    monkeypatch.setattr(memory, "_trim", lambda: called.append)
    memory.give_back()
    assert called == calls
    # A C library without the call is left alone.
    monkeypatch.setattr(memory, "_trim", lambda: None)
    memory.give_back()


@LINUX
def test_resident_memory_is_measured() -> None:
    asked = 2**26
    before = memory._resident_bytes()
    # From the system itself: an array may be given memory that earlier tests have freed, and that is resident already.
    with mmap.mmap(-1, asked, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as held:
        for page in range(0, asked, mmap.PAGESIZE):
            held[page] = 1
        assert memory._resident_bytes() - before == pytest.approx(asked, rel=0.1)

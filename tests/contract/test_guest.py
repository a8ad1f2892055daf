"""The guest itself ends in time. What it runs, `test_vivid` and its like look at."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.contract.guest.machine import GuestError, require_guest, run_in_guest


def command_lines() -> Iterator[bytes]:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        # Other programs end while we look.
        with suppress(OSError):
            yield path.read_bytes()


@pytest.mark.slow
def test_a_guest_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    require_guest()
    with pytest.raises(GuestError, match="did not finish in 3 s"):
        run_in_guest(["sleep", "1000"], folder=tmp_path / "guest", timeout_s=3)
    assert not [line for line in command_lines() if str(tmp_path).encode() in line]

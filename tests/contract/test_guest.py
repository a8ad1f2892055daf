"""The guest itself: it ends in time, and CI must have one. What it runs, `test_vivid` and its like look at."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.contract.guest.kernel import GuestUnavailableError
from tests.contract.guest.machine import GuestError, require_guest, run_in_guest


@pytest.mark.parametrize(
    ("in_ci", "fixable", "ends"),
    [(True, True, pytest.fail.Exception), (True, False, pytest.skip.Exception), (False, True, pytest.skip.Exception)],
)
def test_no_guest_is_skipped_but_not_in_ci(
    in_ci: bool, fixable: bool, ends: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lacking() -> None:
        raise GuestUnavailableError("there is no machine", fixable=fixable)

    monkeypatch.setenv("CI", "true" if in_ci else "")
    with pytest.raises(ends, match="there is no machine"):
        require_guest(lacking)


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

"""The guest itself: it runs a command on drivers of our choice, brings back what it wrote, and ends in time."""

from __future__ import annotations

import stat
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.contract.guest.initrd import archive
from tests.contract.guest.kernel import GuestUnavailableError
from tests.contract.guest.machine import FILES, GuestError, Module, require_guest, run_in_guest

SCRIPT = """
import os, pathlib, sys
files = pathlib.Path(sys.argv[1])
there = [name for name in ("uhid", "dri/card0", "kvm") if os.path.exists("/dev/" + name)]
(files / "devices").write_text(" ".join(there))
pathlib.Path(sys.argv[2]).write_text("written in the guest")
print("said", os.getcwd(), os.environ["WORD"])
sys.exit(7)
"""


def test_an_archive_is_as_the_kernel_wants_it() -> None:
    made = archive({"bin": (stat.S_IFDIR | 0o755, b""), "bin/a": (stat.S_IFREG | 0o644, b"12345")})
    magic, fields, name = made[:6], made[6:110], made[110:114]
    assert (magic, name) == (b"070701", b"bin\0")
    assert [int(fields[i : i + 8], 16) for i in range(0, 104, 8)] == [1, 0o40755, 0, 0, 1, 0, 0, 0, 0, 0, 0, 4, 0]
    assert made.count(b"070701") == 3
    assert len(made) % 4 == 0
    assert made.index(b"12345") % 4 == 0
    assert made.index(b"070701", 1) % 4 == 0
    assert b"TRAILER!!!\0" in made


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


@pytest.mark.slow
def test_a_command_runs_on_drivers_of_our_choice(tmp_path: Path) -> None:
    require_guest()
    elsewhere = tmp_path / "elsewhere"
    finished = run_in_guest(
        [sys.executable, "-c", SCRIPT, FILES, str(elsewhere)],
        folder=tmp_path / "guest",
        modules=[Module("uhid"), Module("virtio-gpu")],
        devices=["virtio-gpu-pci"],
        environment={"WORD": "two words"},
        timeout_s=120,
    )
    assert finished.exit_code == 7, finished.output
    assert finished.output == f"said {Path(__file__).parents[2]} two words\n"
    assert (finished.files / "devices").read_text() == "uhid dri/card0"
    assert not elsewhere.exists()


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


@pytest.mark.slow
def test_a_module_that_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    require_guest()
    with pytest.raises(LookupError, match="no module 'vivud'"):
        run_in_guest(["true"], folder=tmp_path / "guest", modules=[Module("vivud")])

"""Files that are whole or absent."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from slrig.bundle import storage
from slrig.bundle.storage import write_file
from slrig.errors import StorageError


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_file(path, b"first, and longer")
    write_file(path, b"second")
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("cause", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EIO])
def test_a_disk_that_refuses_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: int) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"before")

    def refuse(_: int) -> None:
        raise OSError(cause, os.strerror(cause))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(StorageError, match=r"mesh\.ply: the disk refused") as caught:
        write_file(path, b"after")
    assert os.strerror(cause) in str(caught.value)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interruption_leaves_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.bin", b"x")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"nowhere.*create the folder first"):
        write_file(tmp_path / "nowhere" / "a.bin", b"x")


def test_on_windows_no_folder_is_opened_and_files_are_synced_writable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[Path, int]] = []
    system_open = os.open

    def as_windows(path: Path, flags: int) -> int:
        assert not path.is_dir()
        opened.append((path, flags))
        return system_open(path, flags)

    monkeypatch.setattr(storage, "_WINDOWS", True)
    monkeypatch.setattr(os, "open", as_windows)
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    storage.sync_file(tmp_path / "mesh.ply")
    storage.sync_folder(tmp_path)
    assert opened == [(tmp_path / "mesh.ply", os.O_RDWR)]

"""Files that are whole or absent: written beside their place, brought to disk, and renamed."""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from pathlib import Path

from slrig.disk import staging_name, storage_errors


def natural_sort_key(path: Path) -> tuple[list[str | int], str]:
    """A key to sort by. Capitals count only where nothing else tells two paths apart.

    >>> [path.name for path in sorted(map(Path, ("Scan-2", "scan-10", "scan-1", "scan-2")), key=natural_sort_key)]
    ['scan-1', 'Scan-2', 'scan-2', 'scan-10']
    """
    parts = re.split(r"([0-9]+)", str(path))
    return [int(part) if place % 2 else part.casefold() for place, part in enumerate(parts)], str(path)


_WINDOWS = os.name == "nt"


def write_durably(path: Path, data: bytes | bytearray) -> None:
    """Write a new file and bring it to disk; for a folder that is itself renamed into place later.
    Raises OSError: the disk refused.
    """
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to disk. Windows opens no folder, and keeps a journal of its names."""
    if not _WINDOWS:
        _sync(folder, os.O_RDONLY)


def sync_file(file: Path) -> None:
    """Bring a file to disk. Windows does that only for who may write it."""
    _sync(file, os.O_RDWR if _WINDOWS else os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def json_bytes(data: object) -> bytes:
    """A JSON text as slrig writes it: a line for each value, and no number that is not finite."""
    return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode()


def sync_tree(folder: Path, *, but: str = "") -> None:
    """Make every file below `folder`, and every folder, durable. but : a folder in it that is so already, by name."""
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if Path(place, name) != folder / but]
        for file in (Path(place, name) for name in files):
            # What a link leads to is not ours.
            if not file.is_symlink():
                sync_file(file)
        sync_folder(Path(place))


def write_file(path: Path, data: bytes | bytearray, *, durable: bool = True) -> None:
    """Replace the file `path` by `data`, whole or not at all.
    Raises StorageError: the disk refused; what was there before is still there.

    durable : False in a folder that `sync_tree` brings to disk before anybody relies on it.
    """
    staging = staging_name(path)
    with storage_errors(path):
        try:
            if durable:
                write_durably(staging, data)
            else:
                staging.write_bytes(data)
            staging.replace(path)
            if durable:
                sync_folder(path.parent)
        except BaseException:
            with suppress(OSError):
                staging.unlink(missing_ok=True)
            raise

"""Files that are complete or absent: written under another name, flushed to disk, and renamed."""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from pathlib import Path

from slrig.disk import staging_name, storage_errors

_WINDOWS = os.name == "nt"


def natural_sort_key(path: Path) -> tuple[list[str | int], str]:
    """Return a key that sorts numbers by value, and capitals only if two paths are otherwise equal.

    >>> [path.name for path in sorted(map(Path, ("Scan-2", "scan-10", "scan-1", "scan-2")), key=natural_sort_key)]
    ['scan-1', 'Scan-2', 'scan-2', 'scan-10']
    """
    parts = re.split(r"([0-9]+)", str(path))
    return [int(part) if number % 2 else part.casefold() for number, part in enumerate(parts)], str(path)


def write_durably(path: Path, data: bytes | bytearray) -> None:
    """Write a new file and flush it to disk, for a folder that is itself renamed later. Raises OSError."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to disk. Windows cannot open folders, and keeps a journal of their names."""
    if not _WINDOWS:
        _sync(folder, os.O_RDONLY)


def sync_file(file: Path) -> None:
    """Flush a file to disk. Windows needs write access for that."""
    _sync(file, os.O_RDWR if _WINDOWS else os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def json_bytes(data: object) -> bytes:
    """Return JSON text with a line for each value; numbers that are not finite are refused."""
    return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode()


def sync_tree(folder: Path, *, except_folder: str = "") -> None:
    """Flush every file and folder below `folder` to disk. except_folder : name of a folder in it that is flushed
    already.
    """
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if Path(place, name) != folder / except_folder]
        for file in (Path(place, name) for name in files):
            # The target of a link is not part of the folder.
            if not file.is_symlink():
                sync_file(file)
        sync_folder(Path(place))


def write_file(path: Path, data: bytes | bytearray, *, durable: bool = True) -> None:
    """Replace the file `path` by `data`, completely or not at all.
    Raises StorageError: the disk refused; the old file is unchanged. durable : False in a folder that `sync_tree`
    flushes later.
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

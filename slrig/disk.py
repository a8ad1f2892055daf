"""Errors of a disk as messages, names of files that are being written, and where compiled kernels are kept."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slrig.errors import StorageError

_REMEDIES = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "free some space there",
    errno.EACCES: "allow writing there, or choose another folder",
    errno.EPERM: "allow writing there, or choose another folder",
    errno.EROFS: "the disk is mounted read-only; choose another folder",
    errno.ENOENT: "create the folder first",
    errno.ENOTDIR: "a part of the path is a file; choose another folder",
}


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Convert an error of the disk about `path` to a StorageError."""
    try:
        yield
    except OSError as cause:
        remedy = _REMEDIES.get(cause.errno or 0, "free some space or choose another folder")
        message = f"{path}: the disk refused: {cause.strerror or cause}; nothing of it was kept: {remedy}"
        raise StorageError(message) from cause


def staging_name(path: Path) -> Path:
    """Return a unique hidden name in the folder of `path`."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")


def prepare_kernel_cache(folder: Path) -> None:
    """Set numba's folder of compiled kernels when slrig's own folder is read-only; call before numba is loaded.

    numba itself refuses to load a cached kernel when it finds no place to write, as under systemd or in a container.
    """
    package = Path(__file__).resolve().parent
    if "NUMBA_CACHE_DIR" not in os.environ and not os.access(package, os.W_OK):
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["NUMBA_CACHE_DIR"] = str(folder)

"""Errors of a disk in words, and names of files that are not yet whole."""

from __future__ import annotations

import errno
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
def refusals_of(path: Path) -> Iterator[None]:
    """Turn what the disk says about `path` into a StorageError."""
    try:
        yield
    except OSError as cause:
        remedy = _REMEDIES.get(cause.errno or 0, "free some space or choose another folder")
        message = f"{path}: the disk refused: {cause.strerror or cause}; nothing of it was kept: {remedy}"
        raise StorageError(message) from cause


def staging_name(path: Path) -> Path:
    """A hidden sibling of `path` that nobody else uses."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")

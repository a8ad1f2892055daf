"""Arrays of NumPy's files. What a file declares is held against what it has before memory is taken for it.

`numpy.load` takes the memory that a header asks for, and unpacks a member of an archive whole.
"""

from __future__ import annotations

import io
import math
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

_MAPPED_BYTES = 2**22
"""Larger arrays stay on disk, and are read where they are used."""

_MAX_ITEM_BYTES = 2**16


class HoldsObjectsError(ValueError):
    """The arrays are of Python objects, which can run code when they are loaded."""


def read_arrays(path: Path, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file by their names, or that of an .npy file by the name "".

    They may be read-only, and lie on disk. Other files of an archive, and arrays of objects, are left out.
    max_bytes : of all arrays.

    Raises
    ------
    HoldsObjectsError
        There are arrays of objects and no others.
    ValueError
        The file is damaged, is of another kind, declares more than it has, or has more than `max_bytes`.
    OSError
        The file cannot be read, or the disk is full.
    """
    try:
        with path.open("rb") as file:
            is_archive = file.read(4) == b"PK\3\4"
            file.seek(0)
            arrays = _members(file, max_bytes) if is_archive else {"": _array(file, max_bytes)}
    except OSError:
        raise
    except Exception as cause:
        # The readers of NumPy and of archives raise many kinds for damaged files.
        raise ValueError(str(cause) or type(cause).__name__) from cause
    found = {name: array for name, array in arrays.items() if array is not None}
    if arrays and not found:
        raise HoldsObjectsError("Python objects, which can run code")
    return found


def _members(file: IO[bytes], max_bytes: int) -> dict[str, NDArray[Any] | None]:
    arrays: dict[str, NDArray[Any] | None] = {}
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        total_bytes = sum(entry.file_size for entry in entries)
        if total_bytes > max_bytes:
            raise ValueError(f"{total_bytes} bytes of arrays; at most {max_bytes} bytes are read")
        for entry in entries:
            if not entry.filename.endswith(".npy"):
                continue
            with archive.open(entry) as packed, _spool(entry.file_size) as member:
                # In pieces: `read` unpacks all that is there, whatever the archive says of it.
                shutil.copyfileobj(packed, member)
                member.seek(0)
                arrays[entry.filename.removesuffix(".npy")] = _array(member, max_bytes)
    return arrays


def _spool(size_bytes: int) -> IO[bytes]:
    return tempfile.TemporaryFile() if size_bytes > _MAPPED_BYTES else io.BytesIO()


def _array(file: IO[bytes], max_bytes: int) -> NDArray[Any] | None:
    """Return an array; None if it is of objects."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(file)
    if dtype.hasobject:
        return None
    first = file.tell()
    there_bytes = file.seek(0, io.SEEK_END) - first
    wanted_bytes = math.prod(shape) * dtype.itemsize
    is_possible = 1 <= dtype.itemsize <= _MAX_ITEM_BYTES and min(shape, default=0) >= 0
    if not is_possible or wanted_bytes > min(there_bytes, max_bytes):
        side = " x ".join(map(str, shape))
        raise ValueError(f"an array of {side} {dtype}, and {there_bytes} bytes; at most {max_bytes} bytes are read")
    order: Literal["F", "C"] = "F" if is_fortran else "C"
    if wanted_bytes > _MAPPED_BYTES and not isinstance(file, io.BytesIO):
        return np.memmap(file, dtype, "r", first, shape, order)
    file.seek(first)
    return np.frombuffer(file.read(wanted_bytes), dtype, math.prod(shape)).reshape(shape, order=order)

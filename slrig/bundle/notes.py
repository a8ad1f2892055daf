"""notes.json: what a person should know of how a bundle was captured, in sentences. Absent where there is nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slrig.bundle.faults import read_json, read_text
from slrig.bundle.storage import json_bytes, write_file
from slrig.errors import BundleError

FILE = "notes.json"
MOST_BYTES = 2**20


def write_notes(folder: Path, notes: Sequence[str]) -> None:
    """Put notes beside the frames, if there are any. Raises StorageError."""
    if notes:
        write_file(folder / FILE, json_bytes(list(notes)))


def read_notes(folder: Path) -> tuple[str, ...]:
    """The notes of a bundle. Raises BundleError: the file cannot be read, or is no list of sentences."""
    path = folder / FILE
    if not path.exists():
        return ()
    found = read_json(read_text(path, MOST_BYTES, BundleError), path, BundleError)
    if not isinstance(found, list) or not all(isinstance(each, str) for each in found):
        message = f"{path}: expected a JSON list of strings, found something else; remove the file, or copy it again"
        raise BundleError(message)
    return tuple(found)

"""health.json: what was known of the calibration's health when a bundle was captured. Absent where nothing was."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slrig.bundle.faults import read_json, read_text
from slrig.bundle.storage import json_bytes, write_file
from slrig.errors import BundleError

FILE = "health.json"
MOST_BYTES = 2**20


def write_health(folder: Path, stamp: Mapping[str, Any]) -> None:
    """Put a stamp beside the frames. Raises StorageError."""
    write_file(folder / FILE, json_bytes(stamp))


def read_health(folder: Path) -> dict[str, Any] | None:
    """The stamp of a bundle, None where it has none.
    Raises BundleError: the file cannot be read, or is no JSON object.
    """
    path = folder / FILE
    if not path.exists():
        return None
    found = read_json(read_text(path, MOST_BYTES, BundleError), path, BundleError)
    if not isinstance(found, dict):
        message = f"{path}: expected a JSON object, found {type(found).__name__}; remove the file, or copy it again"
        raise BundleError(message)
    return found

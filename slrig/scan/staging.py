"""A folder of results that appears whole or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slrig.bundle.storage import refusals_of, staging_name, sync_folder
from slrig.errors import InvalidInputError

REPORT = "report.json"
REPORT_FORMAT = "slrig-report"


@contextmanager
def staged_folder(output: Path) -> Iterator[Path]:
    """Yield a folder to write into; on success it becomes `output` by one rename, on error it is removed.

    Raises
    ------
    InvalidInputError
        `output` is a file, or a folder that holds something else than results of an earlier run.
    StorageError
        The disk refused.
    """
    output = output.absolute()
    _require_replaceable(output)
    staging = staging_name(output)
    with refusals_of(output):
        staging.mkdir(parents=True)
    try:
        yield staging
        with refusals_of(output):
            sync_folder(staging)
            _put_in_place(staging, output)
            sync_folder(output.parent)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _put_in_place(staging: Path, output: Path) -> None:
    if not output.exists():
        staging.rename(output)
        return
    old = staging_name(output)
    output.rename(old)
    try:
        staging.rename(output)
    except OSError:
        old.rename(output)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _require_replaceable(output: Path) -> None:
    if not output.exists():
        return
    if output.is_dir() and (not any(output.iterdir()) or _is_report(output / REPORT)):
        return
    what = "a folder with other files in it" if output.is_dir() else "a file"
    message = f"{output}: results go into a folder of their own, and this is {what}; name a new folder"
    raise InvalidInputError(message)


def _is_report(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_bytes()).get("format") == REPORT_FORMAT)
    except (OSError, ValueError, AttributeError):
        return False

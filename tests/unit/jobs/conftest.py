"""A data folder, and the record of its scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[DataFolder]:
    folder = DataFolder(tmp_path / "data")
    yield folder
    folder.release()


@pytest.fixture
def store(folder: DataFolder) -> Iterator[JobStore]:
    store = JobStore(Database(folder.database), JobKind.SCAN)
    yield store
    store.database.close()

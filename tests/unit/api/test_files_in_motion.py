"""Files of a scan that can be fetched stay so while the scan is put in its place, which takes as long as the disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import pytest

from slrig.api.artefacts import _made_so_far, ready_files
from slrig.jobs import data_folder
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.records import JobState


def test_a_file_that_is_there_stays_there_while_its_scan_is_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, scan_id = DataFolder(tmp_path / "data"), uuid4()
    record: Any = SimpleNamespace(id=scan_id, state=JobState.COMPUTING)
    folder.stage(scan_id)
    (folder.staging(scan_id) / "bundle").mkdir()
    (folder.stage_result(scan_id) / "report.json").write_bytes(b"{}")
    seen = []

    def look(*_: object, **__: object) -> None:
        seen.append((_made_so_far(folder, record, "report.json"), set(ready_files(folder, record))))

    look()
    monkeypatch.setattr(data_folder, "sync_tree", look)
    folder.commit(scan_id)
    look()
    assert seen == 3 * [(b"{}", {"report.json"})]
    folder.release()

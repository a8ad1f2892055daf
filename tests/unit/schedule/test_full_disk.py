"""A run whose end the disk refuses: the schedule goes on, and the run is on record as over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slrig.errors import StorageError
from slrig.schedule.records import RunState
from tests.unit.schedule.desk import Desk


def test_run_whose_end_the_disk_refused_is_over_at_the_next_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path / "slrig.sqlite")
    schedule = desk.daily()

    def refuse(*_: Any, **__: Any) -> None:
        message = "the disk is full"
        raise StorageError(message)

    with monkeypatch.context() as full:
        full.setattr(desk.store, "finish", refuse)
        desk.look(hours=1)
    assert desk.run(schedule).state is RunState.RUNNING
    desk.look(seconds=10)
    assert desk.rows(schedule) == [("23 06:00", RunState.INTERRUPTED, 1)]
    assert desk.run(schedule).reason == "it ended, and how could not be put on record"
    assert [state for _, state in desk.told] == [RunState.INTERRUPTED]
    desk.look(days=1)
    assert desk.rows(schedule)[-1] == ("24 06:00", RunState.SUCCEEDED, 1)

"""The tables of the schedule."""

from __future__ import annotations

from pathlib import Path

from tests.unit.schedule.desk import Desk


def test_a_schedule_comes_back_as_it_was_recorded(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "slrig.sqlite")
    made = desk.daily(label="nightly", options={"board": "wall"}, grace_s=60.0, enabled=False)
    assert desk.store.get(made.id) == made
    assert desk.store.all() == [made]
    desk.store.database.close()

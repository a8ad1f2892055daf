"""The tables of the schedule."""

from __future__ import annotations

from pathlib import Path

from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine

from slrig.scan.store import ScanStore
from slrig.schedule.store import ScheduleStore
from slrig.schedule.tables import Base
from tests.unit.schedule.desk import Desk


def test_migrations_give_the_tables_that_the_code_uses(tmp_path: Path) -> None:
    database = tmp_path / "slrig.sqlite"
    ScheduleStore(database).close()
    with create_engine(f"sqlite:///{database}").connect() as connection:
        context = MigrationContext.configure(
            connection,
            opts={"include_name": lambda name, kind, _: kind != "table" or name in Base.metadata.tables},
        )
        assert compare_metadata(context, Base.metadata) == []


def test_scans_and_schedules_share_one_file(tmp_path: Path) -> None:
    database = tmp_path / "slrig.sqlite"
    for _ in range(2):
        scans, schedules = ScanStore(database), ScheduleStore(database)
        assert not scans.page(before=None, limit=10)
        assert not schedules.all()
        scans.close()
        schedules.close()


def test_a_schedule_comes_back_as_it_was_recorded(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "slrig.sqlite")
    made = desk.daily(label="nightly", options={"board": "wall"}, grace_s=60.0, enabled=False)
    assert desk.store.get(made.id) == made
    assert desk.store.all() == [made]
    desk.store.close()

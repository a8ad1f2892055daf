"""The history of health in the service's database."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from slrig.calibration.health.verdict import HealthState
from slrig.schedule.store import ScheduleStore
from slrig.verify.migrations import VERSION_TABLE
from slrig.verify.store import HealthStore
from slrig.verify.tables import Base
from tests.unit.verify.health_bench import a_look, hours


def test_what_was_verified_comes_back_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "slrig.sqlite"
    store = HealthStore(path)
    first = store.add(a_look(), calibration="one", at=hours(0))
    store.close()
    again = HealthStore(path)
    found = again.latest()
    assert found is not None
    assert found.document() == first.document()
    assert found.look.document() == a_look().document()
    again.close()


def test_history_is_newest_first_limited_and_since(tmp_path: Path) -> None:
    store = HealthStore(tmp_path / "slrig.sqlite")
    for hour in range(6):
        store.add(a_look(), calibration="one" if hour < 4 else "two", at=hours(hour))
    assert [record.at for record in store.history(limit=2)] == [hours(5), hours(4)]
    assert [record.at for record in store.history(since=hours(3))] == [hours(5), hours(4), hours(3)]
    assert [record.at for record in store.since_calibration("one")] == [hours(hour) for hour in range(4)]
    store.close()


def test_a_look_is_judged_with_those_before_it_since_the_calibration(tmp_path: Path) -> None:
    store = HealthStore(tmp_path / "slrig.sqlite")
    for hour in range(3):
        store.add(a_look(), calibration="one", at=hours(hour))
    # One look that is bad by a little is no alarm; the same one after a calibration without others is.
    assert store.add(a_look(1.8, evidence=10), calibration="one", at=hours(4)).health.state is HealthState.GOOD
    assert store.add(a_look(1.8, evidence=10), calibration="one", at=hours(5)).health.state is HealthState.WATCH
    assert store.health_of("one").state is HealthState.WATCH
    assert store.health_of("two").state is HealthState.UNKNOWN
    assert store.add(a_look(1.8, evidence=10), calibration="two", at=hours(6)).health.state is HealthState.WATCH
    knocked = store.add(a_look(12, evidence=4000), calibration="one", at=hours(7)).health
    assert knocked.state is HealthState.STALE
    assert "camera 'left' turned by 0.050" in " ".join(knocked.reasons)
    store.close()


def test_it_shares_the_file_with_other_parts_of_the_service(tmp_path: Path) -> None:
    path = tmp_path / "slrig.sqlite"
    schedules, store = ScheduleStore(path), HealthStore(path)
    store.add(a_look(), calibration="one", at=hours(0))
    assert schedules.all() == []
    assert store.latest() is not None
    schedules.close()
    store.close()


def test_the_migrations_make_the_tables(tmp_path: Path) -> None:
    path = tmp_path / "slrig.sqlite"
    HealthStore(path).close()
    engine = sa.create_engine(f"sqlite:///{path}")
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"version_table": VERSION_TABLE})
        assert compare_metadata(context, Base.metadata) == []
        assert context.get_current_revision() == "0001"
    engine.dispose()

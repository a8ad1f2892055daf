"""The history of health in the service's database."""

from __future__ import annotations

from pathlib import Path

from slrig.calibration.health.verdict import HealthState
from slrig.jobs.database import Database
from slrig.verify.store import HealthStore
from tests.unit.verify.health_bench import a_verification, hours


def test_what_was_verified_comes_back_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "slrig.sqlite"
    store = HealthStore(Database(path))
    first = store.add(a_verification(), calibration="one", at=hours(0))
    store.database.close()
    again = HealthStore(Database(path))
    found = again.latest()
    assert found is not None
    assert found.document() == first.document()
    assert found.found.document() == a_verification().document()
    again.database.close()


def test_history_is_newest_first_limited_and_since(tmp_path: Path) -> None:
    store = HealthStore(Database(tmp_path / "slrig.sqlite"))
    for hour in range(6):
        store.add(a_verification(), calibration="one" if hour < 4 else "two", at=hours(hour))
    assert [record.at for record in store.history(limit=2)] == [hours(5), hours(4)]
    assert [record.at for record in store.history(since=hours(3))] == [hours(5), hours(4), hours(3)]
    assert [record.at for record in store.since_calibration("one")] == [hours(hour) for hour in range(4)]
    store.database.close()


def test_a_look_is_judged_with_those_before_it_since_the_calibration(tmp_path: Path) -> None:
    store = HealthStore(Database(tmp_path / "slrig.sqlite"))
    for hour in range(3):
        store.add(a_verification(), calibration="one", at=hours(hour))
    # One look that is bad by a little is no alarm; the same one after a calibration without others is.
    assert store.add(a_verification(1.8, evidence=10), calibration="one", at=hours(4)).health.state is HealthState.GOOD
    assert store.add(a_verification(1.8, evidence=10), calibration="one", at=hours(5)).health.state is HealthState.WATCH
    assert store.health_of("one").state is HealthState.WATCH
    assert store.health_of("two").state is HealthState.UNKNOWN
    assert store.add(a_verification(1.8, evidence=10), calibration="two", at=hours(6)).health.state is HealthState.WATCH
    knocked = store.add(a_verification(12, evidence=4000), calibration="one", at=hours(7)).health
    assert knocked.state is HealthState.STALE
    assert "camera 'left' turned by 0.050" in " ".join(knocked.reasons)
    store.database.close()

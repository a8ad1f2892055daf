"""The turntable on disk: its axis, what models make of it, its planes, and a file that is damaged."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle.options import AxisSource, TurntableRecord, read_turntable
from slrig.errors import ConfigError, StorageError
from slrig.model import MeasuredAxis, PlaneKind, TurntablePlane
from slrig.model_jobs.turntable import TurntableState, TurntableStore, state_of, turntable_svg

NOON = datetime(2026, 11, 26, 12, tzinfo=UTC)
PLATE = TurntablePlane(PlaneKind.PLATE, np.array([0.0, 40.0, 500.0]), np.array([0.0, -0.8, -0.6]), 0.03, 80.0, 1.2)


def axis(offset_mm: float = 0.0, sigma_mm: float = 0.02) -> MeasuredAxis:
    """An upright axis, known across."""
    covariance = np.diag([sigma_mm**2, 0.0, sigma_mm**2, 1e-8, 0.0, 1e-8])
    return MeasuredAxis(np.array([offset_mm, 0.0, 500.0]), np.array([0.0, -1.0, 0.0]), covariance)


@pytest.fixture
def turntable(tmp_path: Path) -> TurntableStore:
    return TurntableStore(tmp_path / "turntable")


def test_models_improve_what_a_board_began(turntable: TurntableStore) -> None:
    assert state_of(turntable.record(), None)[0] is TurntableState.UNKNOWN
    assert turntable.note(axis(), of="before any board") is None
    turntable.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    for number in range(1, 6):
        turntable.note(axis(0.03, 0.01), of=f"model {number}", at=NOON + timedelta(hours=number))
    record = turntable.record()
    assert record.axis is not None
    assert 0.02 < record.axis.point_mm[0] < 0.03
    assert record.axis.point_sigma_mm < 0.008
    assert [each.source for each in record.history] == ["board"] + 5 * ["model"]
    assert record.history[1].moved_mm == pytest.approx(0.03)
    assert state_of(record, None) == (TurntableState.KNOWN, "")


def test_moved_stage_is_reported_and_its_axis_kept(turntable: TurntableStore) -> None:
    turntable.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    turntable.put_planes([PLATE])
    found = turntable.note(axis(0.7, 0.01), of="m", at=NOON + timedelta(hours=1))
    assert found is not None
    assert found.moved_mm == pytest.approx(0.7)
    record = turntable.record()
    assert record.axis is not None
    assert record.axis.point_mm[0] == 0.0
    assert record.planes[0].margin_mm == 1.2
    state, remedy = state_of(record, None)
    assert state is TurntableState.MOVED
    assert "model m turned about an axis that is 0.700 mm" in remedy
    assert "not taken" in turntable_svg(record.history)
    turntable.put_axis(axis(0.7), source=AxisSource.BOARD, of="again", at=NOON + timedelta(hours=2))
    assert state_of(turntable.record(), None)[0] is TurntableState.KNOWN


def test_what_is_written_is_read_again(turntable: TurntableStore, tmp_path: Path) -> None:
    turntable.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    record = turntable.put_planes([PLATE])
    again = read_turntable(tmp_path / "turntable" / "turntable.json")
    assert again.axis is not None
    assert record.axis is not None
    assert np.array_equal(again.axis.covariance, record.axis.covariance)
    assert np.allclose(again.planes[0].normal, PLATE.normal)
    assert again.history == record.history
    path = tmp_path / "turntable" / "turntable.json"
    path.write_text(path.read_text().replace("0.0004", "-0.0004", 1))
    with pytest.raises(ConfigError, match="symmetric matrix without a negative variance"):
        read_turntable(path)
    turntable.delete()
    turntable.delete()
    assert turntable.record() == TurntableRecord()


@pytest.mark.parametrize("damaged", [b"", b'{"format": "slrig-poses", "version": 1}', b"\xff"])
def test_a_damaged_file_is_refused_and_left_as_it_is(turntable: TurntableStore, tmp_path: Path, damaged: bytes) -> None:
    turntable.put_planes([PLATE])
    path = tmp_path / "turntable" / "turntable.json"
    path.write_bytes(damaged)
    for asked in (
        turntable.axis,
        lambda: turntable.put_planes([PLATE]),
        lambda: turntable.note(axis(), of="m"),
        lambda: turntable.replace(TurntableRecord()),
    ):
        with pytest.raises(StorageError, match=r"damaged, and is left as it is(.|\n)*DELETE /rig/turntable"):
            asked()
    assert path.read_bytes() == damaged
    turntable.delete()
    turntable.put_planes([PLATE])

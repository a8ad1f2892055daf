"""The stage on disk: its axis, what models make of it, its planes, and a file that is damaged."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle.options import AxisSource, StageRecord, read_stage
from slrig.combine.stage import StageState, StageStore, state_of
from slrig.combine.stage_plot import stage_svg
from slrig.errors import ConfigError, StorageError
from slrig.model import MeasuredAxis, PlaneKind, StagePlane

NOON = datetime(2026, 11, 26, 12, tzinfo=UTC)
PLATE = StagePlane(PlaneKind.PLATE, np.array([0.0, 40.0, 500.0]), np.array([0.0, -0.8, -0.6]), 0.03, 80.0, 1.2)


def axis(offset_mm: float = 0.0, sigma_mm: float = 0.02) -> MeasuredAxis:
    """An upright axis, known across."""
    covariance = np.diag([sigma_mm**2, 0.0, sigma_mm**2, 1e-8, 0.0, 1e-8])
    return MeasuredAxis(np.array([offset_mm, 0.0, 500.0]), np.array([0.0, -1.0, 0.0]), covariance)


@pytest.fixture
def stage(tmp_path: Path) -> StageStore:
    return StageStore(tmp_path / "stage")


def test_models_improve_what_a_board_began(stage: StageStore) -> None:
    assert state_of(stage.record())[0] is StageState.UNKNOWN
    assert stage.note(axis(), of="before any board") is None
    stage.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    for number in range(1, 6):
        stage.note(axis(0.03, 0.01), of=f"model {number}", at=NOON + timedelta(hours=number))
    record = stage.record()
    assert record.axis is not None
    assert 0.02 < record.axis.point_mm[0] < 0.03
    assert record.axis.point_sigma_mm < 0.008
    assert [each.source for each in record.history] == ["board"] + 5 * ["model"]
    assert record.history[1].moved_mm == pytest.approx(0.03)
    assert state_of(record) == (StageState.KNOWN, "")


def test_moved_stage_is_reported_and_its_axis_kept(stage: StageStore) -> None:
    stage.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    stage.put_planes([PLATE])
    found = stage.note(axis(0.7, 0.01), of="m", at=NOON + timedelta(hours=1))
    assert found is not None
    assert found.moved_mm == pytest.approx(0.7)
    record = stage.record()
    assert record.axis is not None
    assert record.axis.point_mm[0] == 0.0
    assert record.planes[0].margin_mm == 1.2
    state, remedy = state_of(record)
    assert state is StageState.MOVED
    assert "model m turned about an axis that is 0.700 mm" in remedy
    assert "not taken" in stage_svg(record.history)
    stage.put_axis(axis(0.7), source=AxisSource.BOARD, of="again", at=NOON + timedelta(hours=2))
    assert state_of(stage.record())[0] is StageState.KNOWN


def test_what_is_written_is_read_again(stage: StageStore, tmp_path: Path) -> None:
    stage.put_axis(axis(), source=AxisSource.BOARD, of="session", at=NOON)
    record = stage.put_planes([PLATE])
    again = read_stage(tmp_path / "stage" / "stage.json")
    assert again.axis is not None
    assert record.axis is not None
    assert np.array_equal(again.axis.covariance, record.axis.covariance)
    assert np.allclose(again.planes[0].normal, PLATE.normal)
    assert again.history == record.history
    path = tmp_path / "stage" / "stage.json"
    path.write_text(path.read_text().replace("0.0004", "-0.0004", 1))
    with pytest.raises(ConfigError, match="symmetric matrix without a negative variance"):
        read_stage(path)
    stage.delete()
    stage.delete()
    assert stage.record() == StageRecord()


@pytest.mark.parametrize("damaged", [b"", b'{"format": "slrig-poses", "version": 1}', b"\xff"])
def test_a_damaged_file_is_refused_and_left_as_it_is(stage: StageStore, tmp_path: Path, damaged: bytes) -> None:
    stage.put_planes([PLATE])
    path = tmp_path / "stage" / "stage.json"
    path.write_bytes(damaged)
    for asked in (
        stage.axis,
        lambda: stage.put_planes([PLATE]),
        lambda: stage.note(axis(), of="m"),
        lambda: stage.replace(StageRecord()),
    ):
        with pytest.raises(StorageError, match=r"damaged, and is left as it is(.|\n)*DELETE /rig/stage"):
            asked()
    assert path.read_bytes() == damaged
    stage.delete()
    stage.put_planes([PLATE])

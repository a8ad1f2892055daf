"""A table whose angles keep their zero through a kill, and say when they cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.devices import AnyAngle
from slrig.errors import DeviceError, StorageError, UnsupportedByDeviceError
from slrig.model import StageAxis
from slrig.rig.turn_count import FROM_THE_START, CountedTurntable


class Motor:
    """A table that outlives its openings. own_deg : its own count; at_deg : where it stands in the world."""

    def __init__(self) -> None:
        self.own_deg, self.at_deg = 12.0, 0.0
        self.fails = False


class Table(AnyAngle):
    """One opening of it."""

    def __init__(self, motor: Motor, *, homed: bool = False) -> None:
        super().__init__(4)
        self._motor = motor
        self._opened_deg = motor.own_deg
        self._homed = homed

    @property
    def axis(self) -> StageAxis | None:
        return None

    @property
    def opened_at_deg(self) -> float | None:
        return None if self._homed else self._opened_deg

    def turn(self, angle_deg: float) -> None:
        moved = self._opened_deg + angle_deg - self._motor.own_deg
        if self._motor.fails:
            self._motor.own_deg, self._motor.at_deg = self._motor.own_deg + moved / 2, self._motor.at_deg + moved / 2
            message = "stuck"
            raise DeviceError(message)
        self._motor.own_deg, self._motor.at_deg = self._motor.own_deg + moved, self._motor.at_deg + moved

    def close(self) -> None:
        return


@pytest.fixture
def motor() -> Motor:
    return Motor()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "stage" / "table.json"


def test_angles_go_on_where_the_table_kept_its_place(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    second = CountedTurntable(Table(motor), path)
    assert second.count == first.count != FROM_THE_START
    second.turn(135.0)
    assert motor.at_deg == pytest.approx(135.0)
    third = CountedTurntable(Table(motor), path)
    third.move(2)
    assert third.count == first.count
    assert motor.at_deg == pytest.approx(180.0)
    with pytest.raises(UnsupportedByDeviceError, match="pose 4"):
        third.move(4)


def test_a_table_that_restarted_or_was_moved_counts_anew(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    motor.own_deg = 0.0
    second = CountedTurntable(Table(motor), path)
    assert second.count != first.count
    second.turn(45.0)
    assert motor.at_deg == pytest.approx(135.0)


def test_a_turn_that_did_not_end_leaves_no_count_to_go_on_with(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    motor.fails = True
    with pytest.raises(DeviceError, match="stuck"):
        first.turn(90.0)
    motor.fails = False
    assert CountedTurntable(Table(motor), path).count != first.count


@pytest.mark.parametrize("what", ["{", '{"at_deg": 3}', "[]"])
def test_a_file_that_is_damaged_is_not_believed(motor: Motor, path: Path, what: str) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    path.write_text(what)
    assert CountedTurntable(Table(motor), path).count != first.count


def test_a_disk_that_refuses_turns_nothing(motor: Motor, path: Path) -> None:
    path.parent.write_text("a file in the folder's place")
    with pytest.raises(StorageError):
        CountedTurntable(Table(motor), path).turn(90.0)
    assert motor.at_deg == 0.0


def test_a_table_that_each_opening_brings_to_one_place_has_one_count(motor: Motor, path: Path) -> None:
    table = CountedTurntable(Table(motor, homed=True), path)
    table.turn(30.0)
    assert (table.count, path.exists()) == (FROM_THE_START, False)
    assert CountedTurntable(Table(motor, homed=True), path).count == FROM_THE_START

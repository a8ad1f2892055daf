"""Every turntable by one suite: the rendered one, and those on serial lines before stand-ins for their controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead, open_simulated_head
from slrig.conformance import CHECKS, CheckOutcome, ConformanceRun
from slrig.devices import Rig, Turntable
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from tests.contract.benches import PLATE, beamer, eyes
from tests.unit.conformance.model_rig import Maker, sequence
from tests.unit.drivers.serial_turntable.controllers import GrblBoard, LineBoard

AXIS_POINT, AXIS = np.array([8.0, 0.0, 20.0]), np.array([0.1, -1.0, 0.2]) / np.linalg.norm([0.1, -1.0, 0.2])


@dataclass
class Bench(ExitStack):
    """A way to open a turntable, and what knows better than the driver where it stands.

    stands_deg : right-handed about the axis, from where it was opened. still : whether nothing moves.
    """

    open_table: Callable[[], Turntable]
    stands_deg: Callable[[], float]
    still: Callable[[], bool] = field(default=lambda: True)

    def __post_init__(self) -> None:
        super().__init__()

    def opened(self) -> Turntable:
        table = self.open_table()
        self.callback(table.close)
        return table


def rendered(folder: Path) -> Bench:
    """Where it stands is read off the truth of the scene: a marked vertex's way about the axis."""
    (folder / "plate.toml").write_text(PLATE)
    table = {"point_mm": AXIS_POINT.tolist(), "direction": AXIS.tolist(), "knows_axis": True}
    options = {"scene": "plate.toml", "projector": beamer(), "camera": eyes(), "turntable": table}
    heads: list[SimulatedHead] = []

    def open_table() -> Turntable:
        heads.append(open_simulated_head(options, folder))
        assert isinstance(heads[-1].positioner, Turntable)
        return heads[-1].positioner

    begun = open_simulated_head(options, folder).truth().surface.vertices_mm[0]

    def stands_deg() -> float:
        arms = [at - AXIS_POINT for at in (begun, heads[-1].truth().surface.vertices_mm[0])]
        before, after = (arm - AXIS * (arm @ AXIS) for arm in arms)
        return float(np.rad2deg(np.arctan2(np.cross(before, after) @ AXIS, before @ after)))

    return Bench(open_table, stands_deg)


def grbl(_folder: Path) -> Bench:
    """A table behind a worm gear: 2 mm of the axis Y are a degree."""
    board = GrblBoard(slow=4)
    board.places[1] = -7.0
    options = {"axis": "Y", "units_per_deg": 2.0, "speed_deg_s": 30.0, "approach_deg": 3.0}
    return Bench(partial(board.opened, **options), lambda: (board.places[1] + 7.0) / 2.0, lambda: not board.left)


def lines(_folder: Path) -> Bench:
    board = LineBoard(steps=36000)
    return Bench(partial(board.opened, reversed=True), lambda: -board.at_deg)


BENCHES: Mapping[str, Callable[[Path], Bench]] = {
    "rendered": rendered,
    "grbl_turntable": grbl,
    "serial_turntable": lines,
}


@pytest.fixture(params=BENCHES)
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with BENCHES[request.param](tmp_path) as made:
        yield made


def test_it_stands_where_it_was_sent_and_still_when_it_returns(bench: Bench) -> None:
    table = bench.opened()
    assert isinstance(table, Turntable)
    assert len(table.poses) == len(table.angles_deg) == 8
    for index in (0, 3, 1):
        table.move(index)
        assert bench.still()
        assert bench.stands_deg() == pytest.approx(table.angles_deg[index], abs=0.01)
        assert table.poses[index] == f"{table.angles_deg[index]:g}°"
    # Right-handed, backwards, and round and round.
    for angle_deg in (33.0, -12.5, 370.0, 0.0):
        table.turn(angle_deg)
        assert bench.still()
        assert (bench.stands_deg() - angle_deg + 180) % 360 == pytest.approx(180.0, abs=0.01)


def test_it_knows_the_axis_about_which_it_turns_or_none(bench: Bench) -> None:
    axis = bench.opened().axis
    if axis is not None:
        np.testing.assert_allclose(np.cross(axis.point_mm - AXIS_POINT, AXIS), 0.0, atol=1e-9)
        np.testing.assert_allclose(axis.direction, AXIS, atol=1e-9)


def test_it_conforms(bench: Bench) -> None:
    def turned(rig: Rig) -> Rig:
        return replace(rig, positioner=bench.opened())

    check = next(check for check in CHECKS if check.name == "a_positioner_takes_its_poses_and_no_others")
    with ConformanceRun(Maker(change=turned), sequence()) as examination:
        result = examination.run_check(check)
    assert result.outcome is CheckOutcome.PASSED, str(result.failure)


def test_refused_poses_are_named_and_move_nothing(bench: Bench) -> None:
    table = bench.opened()
    table.turn(20.0)
    for index in (-1, 8):
        with pytest.raises(UnsupportedByDeviceError, match=rf"pose {index}, .* 0 to 7: 0°, 45°, .*, 315°"):
            table.move(index)
    assert bench.stands_deg() == pytest.approx(20.0, abs=0.01)


def test_it_opens_again_after_it_was_closed_and_counts_from_there(bench: Bench) -> None:
    table = bench.opened()
    table.turn(90.0)
    for _ in range(2):
        table.close()
    with pytest.raises(DeviceStateError, match="closed; open the rig again"):
        table.turn(0.0)
    before = bench.stands_deg()
    again = bench.opened()
    start = bench.stands_deg()
    assert start in (before, 0.0)
    # Its own count tells which of the two it is.
    opened_at_deg = [each.opened_at_deg for each in (table, again)]
    if start:
        first_deg, second_deg = (each_deg for each_deg in opened_at_deg if each_deg is not None)
        assert second_deg - first_deg == pytest.approx(start, abs=0.01)
    else:
        assert opened_at_deg == [None, None]
    again.turn(30.0)
    assert bench.stands_deg() - start == pytest.approx(30.0, abs=0.01)

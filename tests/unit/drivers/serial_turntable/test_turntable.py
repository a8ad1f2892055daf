"""Turntables on serial lines, before stand-ins on pseudo-terminals: turns, and everything that goes wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from drivers.serial_turntable import open_grbl, open_turntable
from slrig.devices import Turntable
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    UnsupportedByDeviceError,
)
from tests.unit.drivers.serial_turntable.controllers import Board, GrblBoard, LineBoard, SkippingClock

X = {"axis": "X"}


class Bench(ExitStack):
    """Boards and turntables, closed at the end of a test."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = SkippingClock()

    def opened(self, board: Board, **options: Any) -> Turntable:
        self.callback(board.close)
        factory = open_grbl if isinstance(board, GrblBoard) else open_turntable
        table = factory({"port": board.path, **options}, Path(), clock=self.clock)
        self.callback(table.close)
        return table


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is sent twice, however late a busy machine lets a board answer."""
    for controller in ("grbl", "simple"):
        for window in ("_AGAIN_S", "_REPLY_S"):
            monkeypatch.setattr(f"drivers.serial_turntable.{controller}.{window}", 30.0)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as each:
        yield each


# ---- GRBL


def test_a_turn_ends_when_the_controller_is_idle_at_the_place(bench: Bench) -> None:
    board = GrblBoard(slow=5)
    table = bench.opened(board, **X, units_per_deg=0.5, speed_deg_s=20.0)
    seen = board.reports
    table.turn(90.0)
    assert board.heard[-1] == "G21 G90 G53 G1 F600.000 X45.0000"
    assert (board.places[0], board.state) == (45.0, "Idle")
    assert board.reports - seen >= 5
    table.move(1)
    assert board.places[0] == 22.5
    assert bench.clock.waits_s[-1] == pytest.approx(0.5, abs=0.1)


def test_it_counts_from_where_the_controller_stood_and_backwards_if_it_is_reversed(bench: Bench) -> None:
    board = GrblBoard(axes=4)
    board.places[3] = 100.0
    table = bench.opened(board, reversed=True)
    table.turn(30.0)
    assert board.heard[-1] == "G21 G90 G53 G0 A70.0000"
    assert board.places == [0.0, 0.0, 0.0, 70.0]


def test_backlash_is_taken_up_from_one_side(bench: Bench) -> None:
    board = GrblBoard()
    table = bench.opened(board, **X, approach_deg=5.0)
    asked = []
    for angle in (0.0, 45.0, 45.0, 47.0, 10.0):
        board.heard.clear()
        table.turn(angle)
        asked.append([float(line.rpartition("X")[2]) for line in board.heard if "X" in line])
    assert asked == [[-5.0, 0.0], [45.0], [45.0], [42.0, 47.0], [5.0, 10.0]]


def test_a_locked_controller_is_unlocked_when_it_is_opened(bench: Bench) -> None:
    board = GrblBoard(locked=True)
    bench.opened(board, **X).turn(10.0)
    assert "$X" in board.heard
    assert board.places[0] == 10.0


def test_a_board_that_boots_is_waited_for(bench: Bench) -> None:
    board = GrblBoard(deaf=1)
    bench.opened(board, **X).turn(10.0)
    assert board.places[0] == 10.0


@pytest.mark.parametrize(
    ("board", "options", "words"),
    [
        ({"settings": {13: "1"}}, X, r"\$13=1; set it to report mm: \$13=0"),
        ({"settings": {20: "1"}}, X, "soft limits"),
        ({"settings": {10: "2"}}, X, r"\(MPos\): set \$10=1"),
        ({}, {}, "has no axis A, only X, Y, Z"),
    ],
)
def test_settings_that_keep_a_table_from_turning_are_refused(
    bench: Bench, board: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        bench.opened(GrblBoard(**board), **options)


def test_marlin_is_named_and_not_served(bench: Bench) -> None:
    board = GrblBoard()
    board.banner = lambda: b"start\r\necho:Marlin 2.1.2\r\n"  # type: ignore[method-assign]
    with pytest.raises(UnsupportedByDeviceError, match=r"'echo:Marlin 2.1.2'.*Marlin is not served"):
        bench.opened(board, **X, open_s=0.6)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"error:22\r\n", "error:22 to 'G21 G90 G53 G0 X90.0000': it has no feed rate"),
        (b"error:99\r\n", "error:99.*list of its numbers"),
        (b"ALARM:1\r\n", "ALARM:1.*limit switch"),
        (b"\r\nGrbl 1.1h ['$' for help]\r\n", "restarted by itself.*no longer knows where it stands"),
    ],
)
def test_what_the_controller_refuses_is_told_in_words_and_nothing_is_turned_any_more(
    bench: Bench, answer: bytes, words: str
) -> None:
    board = GrblBoard()
    table = bench.opened(board, **X)
    board.on_line = lambda line: answer if line.startswith("G") else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)
    board.on_line = lambda _line: None
    before = board.moved
    with pytest.raises(DeviceError, match=r"not known where.*begin its views anew"):
        table.turn(0.0)
    assert board.moved == before


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(
    ("report", "words"),
    [
        (b"ALARM:2\r\n", "ALARM:2.*soft limits"),
        (b"<Alarm|MPos:1.000,0.000,0.000|FS:0,0>\r\n", "state Alarm"),
        (b"\r\nGrbl 1.1h ['$' for help]\r\n", "restarted by itself"),
        (b"<Idle|MPos:1.000,oops|FS:0,0>\r\n", "stands at 1.000°.*tolerance_deg = 0.1"),
        (b"<Idle|MPos:x,0.000,0.000>\r\n", "holds no place"),
    ],
)
def test_what_happens_in_the_middle_of_a_turn_is_told(bench: Bench, report: bytes, words: str) -> None:
    board = GrblBoard(slow=50)
    table = bench.opened(board, **X)
    begun = board.reports
    board.on_report = lambda count: report if count > begun + 2 else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)


def test_a_controller_that_restarts_between_two_turns_has_lost_its_place(bench: Bench) -> None:
    board = GrblBoard()
    table = bench.opened(board, **X)
    table.turn(90.0)
    # Its banner is lost as well.
    board.places[0] = 0.0
    with pytest.raises(DeviceError, match=r"left at 90.000.*now says 0.000.*restarted"):
        table.turn(180.0)


def test_a_turn_that_takes_too_long_is_stopped(bench: Bench) -> None:
    board = GrblBoard(stuck=True)
    table = bench.opened(board, **X, turn_s=5.0)
    with pytest.raises(DeviceError, match=r"did not get to 90.000 X within turn_s; it was at 0.000, in the state Run"):
        table.turn(90.0)
    bench.close()
    assert board.heard[-2:] == ["hold", "reset"]
    assert board.left == 0


def test_closing_stops_a_turn_that_is_under_way(bench: Bench) -> None:
    board = GrblBoard(slow=1000)
    table = bench.opened(board, **X)
    bench.clock.on_wait = table.close
    with pytest.raises(DeviceStateError, match="closed while it was waited for"):
        table.turn(90.0)
    bench.close()
    assert board.heard[-2:] == ["hold", "reset"]
    assert board.left == 0


def test_garbage_and_half_lines_are_passed_over(bench: Bench) -> None:
    board = GrblBoard(slow=8)
    table = bench.opened(board, **X)
    begun = board.reports
    junk = {1: b"\xff\xfe<Idle|MPo", 2: b"\r\n", 3: b"<Run|MPos:1", 4: b".000,2.000,3.000|FS:0,0>\r\n", 5: b"\x00\r\n"}
    board.on_report = lambda count: junk.get(count - begun - 2)
    table.turn(90.0)
    assert board.places[0] == 90.0


# ---- the protocol of lines


def test_a_board_turns_and_tells_the_angle_that_it_reached(bench: Bench) -> None:
    board = LineBoard(at_deg=20.0)
    table = bench.opened(board, units_per_deg=3.0)
    table.turn(45.0)
    assert [line for line in board.heard if line.startswith("TURN")] == ["TURN 155.000"]


@pytest.mark.usefixtures("patient")
def test_a_session_is_as_the_documentation_has_it(bench: Bench) -> None:
    board = LineBoard()
    table = bench.opened(board)
    table.turn(45.0)
    table.turn(10.0)
    assert board.heard == ["STOP", "ID?", "STOP", "STOP", "TURN 45.000", "STOP", "TURN 10.000"]
    assert board.obey("SPIN") == b"ERR unknown command SPIN\n"
    assert board.obey("STOP") == b"OK 10.012\n"


@pytest.mark.usefixtures("patient")
def test_a_board_that_was_left_turning_is_stopped_before_it_is_asked(bench: Bench) -> None:
    board = LineBoard(at_deg=33.75, turning=True)
    table = bench.opened(board)
    assert (board.heard, board.turning) == (["STOP", "ID?", "STOP"], False)
    assert table.opened_at_deg == 33.75


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(
    ("board", "answer", "words"),
    [
        ({}, b"ERR the motor has no power\n", "answered 'TURN 90.000' with: the motor has no power"),
        ({}, b"START\n", "restarted, and no longer knows where it stands"),
        ({}, b"OK 4\n", r"whose steps are 0.113°, for 90.000°, it stands at 4.000°"),
        ({"off_deg": 0.2}, None, r"stands at 90.200°.*tolerance_deg = 0.1"),
        ({}, b"OK 90\xff\n", "did not answer 'TURN 90.000' in time, and was told to stop"),
    ],
)
def test_what_a_board_says_instead_is_told(
    bench: Bench, board: dict[str, Any], answer: bytes | None, words: str
) -> None:
    made = LineBoard(**board)
    in_time = {"turn_s": 0.2} if answer == b"OK 90\xff\n" else {}
    table = bench.opened(made, **in_time)
    made.on_line = lambda line: answer if line.startswith("TURN") else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)
    with pytest.raises(DeviceError, match="not known where"):
        table.turn(0.0)


@pytest.mark.parametrize(
    ("identity", "words"),
    [
        (b"slrig-turntable 2 3200\n", "speaks version 2"),
        (b"slrig-turntable 1 0\n", "found 'slrig-turntable 1 0'"),
        (b"Grbl?\n", "found 'Grbl\\?'"),
        (b"", "nothing answered"),
    ],
)
def test_what_is_no_such_board_is_refused(bench: Bench, identity: bytes, words: str) -> None:
    board = LineBoard()
    board.on_line = lambda _line: identity
    with pytest.raises(DeviceError, match=words):
        bench.opened(board, open_s=0.2)


# ---- both


@pytest.mark.parametrize("board", [GrblBoard, LineBoard])
def test_a_cable_that_is_pulled_in_a_turn_is_told(bench: Bench, board: type[Board]) -> None:
    made = board()
    table = bench.opened(made, **(X if board is GrblBoard else {}))
    made.on_line = lambda line: made.unplug() if line.startswith(("G", "TURN")) else None
    with pytest.raises(DeviceGoneError, match=r"the turntable on .* found it gone"):
        table.turn(90.0)
    table.close()


@pytest.mark.parametrize("board", [GrblBoard, LineBoard])
def test_a_controller_that_falls_silent_is_given_up(bench: Bench, board: type[Board]) -> None:
    made = board()
    table = bench.opened(made, **(X if board is GrblBoard else {}))
    made.silent = True
    with pytest.raises(DeviceError, match="power"):
        table.turn(90.0)


@pytest.mark.parametrize("board", [GrblBoard, LineBoard])
def test_a_port_has_one_holder_and_is_free_again_after_close(bench: Bench, board: type[Board]) -> None:
    made = board()
    options = {"port": made.path, **(X if board is GrblBoard else {})}
    table = bench.opened(made, **options)
    factory = open_grbl if board is GrblBoard else open_turntable
    with pytest.raises(DeviceBusyError, match="is held by"):
        factory(options, Path())
    table.close()
    factory(options, Path(), clock=bench.clock).close()


def test_wrong_options_are_told_together() -> None:
    with pytest.raises(ConfigError) as caught:
        open_grbl({"axis": "W", "sped_deg_s": 3.0, "units_per_deg": 0.0}, Path())
    assert all(key in str(caught.value) for key in ("port", "axis", "sped_deg_s", "units_per_deg"))
    with pytest.raises(DeviceGoneError, match="plug the turntable in"):
        open_turntable({"port": "/dev/ttyNONE"}, Path())

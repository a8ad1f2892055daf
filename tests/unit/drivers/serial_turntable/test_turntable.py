"""Turntables on serial lines, before stand-ins for their controllers: what is sent, and everything that goes wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from drivers.serial_turntable import open_turntable
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from tests.unit.drivers.serial_turntable.controllers import Board, GrblBoard, LineBoard

X = {"axis": "X"}
BOOT = b"\r\nGrbl 1.1h ['$' for help]\r\n"


def options_of(board: Board) -> dict[str, Any]:
    return X if isinstance(board, GrblBoard) else {}


# ---- GRBL


@pytest.mark.parametrize(
    ("place", "options", "line", "reached"),
    [
        (0.0, {**X, "units_per_deg": 0.5, "speed_deg_s": 20.0}, "G21 G90 G53 G1 F600.000 X15.0000", 15.0),
        (100.0, {"reversed": True}, "G21 G90 G53 G0 A70.0000", 70.0),
    ],
)
def test_a_turn_is_a_line_of_g_code_and_ends_when_the_controller_is_idle_there(
    place: float, options: dict[str, Any], line: str, reached: float
) -> None:
    board = GrblBoard(slow=5, axes=4)
    index = "XYZA".index(options.get("axis", "A"))
    board.places[index] = place
    table = board.opened(**options)
    reports, begun_ns = board.reports, board.clock.now_ns()
    table.turn(30.0)
    assert board.heard[-1] == line
    assert (board.places[index], board.state) == (reached, "Idle")
    assert board.reports - reports >= 5
    # Looks at 10 Hz, and then what stands on the table comes to rest.
    assert (board.clock.now_ns() - begun_ns) / 1e9 == pytest.approx(4 * 0.1 + 0.5, abs=0.05)


def test_backlash_is_taken_up_from_one_side() -> None:
    board = GrblBoard()
    table = board.opened(**X, approach_deg=5.0)
    asked = []
    for angle in (0.0, 45.0, 45.0, 47.0, 10.0):
        board.heard.clear()
        table.turn(angle)
        asked.append([float(line.rpartition("X")[2]) for line in board.heard if "X" in line])
    assert asked == [[-5.0, 0.0], [45.0], [45.0], [42.0, 47.0], [5.0, 10.0]]


@pytest.mark.parametrize("state", [{"locked": True}, {"deaf": 1}], ids=["locked", "still booting"])
def test_a_controller_that_is_not_ready_when_it_is_opened_is_made_ready(state: dict[str, Any]) -> None:
    board = GrblBoard(**state)
    board.opened(**X).turn(10.0)
    assert ("$X" in board.heard) == ("locked" in state)
    assert board.places[0] == 10.0


@pytest.mark.parametrize(
    ("settings", "options", "words"),
    [
        ({13: "1"}, X, r"\$13=1; set it to report mm: \$13=0"),
        ({20: "1"}, X, "soft limits"),
        ({10: "2"}, X, r"\(MPos\): set \$10=1"),
        ({}, {}, "has no axis A, only X, Y, Z"),
    ],
)
def test_settings_that_keep_a_table_from_turning_are_refused(
    settings: dict[int, str], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        GrblBoard(settings=settings).opened(**options)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"error:22\r\n", "error:22 to 'G21 G90 G53 G0 X90.0000': it has no feed rate"),
        (b"error:99\r\n", "error:99.*documentation of its numbers"),
        (b"ALARM:1\r\n", "ALARM:1.*limit switch"),
        (BOOT, "restarted on its own.*lost its position"),
    ],
)
def test_what_the_controller_refuses_is_reported_in_words_and_ends_all_turning(answer: bytes, words: str) -> None:
    board = GrblBoard()
    table = board.opened(**X)
    board.on_line = lambda line: answer if line.startswith("G") else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)
    board.on_line = lambda _line: None
    with pytest.raises(DeviceError, match=r"is unknown since.*repeat all views"):
        table.turn(0.0)
    assert board.moved == 0


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (b"ALARM:2\r\n", "ALARM:2.*soft limits"),
        (b"<Alarm|MPos:1.000,0.000,0.000|FS:0,0>\r\n", "state Alarm"),
        (BOOT, "restarted on its own"),
        (b"<Idle|MPos:1.000,oops|FS:0,0>\r\n", "is at 1.000°.*tolerance_deg = 0.1"),
        (b"<Idle|MPos:x,0.000,0.000>\r\n", "has no position"),
    ],
)
def test_what_happens_in_the_middle_of_a_turn_is_reported(report: bytes, words: str) -> None:
    board = GrblBoard(slow=50)
    table = board.opened(**X)
    begun = board.reports
    board.on_report = lambda count: report if count > begun + 2 else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)


def test_a_controller_that_restarts_between_two_turns_has_lost_its_place() -> None:
    board = GrblBoard()
    table = board.opened(**X)
    table.turn(90.0)
    # Its banner is lost as well.
    board.places[0] = 0.0
    with pytest.raises(DeviceError, match=r"left at 90.000.*now at 0.000.*restarted"):
        table.turn(180.0)


@pytest.mark.parametrize("closed", [False, True])
def test_a_turn_that_takes_too_long_or_is_closed_is_stopped(closed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    board = GrblBoard(stuck=not closed, slow=1000)
    table = board.opened(**X, turn_s=5.0)
    if closed:
        monkeypatch.setattr(board.clock, "wait_until", lambda _t_ns, _stop: table.close())
    stuck = r"did not reach 90.000 X within turn_s; it was at 0.000, in state Run"
    error, words = (DeviceStateError, "closed during a request") if closed else (DeviceError, stuck)
    with pytest.raises(error, match=words):
        table.turn(90.0)
    assert board.heard[-2:] == ["hold", "reset"]
    assert board.left == 0


def test_garbage_and_half_lines_are_passed_over() -> None:
    board = GrblBoard(slow=8)
    table = board.opened(**X)
    begun = board.reports
    junk = {1: b"\xff\xfe<Idle|MPo", 2: b"\r\n", 3: b"<Run|MPos:1", 4: b".000,2.000,3.000|FS:0,0>\r\n", 5: b"\x00\r\n"}
    board.on_report = lambda count: junk.get(count - begun - 2)
    table.turn(90.0)
    assert board.places[0] == 90.0


# ---- the protocol of lines


def test_a_session_is_as_the_documentation_has_it() -> None:
    board = LineBoard()
    table = board.opened()
    table.turn(45.0)
    table.turn(10.0)
    for angle_deg in (float("nan"), float("inf")):
        with pytest.raises(UnsupportedByDeviceError, match="request a finite angle"):
            table.turn(angle_deg)
    assert board.heard == ["STOP", "ID?", "STOP", "STOP", "TURN 45.000", "STOP", "TURN 10.000"]
    assert board.obey("SPIN") == b"ERR unknown command SPIN\n"
    assert board.obey("STOP") == b"OK 10.012\n"


def test_a_board_that_was_left_turning_is_stopped_and_angles_count_from_there() -> None:
    board = LineBoard(at_deg=33.75, turning=True)
    table = board.opened(units_per_deg=3.0)
    assert (board.heard, board.turning) == (["STOP", "ID?", "STOP"], False)
    assert table.opened_at_deg == 11.25
    table.turn(45.0)
    assert board.heard[-1] == "TURN 168.750"


@pytest.mark.parametrize(
    ("board", "answer", "words"),
    [
        ({}, b"ERR the motor has no power\n", "answered 'TURN 90.000' with: the motor has no power"),
        ({}, b"START\n", "restarted.* lost its position"),
        ({}, b"OK 4\n", r"whose steps are 0.113°, it is at 4.000°"),
        ({"off_deg": 0.2}, None, "is at 90.200°.*tolerance_deg = 0.1"),
        ({}, b"OK 90\xff\n", "did not answer 'TURN 90.000' in time, and was stopped"),
    ],
)
def test_what_a_board_says_instead_is_reported(board: dict[str, Any], answer: bytes | None, words: str) -> None:
    made = LineBoard(**board)
    table = made.opened()
    made.on_line = lambda line: answer if line.startswith("TURN") else None
    with pytest.raises(DeviceError, match=words):
        table.turn(90.0)
    with pytest.raises(DeviceError, match="is unknown since"):
        table.turn(0.0)


@pytest.mark.parametrize(
    ("identity", "words"),
    [
        (b"slrig-turntable 2 3200\n", "speaks version 2"),
        (b"slrig-turntable 1 0\n", "found 'slrig-turntable 1 0'"),
        (b"Grbl?\n", "found 'Grbl\\?'"),
        (b"", "got no answer"),
    ],
)
def test_what_is_no_such_board_is_refused(identity: bytes, words: str) -> None:
    board = LineBoard()
    board.on_line = lambda _line: identity
    with pytest.raises(DeviceError, match=words):
        board.opened()
    marlin = GrblBoard()
    marlin.banner = lambda: b"start\r\necho:Marlin 2.1.2\r\n"  # type: ignore[method-assign]
    with pytest.raises(UnsupportedByDeviceError, match=r"'echo:Marlin 2.1.2'.*Marlin is not supported"):
        marlin.opened(**X)


# ---- both


@pytest.mark.parametrize("kind", [GrblBoard, LineBoard])
def test_a_controller_that_falls_silent_is_given_up_and_one_that_is_pulled_is_gone(kind: type[Board]) -> None:
    board = kind()
    table = board.opened(**options_of(board))
    board.silent = True
    with pytest.raises(DeviceError, match="power"):
        table.turn(90.0)
    board.silent = False
    table = board.opened(**options_of(board))
    board.on_line = lambda line: board.unplug() if line.startswith(("G", "TURN")) else None
    with pytest.raises(DeviceGoneError, match="unplugged"):
        table.turn(90.0)
    table.close()


def test_a_port_without_a_table_says_what_to_do() -> None:
    with pytest.raises(DeviceGoneError, match="plug the turntable in"):
        open_turntable({"port": "/dev/ttyNONE"}, Path())

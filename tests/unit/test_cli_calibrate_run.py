"""`slrig calibrate run`: the walk of a person or a positioner through a calibration session."""

from __future__ import annotations

import io
from collections.abc import Iterator

import pytest
from rich.console import Console
from typer.testing import CliRunner

from slrig.cli.calibrate_walk import Walk, opened
from slrig.cli.commands import INTERRUPTED, app
from slrig.cli.options import Service
from tests.unit.calibrate.solved import BOARD
from tests.unit.calibrate_command import refused, run
from tests.unit.calibration_desk import ID, Desk, client_of

BOARD_OPTIONS = ["--board", "chessboard", "--corners", "11x8", "--square-mm", "12"]


@pytest.fixture(autouse=True)
def _without_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.cli.calibrate_walk.time.sleep", lambda _s: None)


class Hand:
    """A person at a terminal: answers prompts with what is on the list. An exception on it is raised."""

    def __init__(self, *answers: str | BaseException) -> None:
        self.answers: Iterator[str | BaseException] = iter(answers)
        self.prompts: list[str] = []

    def __call__(self, prompt: str) -> str:
        self.prompts.append(prompt)
        answer = next(self.answers)
        if isinstance(answer, BaseException):
            raise answer
        return answer


def walked(desk: Desk, *answers: str | BaseException) -> tuple[str, Hand]:
    """What was printed on a walk, and the person who walked."""
    stream, hand = io.StringIO(), Hand(*answers)
    with client_of(desk) as client:
        session = opened(client, BOARD, label=None)
        Walk(client, session, Console(file=stream, width=120), ask=hand).by_hand()
    return stream.getvalue(), hand


def test_walk_opens_a_session_for_the_board() -> None:
    desk = Desk()
    text, _ = walked(desk, "q")
    board = {
        "kind": "chessboard",
        "corners": [11, 8],
        "square_mm": 12.0,
        "marker_mm": None,
        "dictionary": None,
        "square_sigma": 0.001,
        "aspect": 1.0,
    }
    assert desk.asked == [("POST", "/calibration", {"board": board, "label": None, "projector": True})]
    assert "Hold the board where every camera sees it" in text
    assert f"slrig calibrate run --id {ID[:8]}" in text


def test_walk_shoots_tells_and_says_what_to_move() -> None:
    desk = Desk(2)
    text, hand = walked(desk, "", "", "q")
    assert [path for _, path, _ in desk.asked[1:]] == [f"/calibration/{ID}/pose"] * 2
    assert "pose 1 accepted" in text
    assert "80 of 88 corners, 31° tilted, edges 1.1 px soft, moved 0.02 px, 1.3% saturated" in text
    assert "pose 2 refused" in text
    assert "the board moved: hold it still" in text
    assert text.count("move it to the lower right corner") == 2
    assert "3 of at least 10 poses" in text
    assert len(hand.prompts) == 3
    # A pose that was refused covers nothing new: the picture stays away.
    assert text.count("17% of the cells") == 1


def test_coverage_picture_has_counts_empty_cells_and_the_place_to_go() -> None:
    text, _ = walked(Desk(), "", "q")
    rows = [line for line in text.splitlines() if "·" in line or "[·]" in line]
    assert rows[0].startswith(" 1  1  1  ·  ·  · ")
    assert rows[2].startswith(" ·  ·  ·  ·  ·  · ")
    # The outline holds the middles of the cells of columns 4 and 5, rows 4 and 5; the last row is out of reach.
    assert rows[4].rstrip() == " ·  ·  ·  · [·][·]"
    assert "            [ ][ ]" in text


def test_walk_solves_and_has_scans_use_the_result() -> None:
    desk = Desk()
    text, hand = walked(desk, "", "s", "a")
    assert [path for _, path, _ in desk.asked[2:]] == [f"/calibration/{ID}/solve", f"/calibration/{ID}/activate"]
    assert "1810.40 ± 0.21" in text
    assert "Scans use this calibration from now on." in text
    assert "have scans use it" in hand.prompts[-1]


def test_walk_goes_on_after_a_solve_that_was_refused() -> None:
    desk = Desk()
    desk.solve_error = "all boards are parallel: tilt them"
    text, hand = walked(desk, "", "s", "", "q")
    assert "all boards are parallel: tilt them" in text
    assert "pose 2 accepted" in text
    assert len(hand.prompts) == 4


def test_walk_drops_the_last_pose_that_counts() -> None:
    desk = Desk(2)
    text, _ = walked(desk, "", "", "d", "d", "x", "q")
    assert [path for method, path, _ in desk.asked if method == "DELETE"] == [f"/calibration/{ID}/pose/1"]
    assert "pose 1 is dropped." in text
    assert "There is no accepted pose to drop." in text
    assert "There is nothing on 'x'." in text


def test_end_of_input_leaves_the_session_to_be_taken_up_again() -> None:
    text, _ = walked(Desk(), EOFError())
    assert "The session is kept." in text


def test_ctrl_c_cancels_the_pose_under_way_and_keeps_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    desk.stuck = True

    def interrupted(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slrig.cli.calibrate_walk.time.sleep", interrupted)
    monkeypatch.setattr(Service, "client", lambda _self: client_of(desk))
    result = CliRunner().invoke(app, ["calibrate", "run", *BOARD_OPTIONS], input="\n")
    assert result.exit_code == INTERRUPTED
    assert desk.asked[-1][:2] == ("POST", f"/calibration/{ID}/pose/1/cancel")
    assert f"--id {ID[:8]}" in result.stdout


def test_session_is_taken_up_by_the_beginning_of_its_id(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    monkeypatch.setattr(Service, "client", lambda _self: client_of(desk))
    result = CliRunner().invoke(app, ["calibrate", "run", "--id", ID[:6]], input="q\n")
    assert result.exit_code == 0, result.output
    assert desk.asked == []
    assert BOARD.title in result.stdout
    assert f"'999' is the beginning of no calibration's id; there are: {ID[:8]}" in refused(run("run", "--id", "999"))


def test_walk_without_a_board_takes_the_usual_one_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    monkeypatch.setattr(Service, "client", lambda _self: client_of(desk))
    result = run("run")
    assert result.exit_code == 0, result.output
    board = desk.asked[0][2]["board"]
    assert (board["kind"], board["corners"], board["square_mm"], board["marker_mm"]) == ("charuco", [11, 8], 12.0, 9.0)
    assert "charuco, 11 x 8 inner corners, squares of 12 mm, markers of 9 mm from DICT_5X5_250" in result.stderr


def test_script_shoots_every_position_then_solves(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    monkeypatch.setattr(Service, "client", lambda _self: client_of(desk))
    result = run("run", *BOARD_OPTIONS, "--scripted", "--position", "pose 1", "--activate", "--exposure-s", "0.02",
                 "--board-shape", "bowed")  # fmt: skip
    assert result.exit_code == 0, result.output
    asked = {"positions": ["pose 1"], "exposure_s": 0.02, "if_busy": "queue"}
    assert desk.asked[1] == ("POST", f"/calibration/{ID}/script", asked)
    assert [path.rpartition("/")[2] for _, path, _ in desk.asked[2:]] == ["solve", "activate"]
    assert desk.asked[2][2] == {"board_shape": "bowed"}
    for number in (1, 2, 3):
        assert f"pose {number} accepted" in result.stdout

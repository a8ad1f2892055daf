"""`slrig calibrate`: boards, solving a folder, the walk through a session, and the calibrations a service keeps."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from rich.console import Console
from typer.testing import Result

from slrig.api.calibration import ComparisonBody
from slrig.bundle import read_calibration, read_opencv_calibration, write_calibration, write_opencv_calibration
from slrig.calibrate.report import summary
from slrig.calibration.board import DEFAULT_BOARD, BoardShape
from slrig.cli.calibrate_walk import Walk, opened, print_result
from slrig.cli.commands import INTERRUPTED
from slrig.cli.options import ServiceOptions
from slrig.client import Client
from slrig.errors import PoseRefusedError, SolveRefusedError
from slrig.jobs.listener import Listener
from tests.unit import command
from tests.unit.calibrate.solved import BOARD, BUMP, BUMPED, POSES, read_poses, solved_result
from tests.unit.calibrate_command import refused, run
from tests.unit.calibration_desk import ID, Desk, client_of
from tests.unit.command import slrig

GIVEN = POSES[:4]
BOARD_OPTIONS = ["--board", "chessboard", "--corners", "11x8", "--square-mm", "12"]
OTHER = "77777777-9f0e-4c57-8a39-5f8a4f0c2b11"


def bundle(folder: Path, name: str, *, size_px: tuple[int, int] = (1280, 1024), camera: str = "left") -> None:
    """A folder with the description of a pose's bundle; its frames are not looked at here."""
    gray = [
        {"kind": "gray", "axis": axis, "bit": 0, "bits": 11, "inverted": inverted}
        for axis in ("column", "row")
        for inverted in (False, True)
    ]
    patterns = [{"kind": "white"}, {"kind": "black"}, *gray]
    document = {
        "format": "slrig-bundle",
        "version": 1,
        "projector": {"size_px": [1280, 800]},
        "cameras": {camera: {"size_px": list(size_px), "bit_depth": 8}},
        "patterns": patterns,
        "frames": [
            {"pattern": number, "camera": camera, "file": f"{number}.png", "exposure_s": 0.01, "time_s": 0.1 * number}
            for number in range(len(patterns))
        ],
    }
    (folder / name).mkdir(parents=True)
    (folder / name / "bundle.json").write_text(json.dumps(document))


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    for name in GIVEN:
        bundle(tmp_path / "poses", name)
    return tmp_path / "poses"


class Solving:
    """Stands for reading and solving: gives the calibration made by hand, and keeps what it was given."""

    def __init__(self) -> None:
        self.known: dict[str, Any] = dict(read_poses())
        self.asked: dict[str, Any] = {}
        self.refusal: SolveRefusedError | None = None

    def read_pose(self, folder: Path, _board: object, name: str) -> object:
        assert name in {folder.name, folder.parent.name}
        if isinstance(found := self.known[name], Exception):
            raise found
        return found

    def solve_poses(
        self, board: object, cameras: object, projector: object, given: Any, listener: Listener, /, **options: Any
    ) -> object:
        if self.refusal is not None:
            raise self.refusal
        names = [each.observation.name for each in given]
        self.asked = {"board": board, "cameras": cameras, "projector": projector, "poses": names, **options}
        listener.report("adjustment", 0.5, "")
        return solved_result()


@pytest.fixture
def solving(monkeypatch: pytest.MonkeyPatch) -> Solving:
    made = Solving()
    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", made.read_pose)
    monkeypatch.setattr("slrig.calibrate.store.solve_poses", made.solve_poses)
    monkeypatch.setattr("slrig.calibrate.report.white_frame", lambda *_: np.full((1024, 1280), 80, dtype=np.uint8))
    return made


def done(*arguments: object) -> str:
    return command.done("calibrate", *arguments)


def solve(folder: Path, output: Path, *options: object) -> Result:
    return run("solve", folder, *BOARD_OPTIONS, "--output", output, *options)


def test_folder_of_poses_becomes_a_calibration(poses: Path, solving: Solving, tmp_path: Path) -> None:
    output = tmp_path / "rig.json"
    result = solve(poses, output)
    assert result.exit_code == 0, result.output
    assert (solving.asked["board"], solving.asked["poses"]) == (BOARD, list(GIVEN))
    assert str(solving.asked["cameras"]["left"]) == "1280 x 1024"
    assert str(solving.asked["projector"]) == "1280 x 800"
    assert (solving.asked["board_shape"], solving.asked["earlier"]) == (BoardShape.AUTO, None)
    written = read_calibration(output)
    assert written.solved is not None
    assert written.cameras["left"].matrix[0, 0] == 1810.4
    for words in ("1810.40 ± 0.21", "842.40 ± 0.61", "19 used of 20", f"{BUMPED}  left moved by 1.9 px", str(output)):
        assert words in result.stdout, words
    assert "flat as far as the poses determine: 0.031 ± 0.012 mm" in result.stdout
    # Off a terminal every stage is a line of its own.
    stages = [line.split("%  ")[1].split("   ")[0] for line in result.stderr.splitlines()]
    assert stages[:2] == ["loading", "reading pose_00"]
    assert stages[-2:] == ["adjustment", "done"]


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".yml", pytest.param(".xml", marks=pytest.mark.slow)])
def test_solve_takes_all_its_options(poses: Path, solving: Solving, tmp_path: Path, ending: str) -> None:
    # As a service keeps them.
    for pose in sorted(poses.iterdir()):
        (tmp_path / "kept" / pose.name).mkdir(parents=True)
        pose.rename(tmp_path / "kept" / pose.name / "bundle")
    bundle(tmp_path / "kept", "pose_20")
    (tmp_path / "kept" / "pose_20" / "bundle.json").write_text('{"format": ')
    write_calibration(tmp_path / "earlier.json", solved_result().calibration)
    output, report = tmp_path / f"rig{ending}", tmp_path / "report.html"
    more = ("--board-shape", "flat", "--earlier", tmp_path / "earlier.json", "--report", report, "--json")
    printed = done("solve", tmp_path / "kept", *BOARD_OPTIONS, "--output", output, *more)
    assert solving.asked["poses"] == list(GIVEN)
    assert solving.asked["board_shape"] is BoardShape.FLAT
    assert solving.asked["earlier"].cameras["left"].matrix[0, 0] == 1810.4
    document = json.loads(printed)
    assert {name: document[name] for name in summary(solved_result())} == summary(solved_result())
    assert (list(document["refused"]), document["output"]) == (["pose_20"], str(output))
    written = read_opencv_calibration(output)
    assert written.projector is not None
    assert written.projector.matrix[1, 2] == 842.4
    text = report.read_text(encoding="utf-8")
    assert (text.count("<img "), "Calibration from kept" in text) == (len(GIVEN), True)


@pytest.mark.slow
def test_folder_of_poses_is_checked_without_writing_anything(poses: Path, solving: Solving, tmp_path: Path) -> None:
    printed = done("check", poses, *BOARD_OPTIONS, "--board-shape", "flat")
    assert (solving.asked["poses"], solving.asked["board_shape"]) == (list(GIVEN), BoardShape.FLAT)
    assert "0.89 × the stated deviation" in " ".join(printed.split())
    assert [path.name for path in tmp_path.iterdir()] == ["poses"]


@pytest.mark.slow
def test_poses_that_cannot_be_used_are_named_and_left_out(poses: Path, solving: Solving, tmp_path: Path) -> None:
    (poses / "pose_01" / "bundle.json").write_text('{"format": "slrig-bundle", "vers')
    solving.known["pose_02"] = PoseRefusedError("pose 'pose_02': half a board: move it fully into view")
    solving.known["pose_03"] = solving.known["pose_00"]
    printed = done("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json")
    assert solving.asked["poses"] == ["pose_00"]
    shown = "".join(printed.partition("refused")[2].split())
    for words in ("pose_02halfaboard:moveitfullyintoview", "bundle.json:expectedJSON", "thesameaspose_00"):
        assert words in shown


def test_board_that_no_pose_shows_is_named_once(poses: Path, solving: Solving, tmp_path: Path) -> None:
    for name in GIVEN:
        solving.known[name] = PoseRefusedError(f"pose '{name}': another board: expected 9 x 9 corners, found 11 x 8")
    options = ["--board", "chessboard", "--corners", "9x9", "--square-mm", "12", "--output", tmp_path / "rig.json"]
    words = refused(run("solve", poses, *options))
    assert "none of its poses (4) shows a chessboard 9x9, 12 mm that can be used" in words
    assert words.count("another board: expected 9 x 9 corners, found 11 x 8") == 1
    assert "pose_00 to pose_03 (4)" in words
    assert "--corners counts inner corners" in words
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.slow
def test_refused_solve_names_the_poses_without_use(poses: Path, solving: Solving, tmp_path: Path) -> None:
    solving.refusal = SolveRefusedError("all boards are parallel: tilt them")
    (poses / "pose_03" / "bundle.json").write_text("{")
    words = refused(solve(poses, tmp_path / "rig.json"))
    assert words.startswith("all boards are parallel: tilt them\n1 pose was not used:\n  pose_03: ")
    bundle(poses, "pose_30", size_px=(640, 480))
    words = refused(solve(poses, tmp_path / "rig.json"))
    assert "pose 'pose_30' was captured with another rig" in words
    assert "640 x 480" in words
    assert not (tmp_path / "rig.json").exists()


def test_bad_folder_output_and_board_are_refused_before_the_work(poses: Path, solving: Solving, tmp_path: Path) -> None:
    output = tmp_path / "rig.json"
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "others" / "photos").mkdir(parents=True)
    (tmp_path / "folder.json").mkdir()
    bundle(tmp_path, "one")
    for folder, words in (
        ("absent", "found nothing there"),
        ("file", "found a file there"),
        ("empty", "it holds no folders"),
        ("others", "it holds 1 folder without a bundle.json"),
        ("one", "this is one bundle itself: name the folder that holds it"),
    ):
        found = refused(solve(tmp_path / folder, output))
        assert "expected a folder with one bundle per pose" in found
        assert words in found
    for given, words in (
        ((tmp_path / "rig.txt",), "expected a name that ends in .json"),
        ((tmp_path / "absent" / "rig.json",), "there is no folder"),
        ((tmp_path / "folder.json",), "found a folder"),
        ((output, "--report", tmp_path / "no" / "r"), "--report"),
        ((output, "--earlier", tmp_path / "absent.json"), "absent.json"),
    ):
        assert words in refused(solve(poses, *given)), given
    for options, words in (
        (["--board", "chessboard", "--corners", "11", "--square-mm", "12"], "--corners: expected COLUMNSxROWS"),
        ([*BOARD_OPTIONS, "--marker-mm", "8"], "marker_mm"),
        (["--board", "chessboard", "--corners", "1x8", "--square-mm", "12"], "found 1 x 8"),
        (["--board", "chessboard", "--corners", "11x8"], "Missing: --square-mm."),
        (["--board", "circles"], "Missing: --corners, --square-mm."),
        (["--corners", "9x6"], "Missing: --board, --square-mm."),
        (["--square-mm", "12", "--marker-mm", "13"], "0.1 to 0.99 of the square's 12 mm, found 13"),
        (["--dictionary", "DICT_4X4_50"], "needs 54 markers and DICT_4X4_50 has 50"),
    ):
        assert words in refused(run("solve", poses, *options, "--output", output))
    assert run("solve", poses, "--board", "triangles", "--output", output).exit_code == 2
    assert not solving.asked
    assert not output.exists()


def test_board_is_written_to_be_printed(tmp_path: Path) -> None:
    options = ["--board", "charuco", "--corners", "9x6", "--square-mm", "15"]
    printed = done("board", *options, "--output", tmp_path / "board.svg")
    assert (tmp_path / "board.svg").read_text(encoding="utf-8").startswith("<")
    assert "slrig calibrate solve FOLDER --board charuco --corners 9x6 --square-mm 15" in printed
    assert "that ends in .pdf or .svg" in refused(run("board", *options, "--output", tmp_path / "b.png"))


def test_board_that_is_not_named_is_the_usual_one(tmp_path: Path) -> None:
    named = ["--board", "charuco", "--corners", "11x8"]
    asked: tuple[tuple[list[str], str], ...]
    asked = ([], "12"), (["--board", "charuco"], "12"), (["--corners", "11 x 8"], "12"), (["--square-mm", "9.9"], "9.9")
    for number, (options, square_mm) in enumerate(asked):
        sheet, whole = tmp_path / f"{number}.svg", tmp_path / f"{number}-whole.svg"
        result = run("board", *options, "--output", sheet)
        assert result.exit_code == 0, result.output
        assert f"charuco, 11 x 8 inner corners, squares of {square_mm} mm" in result.stderr
        assert run("board", *named, "--square-mm", square_mm, "--output", whole).stderr == ""
        # The sheet that is printed is that of the same board named in full: 12 x 9 squares.
        assert sheet.read_bytes() == whole.read_bytes()
        assert f"--corners 11x8 --square-mm {square_mm}" in sheet.read_text(encoding="utf-8")
    told = " ".join(run("board", "--help").stdout.replace("│", " ").split())
    assert f"Default: {DEFAULT_BOARD.kind}." in told
    assert f"as {DEFAULT_BOARD.columns}x{DEFAULT_BOARD.rows} (default)" in told
    assert f"measured on the print (default {DEFAULT_BOARD.square_mm:g})" in told


def test_screen_fits_on_one_and_holds_the_figures() -> None:
    stream = io.StringIO()
    print_result({**summary(solved_result()), "refused": {"pose_20": "no board"}}, Console(file=stream, width=100))
    text = stream.getvalue()
    assert len(text.splitlines()) <= 40
    figures = summary(solved_result())
    for device in figures["devices"].values():
        assert f"{device['rms_px']:.3f}" in text
        assert f"{device['held_out_rms_px']:.3f} (× {device['held_out_rms_px'] / device['rms_px']:.2f})" in text
    assert f"{figures['expected']['point_mm']:.4f} mm" in text
    assert "odd and even poses differ by 0.0171 mm, 0.89 × what is stated for halves" in text
    assert "191.809 ± 0.015 mm apart" in text
    assert BUMP.partition(";")[0] in " ".join(text.split())


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    made = Desk()
    monkeypatch.setattr("slrig.cli.calibrate_walk.time.sleep", lambda _s: None)
    monkeypatch.setattr(ServiceOptions, "client", lambda _self: client_of(made))
    return made


@pytest.fixture
def walked(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Walks through a session with a person who types these answers, and returns what was shown."""

    def walk(*answers: str) -> str:
        stream, typed = io.StringIO(), iter(answers)
        monkeypatch.setattr("builtins.input", lambda: next(typed))
        with client_of(desk) as client:
            session = opened(client, BOARD, label=None)
            Walk(client, session, Console(file=stream, width=120)).manual()
        assert next(typed, None) is None
        return stream.getvalue()

    return walk


def test_walk_shoots_solves_and_has_scans_use_the_result(desk: Desk, walked: Callable[..., str]) -> None:
    desk.refusals = (2,)
    text = walked("", "", "s", "a")
    board = {"kind": "chessboard", "corners": [11, 8], "square_mm": 12.0, "marker_mm": None, "dictionary": None}
    request = {"board": {**board, "square_sigma": 0.001, "aspect": 1.0}, "label": None, "projector": True}
    assert desk.asked[0] == ("POST", "/calibration", request)
    assert [path for _, path, _ in desk.asked[1:]] == [
        f"/calibration/{ID}/{what}" for what in ("pose", "pose", "solve", "activate")
    ]
    for words in (
        "Hold the board where every camera sees it",
        "pose 1 accepted",
        "80 of 88 corners, 31° tilted, edges 1.1 px soft, moved 0.02 px, 1.3% saturated",
        "pose 2 refused",
        "the board moved: hold it still",
        "3 of at least 10 poses",
        "1810.40 ± 0.21",
        "Scans use this calibration from now on.",
    ):
        assert words in text, words
    assert text.count("move it to the lower right corner") == 2
    # A pose that was refused covers nothing new: the picture stays away.
    assert text.count("17% of the cells") == 1
    assert "use it for scans" in text
    rows = [line for line in text.splitlines() if "·" in line or "[·]" in line]
    assert rows[0].startswith(" 1  1  1  ·  ·  · ")
    assert rows[2].startswith(" ·  ·  ·  ·  ·  · ")
    # The outline holds the middles of the cells of columns 4 and 5, rows 4 and 5; the last row is out of reach.
    assert rows[4].rstrip() == " ·  ·  ·  · [·][·]"
    assert "            [ ][ ]" in text


def test_walk_drops_poses_and_goes_on_after_a_refused_solve(desk: Desk, walked: Callable[..., str]) -> None:
    desk.refusals, desk.solve_error = (2,), "all boards are parallel: tilt them"
    text = walked("", "", "d", "d", "x", "", "s", "", "q")
    assert [path for method, path, _ in desk.asked if method == "DELETE"] == [f"/calibration/{ID}/pose/1"]
    for words in (
        "pose 1 is dropped.",
        "There is no accepted pose to drop.",
        "There is nothing on 'x'.",
        "all boards are parallel: tilt them",
        "pose 4 accepted",
        "The session is kept.",
        f"slrig calibrate run --id {ID[:8]}",
    ):
        assert words in text, words


def test_ctrl_c_cancels_the_pose_under_way_and_keeps_the_session(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    desk.stuck = True

    def interrupted(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slrig.cli.calibrate_walk.time.sleep", interrupted)
    result = slrig("calibrate", "run", *BOARD_OPTIONS, typed="\n")
    assert result.exit_code == INTERRUPTED
    assert desk.asked[-1][:2] == ("POST", f"/calibration/{ID}/pose/1/cancel")
    assert f"--id {ID[:8]}" in result.stdout


def test_run_takes_up_a_session_or_opens_one_for_the_usual_board(desk: Desk) -> None:
    result = slrig("calibrate", "run", "--id", ID[:6], typed="q\n")
    assert (result.exit_code, desk.asked) == (0, []), result.output
    assert BOARD.title in result.stdout
    assert f"'999' is the beginning of no calibration's id; there are: {ID[:8]}" in refused(run("run", "--id", "999"))
    result = run("run")
    assert result.exit_code == 0, result.output
    board = desk.asked[0][2]["board"]
    assert (board["kind"], board["corners"], board["square_mm"], board["marker_mm"]) == ("charuco", [11, 8], 12.0, 9.0)
    assert "charuco, 11 x 8 inner corners, squares of 12 mm, markers of 9 mm from DICT_5X5_250" in result.stderr


def test_script_shoots_every_position_then_solves(desk: Desk) -> None:
    more = ("--position", "pose 1", "--activate", "--exposure-s", "0.02", "--board-shape", "bowed")
    printed = done("run", *BOARD_OPTIONS, "--scripted", *more)
    asked = {"positions": ["pose 1"], "exposure_s": 0.02, "if_busy": "queue"}
    assert desk.asked[1] == ("POST", f"/calibration/{ID}/script", asked)
    assert [path.rpartition("/")[2] for _, path, _ in desk.asked[2:]] == ["solve", "activate"]
    assert desk.asked[2][2] == {"board_shape": "bowed"}
    for number in (1, 2, 3):
        assert f"pose {number} accepted" in printed


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[httpx2.Request]:
    """A service that keeps two calibrations; its requests."""
    requests: list[httpx2.Request] = []
    desk = Desk()
    desk.state = "solved"
    first: Mapping[str, Any] = desk.session()
    second = {**first, "id": OTHER, "active": True, "links": {**first["links"], "self": f"/calibration/{OTHER}"}}
    known = {"value": -0.02, "sigma": 0.011, "sigmas": 1.8, "words": "shorter"}
    unknown = {"value": 0.5, "sigma": None, "sigmas": None, "words": "farther"}
    left = {"focal_percent": known, "principal_px": known, "rotation_deg": None, "baseline_mm": None}
    moved = {"moved_rms_mm": 0.01, "moved_max_mm": 0.03, "turn_deg": 0.002, "shift_mm": 0.1}
    compared = {
        "first": ID,
        "second": OTHER,
        "devices": {"left": left, "projector": {**left, "principal_px": unknown, "baseline_mm": unknown}},
        "missing": [],
        "words": ["points move by 0.010 mm rms, 0.030 mm at most"],
        **moved,
    }
    ComparisonBody.model_validate(compared)
    answers: dict[str, Any] = {
        "/calibration": {"calibrations": [first, second], "active": OTHER},
        "/calibration/compare": compared,
        f"/calibration/{ID}/calibration.json": {},
    }

    def answer(request: httpx2.Request) -> httpx2.Response:
        requests.append(request)
        return httpx2.Response(200, json=answers.get(request.url.path, first))

    client = Client("http://127.0.0.1:1", "key", transport=httpx2.MockTransport(answer))
    monkeypatch.setattr(ServiceOptions, "client", lambda _self: client)
    monkeypatch.setattr(Client, "__exit__", lambda *_: None)
    return requests


def test_kept_calibrations_are_listed_shown_compared_and_used(kept: list[httpx2.Request]) -> None:
    rows = done("list").splitlines()
    assert [row.split()[0] for row in rows] == ["id", ID[:8], OTHER[:8]]
    assert ["in use" in row for row in rows] == [False, False, True]
    assert json.loads(done("list", "--json"))["active"] == OTHER
    assert "1810.40 ± 0.21" in done("show", ID[:4])
    assert kept[-1].url.path == f"/calibration/{ID}"
    assert json.loads(done("show", ID, "--json"))["id"] == ID
    words = " ".join(done("compare", ID[:4], OTHER[:4]).split())
    assert dict(kept[-1].url.params) == {"first": ID, "second": OTHER}
    for part in ("points move by 0.010 mm rms, 0.030 mm at most", "-0.0200 ± 0.0110 (1.8 σ)", "+0.5000"):
        assert part in words
    for word in ("activate", "deactivate"):
        done(word, OTHER[:4])
        assert (kept[-1].method, kept[-1].url.path) == ("POST", f"/calibration/{OTHER}/{word}")


def test_check_shows_the_halves_of_a_kept_solve(kept: list[httpx2.Request], monkeypatch: pytest.MonkeyPatch) -> None:
    words = " ".join(done("check", ID[:4]).split())
    for part in ("differ by 0.017 mm at a point, 0.89 × the stated", "10 odd, 9 even", "0.0193 mm (1 σ)"):
        assert part in words
    assert kept[-1].method == "GET"
    found = json.loads(done("check", ID, "--json"))
    assert found["odd_even"]["ratio"] == pytest.approx(0.0171 / 0.0193)
    assert found["expected"]["point_mm"] > 0
    whole = Client.get
    lacking: dict[str, Any] = {"result": None}

    def get(client: Client, path: str) -> Any:
        found = whole.__get__(client, Client)(path)
        return {**found, **lacking} if path.endswith(ID) else found

    monkeypatch.setattr(Client, "get", get)
    assert "has no solve to check: it is solved" in run("check", ID).stderr
    lacking |= {"state": "solved", "imported": True}
    assert "it is imported, without its poses" in run("check", ID).stderr
    # A result on record from before solves were halved.
    lacking["result"] = {"poses": ["pose 1"] * 7, "verdict": {}}
    assert "expected 8 poses or more" in refused(run("check", ID))


def test_calibrations_are_exported_and_imported_as_files(kept: list[httpx2.Request], tmp_path: Path) -> None:
    done("export", ID, tmp_path / "out.json")
    assert (tmp_path / "out.json").read_bytes() == b"{}"
    assert "expected a name that ends in .json" in refused(run("export", ID, tmp_path / "rig.txt"))
    assert "has no report.html. It has: calibration.json" in refused(run("export", ID, tmp_path / "report.html"))
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
    calibration = solved_result().calibration
    write_calibration(tmp_path / "rig.json", calibration)
    done("import", tmp_path / "rig.json", "--label", "from the shop & back")
    assert dict(kept[-1].url.params) == {"label": "from the shop & back"}
    assert json.loads(kept[-1].content) == json.loads((tmp_path / "rig.json").read_text())
    write_opencv_calibration(tmp_path / "rig.yml", calibration)
    done("import", tmp_path / "rig.yml")
    assert json.loads(kept[-1].content)["cameras"]["left"]["matrix"][0][0] == 1810.4
    (tmp_path / "bad.json").write_text('{"format": "slrig-calibration"}')
    assert "bad.json" in refused(run("import", tmp_path / "bad.json"))


def test_commands_that_need_a_service_say_how_to_start_one(tmp_path: Path) -> None:
    for arguments in (["list"], ["show", "1"], ["compare", "1", "2"], ["check", tmp_path / "none"], ["run"]):
        assert "slrig serve RIG" in refused(run(*arguments, "--url", "http://127.0.0.1:9"))

"""`slrig calibrate board` and `solve`: what they ask of a folder, what they say, and their exit codes."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from slrig.bundle import read_calibration, read_opencv_calibration
from slrig.calibrate.pose_judging import summary
from slrig.calibration.board import USUAL_BOARD, BoardShape
from slrig.cli.calibration_screen import tell_result
from slrig.errors import PoseRefusedError, SolveRefusedError
from tests.unit.calibrate.solved import BOARD, BUMP, BUMPED, POSES, read_poses, solved_result
from tests.unit.calibrate_command import refused, run

GIVEN = POSES[:6]
BOARD_OPTIONS = ["--board", "chessboard", "--corners", "11x8", "--square-mm", "12"]


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
    """A folder of six poses."""
    for name in GIVEN:
        bundle(tmp_path / "poses", name)
    return tmp_path / "poses"


@pytest.fixture
def solving(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Reading and solving give the calibration made by hand; what they were asked is kept."""
    asked: dict[str, Any] = {}
    known = read_poses()

    def read_pose(folder: Path, board: object, name: str) -> object:
        assert board == BOARD
        assert name in {folder.name, folder.parent.name}
        return known[name]

    def solve_poses(board: object, cameras: object, projector: object, given: Any, **options: Any) -> object:
        asked.update(board=board, cameras=cameras, projector=projector, poses=[each.observation.name for each in given])
        asked.update(earlier=options["earlier"], board_shape=options["board_shape"])
        options["progress"]("adjustment", 0.5, "")
        return solved_result()

    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", read_pose)
    monkeypatch.setattr("slrig.calibrate.solving.solve_poses", solve_poses)
    return asked


def test_loading_the_command_loads_nothing_heavy() -> None:
    code = (
        "import sys, slrig.cli.calibrate\n"
        "heavy = {'numba', 'numpy', 'cv2', 'fastapi', 'scipy', 'pydantic', 'httpx2'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert found.stdout.strip() == "[]"


def test_folder_of_poses_becomes_a_calibration(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    output = tmp_path / "rig.json"
    result = run("solve", poses, *BOARD_OPTIONS, "--output", output)
    assert result.exit_code == 0, result.output
    assert solving["poses"] == list(GIVEN)
    assert str(solving["cameras"]["left"]) == "1280 x 1024"
    assert str(solving["projector"]) == "1280 x 800"
    written = read_calibration(output)
    assert written.solved is not None
    assert written.cameras["left"].matrix[0, 0] == 1810.4
    for words in ("1810.40 ± 0.21", "842.40 ± 0.61", "19 used of 20", f"{BUMPED}  left moved by 1.9 px", str(output)):
        assert words in result.stdout, words
    assert "flat as far as the poses tell: 0.031 ± 0.012 mm" in result.stdout
    assert solving["board_shape"] is BoardShape.AUTO
    # Off a terminal every stage is a line of its own.
    stages = [line.split("%  ")[1].split("   ")[0] for line in result.stderr.splitlines()]
    assert stages[:2] == ["loading", "reading pose_00"]
    assert stages[-2:] == ["adjustment", "done"]


def test_a_folder_of_poses_is_checked_without_writing_anything(
    poses: Path, solving: dict[str, Any], tmp_path: Path
) -> None:
    result = run("check", poses, *BOARD_OPTIONS, "--board-shape", "flat")
    assert result.exit_code == 0, result.output
    assert (solving["poses"], solving["board_shape"]) == (list(GIVEN), BoardShape.FLAT)
    assert "0.89 × what is stated for two halves" in " ".join(result.stdout.split())
    assert [path.name for path in tmp_path.iterdir()] == ["poses"]
    # What names no folder is the beginning of an id.
    assert "slrig serve RIG" in refused(run("check", tmp_path / "none", "--url", "http://127.0.0.1:9"))


def test_json_says_what_the_screen_says(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    bundle(poses, "pose_20", camera="left")
    (poses / "pose_20" / "bundle.json").write_text('{"format": ')
    result = run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert {name: document[name] for name in summary(solved_result())} == summary(solved_result())
    assert list(document["refused"]) == ["pose_20"]
    assert document["output"] == str(tmp_path / "rig.json")
    assert solving["poses"] == list(GIVEN)


@pytest.mark.slow
def test_a_board_may_be_said_to_be_flat(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    run("solve", poses, *BOARD_OPTIONS, "--board-shape", "flat", "--output", tmp_path / "rig.json")
    assert solving["board_shape"] is BoardShape.FLAT


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".yml", ".xml"])
def test_output_may_be_opencvs(poses: Path, solving: dict[str, Any], tmp_path: Path, ending: str) -> None:
    output = tmp_path / f"rig{ending}"
    assert run("solve", poses, *BOARD_OPTIONS, "--output", output).exit_code == 0
    assert solving["poses"]
    written = read_opencv_calibration(output)
    assert written.projector is not None
    assert written.projector.matrix[1, 2] == 842.4


@pytest.mark.slow
def test_report_is_written_with_what_each_camera_saw(
    poses: Path, solving: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import numpy as np

    monkeypatch.setattr(
        "slrig.calibrate.pose_pictures.white_frame",
        lambda _folder, _camera: np.full((1024, 1280), 80, dtype=np.uint8),
    )
    report = tmp_path / "report.html"
    result = run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json", "--report", report)
    assert result.exit_code == 0, result.output
    assert solving["poses"]
    text = report.read_text(encoding="utf-8")
    assert text.count("<img ") == len(GIVEN)
    assert "Calibration from poses" in text


@pytest.mark.slow
def test_earlier_calibration_is_what_the_scale_is_held_against(
    poses: Path, solving: dict[str, Any], tmp_path: Path
) -> None:
    assert run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "first.json").exit_code == 0
    asked = [solving.pop("earlier")]
    second = ["--output", tmp_path / "second.json", "--earlier", tmp_path / "first.json"]
    assert run("solve", poses, *BOARD_OPTIONS, *second).exit_code == 0
    asked.append(solving.pop("earlier"))
    assert asked[0] is None
    assert asked[1].cameras["left"].matrix[0, 0] == 1810.4
    absent = ["--output", tmp_path / "third.json", "--earlier", tmp_path / "absent.json"]
    assert "absent.json" in refused(run("solve", poses, *BOARD_OPTIONS, *absent))


def test_broken_bundle_is_named_and_left_out(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    (poses / "pose_04" / "bundle.json").write_text('{"format": "slrig-bundle", "vers')
    result = run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json")
    assert result.exit_code == 0, result.output
    assert "pose_04" not in solving["poses"]
    told = result.stdout.partition("refused")[2]
    assert told.split()[0] == "pose_04"
    assert "bundle.json:expectedJSON" in "".join(told.split())


def test_pose_that_cannot_be_used_is_named_with_its_cause(
    poses: Path, solving: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = read_poses()

    def read_pose(_folder: Path, _board: object, name: str) -> object:
        if name == "pose_02":
            message = "pose 'pose_02': half a board: move it fully into view"
            raise PoseRefusedError(message)
        return known[name]

    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", read_pose)
    result = run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json")
    assert result.exit_code == 0, result.output
    assert "pose_02" not in solving["poses"]
    assert "refused  pose_02  half a board: move it fully into view" in result.stdout


@pytest.mark.slow
def test_two_poses_the_same_are_judged_as_live_ones_are(
    poses: Path, solving: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = {**read_poses(), "pose_05": read_poses()["pose_04"]}
    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", lambda _folder, _board, name: known[name])
    result = run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json")
    assert result.exit_code == 0, result.output
    assert len(solving["poses"]) == len(GIVEN) - 1
    assert "the same as pose_04" in " ".join(result.stdout.split())


def test_wrong_board_is_told_once_for_all_poses(
    poses: Path, solving: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_pose(_folder: Path, _board: object, name: str) -> object:
        message = f"pose '{name}': another board: expected 9 x 9 corners, found 11 x 8"
        raise PoseRefusedError(message)

    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", read_pose)
    options = ["--board", "chessboard", "--corners", "9x9", "--square-mm", "12", "--output", tmp_path / "rig.json"]
    words = refused(run("solve", poses, *options))
    assert "none of its poses (6) shows a chessboard 9x9, 12 mm that can be used" in words
    assert words.count("another board: expected 9 x 9 corners, found 11 x 8") == 1
    assert "pose_00 to pose_05 (6)" in words
    assert "--corners counts inner corners" in words
    assert not solving
    assert not (tmp_path / "rig.json").exists()


def test_poses_of_another_rig_are_named(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    bundle(poses, "pose_30", size_px=(640, 480))
    words = refused(run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json"))
    assert "pose 'pose_30' was captured with another rig" in words
    assert "640 x 480" in words
    assert not solving


def test_refused_solve_names_the_poses_that_were_not_used(
    poses: Path, solving: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_given: object, **_options: object) -> object:
        message = "all boards are parallel: tilt them"
        raise SolveRefusedError(message)

    monkeypatch.setattr("slrig.calibrate.solving.solve_poses", refuse)
    (poses / "pose_04" / "bundle.json").write_text("{")
    words = refused(run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "rig.json"))
    assert words.startswith("all boards are parallel: tilt them\n1 pose was not used:\n  pose_04: ")
    assert not solving
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.slow
def test_poses_as_the_service_keeps_them_are_solved(poses: Path, solving: dict[str, Any], tmp_path: Path) -> None:
    for pose in sorted(poses.iterdir()):
        (tmp_path / "kept" / pose.name).mkdir(parents=True)
        pose.rename(tmp_path / "kept" / pose.name / "bundle")
    result = run("solve", tmp_path / "kept", *BOARD_OPTIONS, "--output", tmp_path / "rig.json")
    assert result.exit_code == 0, result.output
    assert solving["poses"] == list(GIVEN)


def test_folder_that_is_none_of_poses_is_refused(tmp_path: Path) -> None:
    output = ["--output", tmp_path / "rig.json"]
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "others" / "photos").mkdir(parents=True)
    bundle(tmp_path, "one")
    for folder, words in (
        ("absent", "found nothing there"),
        ("file", "found a file there"),
        ("empty", "it holds no folders"),
        ("others", "it holds 1 folder without a bundle.json"),
        ("one", "this is one bundle itself: name the folder that holds it"),
    ):
        told = refused(run("solve", tmp_path / folder, *BOARD_OPTIONS, *output))
        assert "expected a folder with one bundle per pose" in told
        assert words in told


def test_output_that_cannot_be_written_is_refused_before_the_work(
    poses: Path, solving: dict[str, Any], tmp_path: Path
) -> None:
    for output, words in (
        (tmp_path / "rig.txt", "expected a name that ends in .json"),
        (tmp_path / "absent" / "rig.json", "there is no folder"),
    ):
        assert words in refused(run("solve", poses, *BOARD_OPTIONS, "--output", output))
    (tmp_path / "folder.json").mkdir()
    told = refused(run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "folder.json"))
    assert "found a folder" in told
    told = refused(
        run("solve", poses, *BOARD_OPTIONS, "--output", tmp_path / "a.json", "--report", tmp_path / "no" / "r")
    )
    assert "--report" in told
    assert not solving


def test_board_is_written_to_be_printed(tmp_path: Path) -> None:
    options = ["--board", "charuco", "--corners", "9x6", "--square-mm", "15"]
    result = run("board", *options, "--output", tmp_path / "board.svg")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "board.svg").read_text(encoding="utf-8").startswith("<")
    assert "slrig calibrate solve FOLDER --board charuco --corners 9x6 --square-mm 15" in result.stdout
    assert "expected a name that ends in .pdf or .svg" in refused(
        run("board", *options, "--output", tmp_path / "b.png")
    )


def test_board_that_is_not_named_is_the_usual_one(tmp_path: Path) -> None:
    named = ["--board", "charuco", "--corners", "11x8", "--square-mm", "12"]
    for number, (options, square_mm) in enumerate(
        (
            ([], "12"),
            (["--board", "charuco"], "12"),
            (["--corners", "11 x 8"], "12"),
            (["--square-mm", "11.94"], "11.94"),
        )
    ):
        sheet, whole = tmp_path / f"{number}.svg", tmp_path / f"{number}-whole.svg"
        result = run("board", *options, "--output", sheet)
        assert result.exit_code == 0, result.output
        assert f"charuco, 11 x 8 inner corners, squares of {square_mm} mm" in result.stderr
        assert run("board", *named[:4], "--square-mm", square_mm, "--output", whole).stderr == ""
        # The sheet that is printed is that of the same board named in full: 12 x 9 squares.
        assert sheet.read_bytes() == whole.read_bytes()
        assert f"--corners 11x8 --square-mm {square_mm}" in sheet.read_text(encoding="utf-8")


def test_help_names_the_usual_board() -> None:
    told = " ".join(run("board", "--help").stdout.replace("│", " ").split())
    assert f"Default: {USUAL_BOARD.kind}." in told
    assert f"as {USUAL_BOARD.columns}x{USUAL_BOARD.rows} (default)" in told
    assert f"measured on the print (default {USUAL_BOARD.square_mm:g})" in told


def test_board_that_is_none_is_refused(poses: Path, tmp_path: Path) -> None:
    for options, words in (
        (["--board", "chessboard", "--corners", "11", "--square-mm", "12"], "--corners: expected COLUMNSxROWS"),
        (["--board", "chessboard", "--corners", "11x8", "--square-mm", "12", "--marker-mm", "8"], "marker_mm"),
        (["--board", "chessboard", "--corners", "1x8", "--square-mm", "12"], "found 1 x 8"),
        (["--board", "chessboard", "--corners", "11x8"], "Missing: --square-mm."),
        (["--board", "circles"], "Missing: --corners, --square-mm."),
        (["--corners", "9x6"], "Missing: --board, --square-mm."),
        (["--square-mm", "12", "--marker-mm", "13"], "0.1 to 0.99 of the square's 12 mm, found 13"),
        (["--dictionary", "DICT_4X4_50"], "needs 54 markers and DICT_4X4_50 has 50"),
    ):
        assert words in refused(run("solve", poses, *options, "--output", tmp_path / "rig.json"))
    assert run("solve", poses, "--board", "triangles", "--output", tmp_path / "rig.json").exit_code == 2


@pytest.mark.slow
@pytest.mark.shared
def test_real_poses_are_solved_and_told(shared: Path, tmp_path: Path) -> None:
    boards = shared / "captures" / "boards"
    if not boards.is_dir():
        pytest.skip(f"no captured boards in {boards}")
    board = ["--board", "chessboard", "--corners", "7x9", "--square-mm", "75"]
    output, report = tmp_path / "rig.json", tmp_path / "report.html"
    result = run("solve", boards, *board, "--output", output, "--report", report, "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["poses"] == ["pose_0", "pose_1", "pose_2", "pose_3"]
    assert document["refused"] == {}
    # Four poses: the numbers are what its README asks for, and the verdict says what four poses are worth.
    assert document["devices"]["cam0"]["rms_px"] <= 0.225
    assert document["devices"]["projector"]["rms_px"] <= 0.16
    assert document["verdict"]["grade"] != "good"
    projector = read_calibration(output).projector
    assert projector is not None
    assert 768 < projector.matrix[1, 2] < 1000
    assert report.read_text(encoding="utf-8").count("<img ") == 4


def test_screen_fits_on_one_and_holds_the_figures() -> None:
    stream = io.StringIO()
    tell_result({**summary(solved_result()), "refused": {"pose_20": "no board"}}, Console(file=stream, width=100))
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

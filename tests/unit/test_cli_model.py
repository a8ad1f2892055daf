"""`slrig model` of scans and of views that it shoots, by a rig or a service; `slrig turntable planes`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import Result

from slrig.bundle.options import (
    AxisSource,
    Poses,
    TurntableRecord,
    encode_poses,
    encode_turntable,
    read_poses,
    read_turntable,
)
from slrig.bundle.sidecars import TurntableAngle, write_turntable_angle
from slrig.cli import model_shoot
from slrig.client.connection import Progress
from slrig.devices import Rig
from slrig.errors import ConfigError, DeviceGoneError, ServiceError
from slrig.examples import EXAMPLES
from slrig.model import MeasuredAxis, PlaneKind, TurntablePlane
from slrig.model_jobs import plan
from slrig.model_jobs.turntable import with_axis
from slrig.multiview import registration
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply
from slrig.scan.plan import ScanPlan
from tests.turned_views import AXIS, AXIS_POINT_MM, bumpy, displacement_mm, seen, vase
from tests.unit.capture.fake_rig import FakeTurntable, fake_rig
from tests.unit.command import done, refused, slrig
from tests.unit.multiview.test_turntable_planes import AXIS as PLATE_AXIS
from tests.unit.multiview.test_turntable_planes import PLATE, WALL, joined

ANGLE = 40.0
STAGE = [
    "--angle", str(ANGLE), "--axis-point", *map(str, np.add(AXIS_POINT_MM, [0.3, 0.0, -0.2])),
    "--axis-direction", *map(str, AXIS),
]  # fmt: skip


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scans 9, 10 and 11 of an object on a turntable, and one scan's mesh of a vase beside it."""
    folder = tmp_path_factory.mktemp("scans")
    turned = seen(bumpy, [0.0, ANGLE, 2 * ANGLE], pitch_mm=1.5)
    for number, view in zip((9, 10, 11), turned.noisy(0, length_mm=2.0), strict=True):
        (folder / "all" / f"scan-{number}").mkdir(parents=True)
        (folder / "all" / f"scan-{number}" / "mesh.ply").write_bytes(encode_mesh_ply(view))
    for number, view in enumerate(seen(vase, [0.0, ANGLE], pitch_mm=1.5).noisy(0, length_mm=2.0)):
        (folder / f"vase-{number}.ply").write_bytes(encode_mesh_ply(view))
    return folder


def model(*words: object, typed: str = "") -> Result:
    return slrig("model", *words, typed=typed, COLUMNS="120")


@pytest.mark.slow
def test_scans_of_a_stage_are_placed_and_their_poses_place_them_again(scans: Path, tmp_path: Path) -> None:
    done = model(scans / "all", "--output", tmp_path / "model", *STAGE)
    assert done.exit_code == 0, done.output
    table = done.stdout.splitlines()
    assert [line.split()[0] for line in table[:4]] == ["view", "scan-9", "scan-10", "scan-11"]
    assert any(line.startswith("axis ") and "±" in line for line in table)
    report = json.loads((tmp_path / "model" / "report.json").read_text())
    assert len(report["pairs"]) == 3
    assert np.shape(report["registration"]["covariance"]) == (12, 12)
    assert report["axis"]["turntable_error_deg"] == pytest.approx([0, 0, 0], abs=0.05)
    known = read_poses(tmp_path / "model" / "poses.json")
    assert list(known.poses) == ["scan-9", "scan-10", "scan-11"]
    # One mesh in the frame of the first scan: the second one's vertices follow its own.
    placed = decode_mesh_ply((tmp_path / "model" / "placed.ply").read_bytes())
    views = [decode_mesh_ply((scans / "all" / name / "mesh.ply").read_bytes()) for name in known.poses]
    first, second = len(views[0].vertices_mm), len(views[1].vertices_mm)
    assert len(placed.faces) == sum(len(view.faces) for view in views)
    pose = known.poses["scan-10"]
    wanted = views[1].vertices_mm @ pose[:3, :3].T + pose[:3, 3]
    assert placed.vertices_mm[first : first + second] == pytest.approx(wanted, abs=1e-4)
    whole = decode_mesh_ply((tmp_path / "model" / "model.ply").read_bytes())
    assert report["model"]["triangles"] == len(whole.faces) < len(placed.faces)
    assert any(line.startswith("mesh ") and "seen by one view only" in line for line in table)
    # Two of them, the other way round, from the poses that were written.
    names = ["scan-11", "scan-10"]
    again = model(
        *(scans / "all" / name for name in names), "--output", tmp_path / "two", "--poses",
        tmp_path / "model" / "poses.json",
    )  # fmt: skip
    assert again.exit_code == 0, again.output
    two = read_poses(tmp_path / "two" / "poses.json").poses
    back = np.linalg.inv(known.poses["scan-11"]) @ known.poses["scan-10"]
    assert displacement_mm(views[1], two["scan-10"], back) < 0.02


def test_error_of_a_start_is_stated_once() -> None:
    assert plan.START_ERROR_MM == registration.START_ERROR_MM


@pytest.mark.slow
def test_free_motion_of_a_vase_is_reported(scans: Path, tmp_path: Path) -> None:
    # What is known of the turntable is in a file: its axis, and a plate that hides a part of the vase.
    views = [decode_mesh_ply((scans / f"vase-{number}.ply").read_bytes()) for number in (0, 1)]
    height = (views[0].vertices_mm - AXIS_POINT_MM) @ AXIS
    foot = TurntablePlane(PlaneKind.PLATE, AXIS_POINT_MM + np.quantile(height, 0.1) * AXIS, AXIS, 0.02, 50.0, 1.0)
    known = MeasuredAxis(np.add(AXIS_POINT_MM, [0.3, 0.0, -0.2]), AXIS, 1e-4 * np.eye(6))
    (tmp_path / "turntable.json").write_bytes(encode_turntable(TurntableRecord(known, (foot,))))
    words = ("--angle", ANGLE, "--turntable", tmp_path / "turntable.json")
    done = model(scans / "vase-0.ply", scans / "vase-1.ply", "--output", tmp_path / "model", *words)
    assert done.exit_code == 0, done.output
    assert "of the views lay behind the turntable's planes" in done.stdout
    assert "free      1 view may turn about an axis along (-0.0" in done.stdout
    assert "held as the start has it" in done.stdout
    (free,) = json.loads((tmp_path / "model" / "report.json").read_text())["free"]
    assert (free["view"], free["motion"]) == ("vase-1", "turn")


@pytest.mark.slow
def test_scans_in_another_order_than_the_stage_turned_in_are_refused(scans: Path, tmp_path: Path) -> None:
    named = [scans / "all" / f"scan-{number}" for number in (9, 10, 11)]
    for number, folder in enumerate(named):
        (folder / "report.json").write_text(json.dumps({"turntable": {"angle_deg": 320 + ANGLE * number}}))
    try:
        # As a shell sorts them.
        shuffled = [named[1], named[2], named[0]]
        refused = model(*shuffled, "--output", tmp_path / "none", *STAGE)
        assert (refused.exit_code, (tmp_path / "none").exists()) == (2, False)
        assert "scan-10 at 360°, scan-11 at 400°, scan-9 at 320°" in " ".join(refused.output.split())
        in_order = model(*named, "--output", tmp_path / "model", *STAGE)
        assert in_order.exit_code == 0, in_order.output
    finally:
        for folder in named:
            (folder / "report.json").unlink()


def test_what_is_missing_is_said(scans: Path, tmp_path: Path) -> None:
    poses = tmp_path / "some.json"
    poses.write_bytes(encode_poses(Poses({"scan-9": np.eye(4)})))
    folder, to = scans / "all", ("--output", tmp_path / "none")
    for words, expected in (
        ([folder, *to], "found none of them"),
        ([folder, *to, "--angle", 40], "found --angle"),
        ([folder, *to, "--angle", 40, "--axis", poses], "expected the key axis"),
        ([folder, *to, "--poses", poses], "found none of scan-10, scan-11"),
        ([folder / "scan-9", *to, *STAGE], "expected two scans or more"),
        ([folder / "scan-9", folder / "scan-9", *to, *STAGE], "two called scan-9"),
        ([tmp_path, *to, *STAGE], "expected a scan's folder with mesh.ply"),
        ([folder, *to, *STAGE[:2], *STAGE[6:]], "together"),
        ([folder, *to, "--markers"], "expected the frames that it was made of"),
        ([folder, *to, "--markers", "--unknown"], "leave out the other one"),
        ([folder, *to, *STAGE, "--unknown"], "found --angle"),
        ([folder, *to, "--unknown", "--dictionary", "DICT_4X4_50"], "expected --markers with it"),
    ):
        refused = model(*words)
        assert (refused.exit_code, expected in refused.stderr) == (2, True), (words, refused.output)
    assert not (tmp_path / "none").exists()


def test_nothing_that_is_read_is_replaced(scans: Path, tmp_path: Path) -> None:
    own = tmp_path / "model"
    own.mkdir()
    (own / "report.json").write_text('{"format": "slrig-model"}')
    manual = own / "by-hand.json"
    manual.write_bytes(encode_poses(Poses({f"scan-{number}": np.eye(4) for number in (9, 10, 11)})))
    scan = tmp_path / "scan"
    scan.mkdir()
    (scan / "report.json").write_text('{"format": "slrig-report"}')
    for words, expected in (
        ([scans / "all", "--output", scans / "all", *STAGE], "would be replaced"),
        ([scans / "all", "--output", scans / "all" / "scan-9", *STAGE], "would be replaced"),
        ([scans / "all", "--output", own, "--poses", manual], "would be replaced"),
        ([scans / "all", "--output", scan, *STAGE], "a folder with other files in it"),
    ):
        refused = model(*words)
        assert (refused.exit_code, expected in refused.stderr) == (2, True), (words, refused.output)
    assert manual.exists()


def test_file_of_poses_holds_rotations_and_an_axis(tmp_path: Path) -> None:
    file, axis = tmp_path / "poses.json", (np.ones(3), np.array([0.0, 0.0, 1.0]))
    for poses, expected in (
        (Poses({"front": np.diag([1.0, 1.0, -1.0, 1.0])}), "expected a rotation"),
        (Poses({"front": np.diag([1.01, 1.0, 1.0, 1.0])}), "expected a rotation"),
        (Poses({}, (np.zeros(3), np.zeros(3))), "vector with a length"),
    ):
        file.write_bytes(encode_poses(poses))
        with pytest.raises(ConfigError, match=expected):
            read_poses(file)
    for rotation in Rotation.random(50, rng=np.random.default_rng(2)):
        pose = np.eye(4)
        pose[:3, :3] = np.round(rotation.as_matrix(), 5)
        file.write_bytes(encode_poses(Poses({"front": pose}, axis)))
        turn = read_poses(file).poses["front"][:3, :3]
        assert np.abs(turn @ turn.T - np.eye(3)).max() < 1e-12
        assert np.abs(turn - pose[:3, :3]).max() < 3e-5


@pytest.mark.slow
def test_scans_of_unknown_places_are_placed_and_a_vase_is_refused(scans: Path, tmp_path: Path) -> None:
    done = model(scans / "all", "--output", tmp_path / "model", "--unknown")
    assert done.exit_code == 0, done.output
    assert list(read_poses(tmp_path / "model" / "poses.json").poses) == ["scan-9", "scan-10", "scan-11"]
    refused = model(scans / "vase-0.ply", scans / "vase-1.ply", "--output", tmp_path / "vase", "--unknown")
    assert (refused.exit_code, (tmp_path / "vase").exists()) == (2, False), refused.output
    assert "or state where to start from" in " ".join(refused.output.split())


TABLE = ["--axis-point", *map(str, AXIS_POINT_MM), "--axis-direction", *map(str, AXIS)]
RIG = EXAMPLES / "rigs" / "demo.toml"


class Bench:
    """Shoots meshes that were made before. shot : the angles; faults : what the next view at an angle raises."""

    def __init__(self) -> None:
        self.table: FakeTurntable | None = None
        self.shot: list[float | None] = []
        self.faults: dict[float, Exception] = {}
        angles = [0.0, 40.0, 80.0, 120.0]
        self.meshes = dict(zip(angles, seen(bumpy, angles, pitch_mm=1.5).noisy(0, length_mm=2.0), strict=True))

    def open_rig(self, _: object) -> Rig:
        return replace(fake_rig().rig, positioner=self.table)

    def shoot(self, _: Rig, plan: ScanPlan, output: Path, number: int) -> None:
        assert plan.turn_deg is not None
        self.shot.append(plan.turn_deg)
        if (error := self.faults.pop(plan.turn_deg, None)) is not None:
            raise error
        (output / f"view-{number}").mkdir(parents=True)
        (output / f"bundle-{number}").mkdir()
        write_turntable_angle(
            output / f"bundle-{number}", TurntableAngle(angle_deg=plan.turn_deg, turned_by=plan.turned_by)
        )
        (output / f"view-{number}" / "mesh.ply").write_bytes(encode_mesh_ply(self.meshes[plan.turn_deg]))


@pytest.fixture(scope="module")
def made() -> Bench:
    return Bench()


@pytest.fixture
def bench(made: Bench, monkeypatch: pytest.MonkeyPatch) -> Bench:
    made.table, made.shot, made.faults = None, [], {}
    monkeypatch.setattr(model_shoot, "open_rig", made.open_rig)
    monkeypatch.setattr(model_shoot, "_shot", made.shoot)
    return made


@pytest.mark.slow
def test_a_person_turns_leaves_and_goes_on_in_the_same_folder(bench: Bench, tmp_path: Path) -> None:
    shoot = ["--shoot", 9, "--rig", RIG, "--manual", "--output", tmp_path, *TABLE]
    bench.faults = {40.0: DeviceGoneError("left was unplugged")}
    done = model(*shoot, typed="\n\nq\n")
    assert done.exit_code == 0, done.output
    assert "turn the object by about 40°, to 40° in all, then press Enter" in done.stdout
    assert "view-2: left was unplugged" in done.stderr
    assert bench.shot == [0.0, 40.0, 40.0]
    assert [line.split()[0] for line in done.stdout.splitlines() if line.startswith("view-")] == ["view-1", "view-2"]
    again = model(*shoot, typed="\nq\n")
    assert again.exit_code == 0, again.output
    assert bench.shot == [0.0, 40.0, 40.0, 80.0]
    report = json.loads((tmp_path / "model" / "report.json").read_bytes())
    assert [each["name"] for each in report["views"]] == ["view-1", "view-2", "view-3"]
    assert report["axis"]["turntable_error_deg"] == pytest.approx([0, 0, 0], abs=0.05)
    # Another number of views changes nothing of where those stood that there are.
    fewer = model("--shoot", 3, "--rig", RIG, "--manual", "--output", tmp_path, *TABLE)
    assert fewer.exit_code == 0, fewer.output
    assert json.loads((tmp_path / "model" / "poses.json").read_bytes())["views"][2]["name"] == "view-3"
    assert json.loads((tmp_path / "model" / "report.json").read_bytes())["axis"][
        "turntable_error_deg"
    ] == pytest.approx([0, 0, 0], abs=0.05)


@pytest.mark.slow
def test_table_turns_and_a_view_that_fails_is_named(bench: Bench, tmp_path: Path) -> None:
    bench.table = FakeTurntable()
    bench.faults = {
        angle: DeviceGoneError("left was unplugged") for angle in (120.0, 160.0, 200.0, 240.0, 280.0, 320.0)
    }
    done = model("--shoot", 9, "--rig", RIG, "--output", tmp_path, *TABLE)
    assert done.exit_code == 0, done.output
    assert "view-4, at 120°, is not in it: left was unplugged" in done.stdout
    assert len(json.loads((tmp_path / "model" / "report.json").read_bytes())["notes"]) == 6


@pytest.mark.slow
def test_what_cannot_be_shot_is_said(bench: Bench, tmp_path: Path) -> None:
    rig = ["--shoot", 9, "--rig", RIG, "--output", tmp_path]
    for words, asked in (
        ("this rig has no turntable", [*rig, *TABLE]),
        ("expected the turntable's axis", [*rig, "--manual"]),
        ("expected scans, or --shoot N", ["--output", tmp_path]),
        ("expected scans, or --shoot N", ["--output", tmp_path, "--manual", tmp_path]),
        ("leave --angle and --poses out", [*rig, "--angle", 40, *TABLE]),
    ):
        refused = model(*asked)
        assert refused.exit_code == 2
        assert words in refused.output
    bench.faults = {0.0: DeviceGoneError("left was unplugged")}
    failed = model(*rig, "--manual", *TABLE, typed="q\n")
    assert (failed.exit_code, "0 of 9 views succeeded" in failed.stderr) == (2, True), failed.output
    assert bench.shot == [0.0]


class Models:
    """The part of a client that has to do with models. asked : what was called, in order."""

    def __init__(self, state: str) -> None:
        self.asked: list[Any] = []
        self.state = state

    def shoot(self, **request: Any) -> dict[str, Any]:
        self.asked.append(request)
        return {"id": "m"}

    def follow(self, _: str) -> Iterator[Progress]:
        for number, stage in enumerate(("view", "turn", "view", "turn", "done"), 1):
            yield Progress(number=number, stage=stage, fraction=0.1, detail=f"turn for view {number}")

    def view(self, _: str, *, again: bool, if_busy: str) -> None:
        self.asked.append({"again": again, "if_busy": if_busy})

    def combine(self, _: str) -> None:
        self.asked.append("combine")

    def get(self, _: str) -> dict[str, Any]:
        error = {"detail": "too few views"}
        return {
            "state": self.state,
            "error": error,
            "links": {"files": {"model.ply": "/model/m/model.ply"}},
        }


class Asked:
    """A client. fetched : what it was to write."""

    def __init__(self, state: str = "succeeded") -> None:
        self.models = Models(state)
        self.fetched: list[tuple[str, Path]] = []
        self.fetch: Callable[[str, Path], None] = lambda link, path: self.fetched.append((link, path))


def test_service_shoots_what_the_person_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client, answers = Asked(), iter(["a", "q"])
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    model_shoot.views_there(client, {"views": 3}, tmp_path / "out")  # type: ignore[arg-type]
    wait = {"if_busy": "queue"}
    assert client.models.asked == [{"views": 3, **wait}, {"again": True, **wait}, "combine"]
    assert client.fetched == [("/model/m/model.ply", tmp_path / "out" / "model.ply")]
    failed, answers = Asked("failed"), iter(["", ""])
    with pytest.raises(ServiceError, match="Model m failed: too few views"):
        model_shoot.views_there(failed, {}, tmp_path)  # type: ignore[arg-type]
    assert failed.models.asked == [wait, {"again": False, **wait}, {"again": False, **wait}]


def test_planes_are_added_to_what_the_file_says_of_the_axis(tmp_path: Path) -> None:
    scan, file = tmp_path / "scan", tmp_path / "turntable.json"
    scan.mkdir()
    (scan / "mesh.ply").write_bytes(encode_mesh_ply(joined(PLATE, WALL)))
    axis = MeasuredAxis(PLATE_AXIS.point_mm, PLATE_AXIS.direction, 1e-4 * np.eye(6))
    record = with_axis(TurntableRecord(), axis, source=AxisSource.BOARD, of="board")
    file.write_bytes(encode_turntable(record))
    shown = done("turntable", "planes", scan, "--turntable", file, COLUMNS="160")
    assert [line.split()[0] for line in shown.splitlines()] == ["plane", "backdrop", "plate", "turntable"]
    after = read_turntable(file)
    assert [plane.kind for plane in after.planes] == [PlaneKind.BACKDROP, PlaneKind.PLATE]
    assert after.history == record.history
    file.write_text("{}")
    assert "is not a valid turntable" in refused(slrig("turntable", "planes", scan, "--turntable", file))
    assert file.read_text() == "{}"

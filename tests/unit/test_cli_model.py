"""`slrig model`: which scans are meant, where they start from, and what is written and told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import Result

from slrig.bundle.poses_file import Poses, encode_poses, read_poses
from slrig.bundle.stage_file import StageRecord, encode_stage
from slrig.combine import plan
from slrig.errors import ConfigError
from slrig.meshing.topology import topology_counts
from slrig.model import MeasuredAxis, PlaneKind, StagePlane
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply
from slrig.views import registration
from tests.turned_views import AXIS, AXIS_POINT_MM, bumpy, displacement_mm, seen, vase
from tests.unit.command import slrig

ANGLE = 40.0
STAGE = [
    "--angle", str(ANGLE), "--axis-point", *map(str, np.add(AXIS_POINT_MM, [0.3, 0.0, -0.2])),
    "--axis-direction", *map(str, AXIS),
]  # fmt: skip


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scans 9, 10 and 11 of an object on a stage, and one scan's mesh of a vase beside it."""
    folder = tmp_path_factory.mktemp("scans")
    turned = seen(bumpy, [0.0, ANGLE, 2 * ANGLE], pitch_mm=1.5)
    for number, view in zip((9, 10, 11), turned.noisy(0, length_mm=2.0), strict=True):
        (folder / "all" / f"scan-{number}").mkdir(parents=True)
        (folder / "all" / f"scan-{number}" / "mesh.ply").write_bytes(encode_mesh_ply(view))
    for number, view in enumerate(seen(vase, [0.0, ANGLE], pitch_mm=1.5).noisy(0, length_mm=2.0)):
        (folder / f"vase-{number}.ply").write_bytes(encode_mesh_ply(view))
    return folder


def model(*words: object) -> Result:
    return slrig("model", *words, COLUMNS="120")


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
    assert report["axis"]["stage_error_deg"] == pytest.approx([0, 0, 0], abs=0.05)
    known = read_poses(tmp_path / "model" / "poses.json")
    assert list(known.poses) == ["scan-9", "scan-10", "scan-11"]
    assert known.axis is not None
    assert np.linalg.norm(np.cross(known.axis[0] - AXIS_POINT_MM, AXIS)) < 0.03
    # One mesh in the frame of the first scan: the second one's vertices follow its own.
    placed = decode_mesh_ply((tmp_path / "model" / "placed.ply").read_bytes())
    views = [decode_mesh_ply((scans / "all" / name / "mesh.ply").read_bytes()) for name in known.poses]
    first, second = len(views[0].vertices_mm), len(views[1].vertices_mm)
    assert len(placed.faces) == sum(len(view.faces) for view in views)
    pose = known.poses["scan-10"]
    wanted = views[1].vertices_mm @ pose[:3, :3].T + pose[:3, 3]
    assert placed.vertices_mm[first : first + second] == pytest.approx(wanted, abs=1e-4)
    # The same surface once, and nothing where no scan has seen it.
    whole = decode_mesh_ply((tmp_path / "model" / "model.ply").read_bytes())
    assert report["model"]["triangles"] == len(whole.faces) < len(placed.faces)
    assert topology_counts(whole.faces).boundary_edges > 0
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
    # What is known of the stage is in a file: its axis, and a plate that hides a part of the vase.
    views = [decode_mesh_ply((scans / f"vase-{number}.ply").read_bytes()) for number in (0, 1)]
    height = (views[0].vertices_mm - AXIS_POINT_MM) @ AXIS
    foot = StagePlane(PlaneKind.PLATE, AXIS_POINT_MM + np.quantile(height, 0.1) * AXIS, AXIS, 0.02, 50.0, 1.0)
    known = MeasuredAxis(np.add(AXIS_POINT_MM, [0.3, 0.0, -0.2]), AXIS, 1e-4 * np.eye(6))
    (tmp_path / "stage.json").write_bytes(encode_stage(StageRecord(known, (foot,))))
    words = ("--angle", ANGLE, "--stage", tmp_path / "stage.json")
    done = model(scans / "vase-0.ply", scans / "vase-1.ply", "--output", tmp_path / "model", *words)
    assert done.exit_code == 0, done.output
    assert "of the views lay behind the stage's planes" in done.stdout
    whole = decode_mesh_ply((tmp_path / "model" / "model.ply").read_bytes())
    # Within an edge of the model of where it was cut, 1 mm before the plane.
    assert ((whole.vertices_mm - foot.point_mm) @ AXIS).min() > 0.0
    assert "free      1 view may turn about an axis along (-0.0" in done.stdout
    assert "held as the start has it" in done.stdout
    (free,) = json.loads((tmp_path / "model" / "report.json").read_text())["free"]
    assert (free["view"], free["motion"]) == ("vase-1", "turn")


@pytest.mark.slow
def test_scans_in_another_order_than_the_stage_turned_in_are_refused(scans: Path, tmp_path: Path) -> None:
    named = [scans / "all" / f"scan-{number}" for number in (9, 10, 11)]
    for number, folder in enumerate(named):
        (folder / "report.json").write_text(json.dumps({"stage": {"angle_deg": 320 + ANGLE * number}}))
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
        ([folder, *to, "--unknown", "--dictionary", "DICT_4X4_50"], "expected --markers beside it"),
    ):
        refused = model(*words)
        assert (refused.exit_code, expected in refused.stderr) == (2, True), (words, refused.output)
    assert not (tmp_path / "none").exists()


def test_nothing_that_is_read_is_replaced(scans: Path, tmp_path: Path) -> None:
    own = tmp_path / "model"
    own.mkdir()
    (own / "report.json").write_text('{"format": "slrig-model"}')
    by_hand = own / "by-hand.json"
    by_hand.write_bytes(encode_poses(Poses({f"scan-{number}": np.eye(4) for number in (9, 10, 11)})))
    scan = tmp_path / "scan"
    scan.mkdir()
    (scan / "report.json").write_text('{"format": "slrig-report"}')
    for words, expected in (
        ([scans / "all", "--output", scans / "all", *STAGE], "would be replaced"),
        ([scans / "all", "--output", scans / "all" / "scan-9", *STAGE], "would be replaced"),
        ([scans / "all", "--output", own, "--poses", by_hand], "would be replaced"),
        ([scans / "all", "--output", scan, *STAGE], "a folder with other files in it"),
    ):
        refused = model(*words)
        assert (refused.exit_code, expected in refused.stderr) == (2, True), (words, refused.output)
    assert by_hand.exists()


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
    poses = read_poses(tmp_path / "model" / "poses.json").poses
    turns = [Rotation.from_matrix(poses[name][:3, :3]).magnitude() for name in ("scan-9", "scan-10", "scan-11")]
    assert np.rad2deg(turns) == pytest.approx([0, ANGLE, 2 * ANGLE], abs=0.05)
    refused = model(scans / "vase-0.ply", scans / "vase-1.ply", "--output", tmp_path / "vase", "--unknown")
    assert refused.exit_code != 0
    assert "or tell where to start from" in " ".join(refused.output.split())
    assert not (tmp_path / "vase").exists()
    assert "found --angle" in " ".join(model(scans / "all", "--output", tmp_path, *STAGE, "--unknown").output.split())

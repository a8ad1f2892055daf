"""`slrig calibrate hand-eye`: from files of a robot and bundles, scans or poses, to hand_eye.json and its check."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from slrig.bundle import write_bundle, write_calibration
from slrig.calibrate.hand_eye import hand_eye_document, read_hand_eye, write_hand_eye
from slrig.calibration import PROJECTOR, BoardPose
from slrig.calibration.hand_eye import HandEyeKind, solve_hand_eye
from slrig.cli.options import ServiceOptions
from slrig.model import Calibration, FloatArray
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply
from slrig.scan.preparation import sample_scan
from tests.unit.calibration.posed_boards import CHESSBOARD, Shooting, two_cameras_and_projector
from tests.unit.calibration.robot_cells import RobotCell, cell, error_of, pose, sphere_mesh
from tests.unit.client.service import client_of
from tests.unit.command import done, refused, slrig

BOARD = ["--board", "chessboard", "--corners", "11x8", "--square-mm", "12"]


def write_csv(path: Path, names: tuple[str, ...], poses: FloatArray) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"])
        for name, each in zip(names, poses, strict=True):
            writer.writerow([name, *each[:3, 3], *Rotation.from_matrix(each[:3, :3]).as_quat()])
    return path


def hand_eye(*words: object) -> str:
    return done("calibrate", "hand-eye", *words)


def files_of(made: RobotCell, folder: Path, stem: str) -> tuple[Path, Path]:
    robot = write_csv(folder / f"{stem}-robot.csv", made.robot.names, made.robot.poses)
    return robot, write_csv(folder / f"{stem}-seen.csv", made.seen.names, made.seen.poses)


def test_poses_of_a_body_become_a_file_that_new_poses_are_held_against(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[tuple[str, str, bytes]] = []

    def keep(asked: httpx2.Request) -> httpx2.Response:
        kept.append((asked.method, asked.url.path, asked.read()))
        return httpx2.Response(200, json={})

    monkeypatch.setattr(ServiceOptions, "client", lambda _: client_of(keep))
    made, output = cell(HandEyeKind.IN_HAND, 4), tmp_path / "hand_eye.json"
    poses = made.robot.poses.copy()
    poses[2, :3, 3] += 3.0
    made = replace(made, robot=replace(made.robot, poses=poses))
    told = hand_eye(*files_of(made, tmp_path, "first"), "--kind", "in-hand", "--output", output, "--keep")
    for words in ("rig in the flange: ", "± 0.0", "left out  03: contradicts", "next      from pose", str(output)):
        # A long path goes on in the next line.
        assert words in told or words in told.replace("\n", ""), words
    found = read_hand_eye(output)
    ((method, path, body),) = kept
    assert (method, path, json.loads(body)) == ("PUT", "/hand-eye", json.loads(output.read_bytes()))
    error = error_of(np.array(found.rig), made.rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diagonal(found.covariance)))
    np.testing.assert_allclose(np.array(found.inverse) @ found.rig, np.eye(4), atol=1e-9)
    assert (found.kind, found.flange_frame, len(found.poses)) == ("in-hand", "tool0", 11)
    fresh = cell(HandEyeKind.IN_HAND, 50, count=2)
    assert hand_eye(*files_of(fresh, tmp_path, "fresh"), "--check", output).startswith("holds: as if")
    seen = replace(fresh.seen, poses=pose([0.3, 0, 0], [1.0, 0, 0]) @ fresh.seen.poses)
    moved = files_of(replace(fresh, seen=seen), tmp_path, "moved")
    result = slrig("calibrate", "hand-eye", *moved, "--check", output, "--json")
    assert result.exit_code == 1
    answer = json.loads(result.stdout)
    assert (answer["holds"], answer["poses"][0]["name"]) == (False, "01")
    assert answer["shift_mm"] > 3 * answer["sigma_mm"]


@pytest.mark.parametrize("numbered", [False, True])
def test_boards_in_bundles_are_paired_with_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, numbered: bool
) -> None:
    made = cell(
        HandEyeKind.FIXED, 6, count=8, turns_deg=(25.0, 25.0, 20.0), spread_mm=15.0, place_mm=(20.0, -45.0, 600.0)
    )
    # Two cameras tell a pose, and take less time than the projector's light.
    devices = {name: each for name, each in two_cameras_and_projector().items() if name != PROJECTOR}
    shooting = Shooting(CHESSBOARD, devices)
    shot = {
        name: shooting.shot(name, BoardPose(each[:3, :3], each[:3, 3]))
        for name, each in zip(made.robot.names, made.shown, strict=True)
    }

    def read_pose(_bundle: Path, _board: object, name: str) -> object:
        return SimpleNamespace(observation=shot[name])

    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", read_pose)
    calibration = Calibration(devices, None)
    for name in made.robot.names:
        (tmp_path / "poses" / name / "bundle").mkdir(parents=True)
        (tmp_path / "poses" / name / "bundle" / "bundle.json").write_text("{}")
    robot = write_csv(tmp_path / "robot.csv", made.robot.names, made.robot.poses)
    if numbered:
        text = [",".join(line.split(",")[1:]) for line in robot.read_text().splitlines()]
        robot.write_text("\n".join(text))
    words = ["calibrate", "hand-eye", robot, tmp_path / "poses", "--kind", "fixed", "--output", tmp_path / "found.json"]
    assert "hold no calibration: name that of the rig" in refused(slrig(*words, *BOARD))
    write_calibration(tmp_path / "rig.json", calibration)
    done(*words, *BOARD, "--calibration", tmp_path / "rig.json", "--base-frame", "world")
    found = read_hand_eye(tmp_path / "found.json")
    assert (found.calibration, found.base_frame) == (calibration.solve_id, "world")
    error = error_of(np.array(found.rig), made.rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diagonal(found.covariance)))
    assert np.linalg.norm(error[3:]) < 0.4


def test_spheres_in_scans_are_found(tmp_path: Path) -> None:
    made = cell(HandEyeKind.IN_HAND, 7, sphere=True)
    for number, (name, each) in enumerate(zip(made.robot.names, made.shown, strict=True)):
        (tmp_path / "scans" / name).mkdir(parents=True)
        mesh = sphere_mesh(each[:3, 3], 38.1, number)
        (tmp_path / "scans" / name / "mesh.ply").write_bytes(encode_mesh_ply(mesh))
    robot = write_csv(tmp_path / "robot.csv", made.robot.names, made.robot.poses)
    hand_eye(robot, tmp_path / "scans", "--sphere", 38.1, "--kind", "in-hand", "--output", tmp_path / "found.json")
    found = read_hand_eye(tmp_path / "found.json")
    error = error_of(np.array(found.rig), made.rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diagonal(found.covariance)))
    assert found.poses[0].residual_deg is None


def test_recorded_scan_is_written_in_the_robots_axes(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", *sample_scan())
    made = cell(HandEyeKind.IN_HAND, 4)
    found = hand_eye_document(solve_hand_eye(made.robot, made.seen, made.kind), None)
    write_hand_eye(tmp_path / "hand_eye.json", found)
    flange = write_csv(tmp_path / "flange.csv", ("now",), made.robot.poses[:1])
    words = ["reconstruct", tmp_path / "scan", "--mesh-axes", "robot", "--hand-eye", tmp_path / "hand_eye.json"]
    assert "give robot_pose" in refused(slrig(*words, "--output", tmp_path / "none"))
    done(*words, "--robot-pose", flange, "--output", tmp_path / "base")
    done("reconstruct", tmp_path / "scan", "--mesh-axes", "rig", "--output", tmp_path / "rig")
    for name in ("mesh.ply", "points.ply"):
        base, rig = (trimesh.load(tmp_path / place / name, process=False).vertices for place in ("base", "rig"))
        placed = made.robot.poses[0] @ np.array(found.rig)
        np.testing.assert_allclose(base, rig @ placed[:3, :3].T + placed[:3, 3], atol=1e-3)
    base, rig = (decode_mesh_ply((tmp_path / place / "mesh.ply").read_bytes()).vertices_mm for place in ("base", "rig"))
    np.testing.assert_allclose(base, rig, atol=1e-3)
    report = json.loads((tmp_path / "base" / "report.json").read_text())
    np.testing.assert_allclose(np.array(report["plan"]["rig_in_base"]), placed)


TURN = Rotation.from_euler("ZYX", [30.0, -20.0, 75.0], degrees=True)
PLACE_MM = (412.0, -35.5, 780.25)


def written(path: Path, rows: list[Mapping[str, Any]]) -> Path:
    if path.name == "echoed.yaml":
        path.write_text("".join(f"{json.dumps(row)}\n---\n" for row in rows))
    elif path.suffix == ".csv":
        lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
        path.write_text("\n".join(lines))
    else:
        # JSON is YAML.
        path.write_text(json.dumps(rows))
    return path


def forms() -> dict[str, tuple[str, str | None, dict[str, Any]]]:
    x, y, z, w = TURN.as_quat().tolist()
    place = dict(zip(("x_mm", "y_mm", "z_mm"), PLACE_MM, strict=True))
    metres = {axis: each / 1000 for axis, each in zip("xyz", PLACE_MM, strict=True)}
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix(), PLACE_MM
    kuka = dict(zip(("a_deg", "b_deg", "c_deg"), TURN.as_euler("ZYX", degrees=True), strict=True))
    fanuc = dict(zip(("w_deg", "p_deg", "r_deg"), TURN.as_euler("xyz", degrees=True), strict=True))
    vector = dict(zip(("rx_rad", "ry_rad", "rz_rad"), TURN.as_rotvec(), strict=True))
    staubli = dict(zip(("rx_deg", "ry_deg", "rz_deg"), TURN.as_euler("XYZ", degrees=True), strict=True))
    message = {"position": metres, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return {
        "quaternion": ("poses.csv", None, {**place, "qw": w, "qx": x, "qy": y, "qz": z}),
        "metres": ("poses.csv", None, {f"{key}_m": each for key, each in metres.items()} | kuka),
        "KUKA": ("poses.csv", None, place | kuka),
        "FANUC": ("poses.json", None, place | fanuc),
        "ABB": ("poses.json", None, {**place, "q1": w, "q2": x, "q3": y, "q4": z}),
        "UR": ("poses.csv", "rotvec", place | vector),
        "turning axes": ("poses.csv", "XYZ", place | staubli),
        "matrix": ("poses.json", None, {"matrix_mm": np.round(matrix, 4).tolist()}),
        "ROS": ("poses.yaml", None, {"header": {"frame_id": "base_link"}, "pose": message}),
        "ros2 topic echo": ("echoed.yaml", None, {"header": {"frame_id": "base_link"}, "pose": message}),
        "ROS transform": (
            "poses.yaml", None, {"transform": {"translation": metres, "rotation": message["orientation"]}}
        ),
    }  # fmt: skip


@pytest.mark.parametrize("form", list(forms()))
def test_forms_of_robot_poses(tmp_path: Path, form: str) -> None:
    from slrig.importers import read_robot_poses

    name, rotation, row = forms()[form]
    found = read_robot_poses(written(tmp_path / name, [row]), rotation)
    np.testing.assert_allclose(found.poses[0, :3, 3], PLACE_MM, atol=1e-3)
    np.testing.assert_allclose(found.poses[0, :3, :3], TURN.as_matrix(), atol=1e-4)
    assert found.names == ("1",)
    assert (found.euler is None) == (form not in ("metres", "KUKA", "FANUC", "turning axes"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("412,-35,780,0,0,0,1\n", "expected a line of names"),
        ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n", "expected a position with its unit"),
        ("x_mm,y_mm,z_mm\n1,2,3\n", "expected a rotation with its convention"),
        ("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n1,2,3,0,0,9\n", "say which by --rotation"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,3,0,0,0,1.5\n", "expected a quaternion of length 1"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,,0,0,0,1\n", "position: expected 3 numbers"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,3,0,0,1\n", "rows as long"),
        ("name,x_mm,y_mm,z_mm,qx,qy,qz,qw\na,1,2,3,0,0,0,1\na,1,2,3,0,0,0,1\n", "found 'a' twice"),
        ("", "expected a line of names"),
    ],
)
def test_ambiguous_poses_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    result = slrig("calibrate", "hand-eye", tmp_path / "poses.csv", tmp_path, "--kind", "fixed", "--output", "x.json")
    assert words in refused(result)


def test_poses_and_folders_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    made = cell(HandEyeKind.FIXED, 1, count=5)
    robot, seen = files_of(made, tmp_path, "first")
    other = write_csv(tmp_path / "other.csv", ("a", "b", "c"), made.seen.poses[:3])
    words = refused(slrig("calibrate", "hand-eye", robot, other, "--kind", "fixed", "--output", tmp_path / "x.json"))
    assert "expected a robot pose for each of 3 folders (a, b, c, …), found 5" in words
    assert "--check FILE alone" in refused(slrig("calibrate", "hand-eye", robot, seen))

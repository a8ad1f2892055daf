"""Captures by real cameras: boards, the calibration that they give, and a skull against its published point cloud.

Asked of the boards: camera at most 0.22 px, projector 0.16 px at sub-pixel code edges, stereo 0.20 px, and the
principal row with its deviation. Four poses, Gray code only, by somebody else (kamino410/procam-calibration).
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from slrig.bundle.calibration import write_calibration
from slrig.calibrate.pose_reading import bundle_device_sizes, read_pose
from slrig.calibrate.store import CalibrationResult, ReadPose, solve_poses
from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, Correspondences
from slrig.calibration.solution import PARAMETERS, PROJECTOR
from slrig.cli.commands import app
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray
from slrig.reconstruction import PixelPairs
from slrig.scan.measured import pairs_of_scans
from slrig.scan.uncalibrated import refined_by_pairs
from tests.golden.test_bundles import reconstructed

pytestmark = [pytest.mark.shared, pytest.mark.slow]
BOARD = Board(BoardKind.CHESSBOARD, 7, 9, 75.0)
POSES = ("pose_0", "pose_1", "pose_2", "pose_3")


@pytest.fixture(scope="module")
def poses(shared: Path) -> list[ReadPose]:
    return [read_pose(shared / "captures" / "boards" / name, BOARD, name) for name in POSES]


@pytest.fixture(scope="module")
def result(shared: Path, poses: list[ReadPose]) -> CalibrationResult:
    sizes = bundle_device_sizes(shared / "captures" / "boards" / POSES[0])
    cameras = {name: size for name, size in sizes.items() if name != PROJECTOR}
    return solve_poses(BOARD, cameras, sizes[PROJECTOR], poses)


def off_sheet_px(light: Correspondences, axis: int) -> FloatArray:
    """How far the light of one axis is from a smooth sheet, projector px: a polynomial of fourth degree in the pixel.

    A flat board seen through two lenses is one; nothing that varies from square to square, or from code to code, is.
    """
    chosen = light.axis == axis
    x, y = ((light.pixels_px[chosen] - (640.0, 512.0)) / 640.0).T
    terms = np.column_stack([x**i * y**j for i in range(5) for j in range(5 - i)])
    fitted = np.linalg.lstsq(terms, light.position_px[chosen], rcond=None)[0]
    return np.asarray(terms @ fitted - light.position_px[chosen])


@pytest.mark.parametrize("number", range(len(POSES)))
def test_light_of_the_real_boards_lies_on_smooth_sheets(poses: list[ReadPose], number: int) -> None:
    light = poses[number].observation.correspondences["cam0"]
    for axis in (COLUMN, ROW):
        off = off_sheet_px(light, axis)
        assert len(off) > 2000
        assert np.sqrt(np.mean(off**2)) <= 0.16
        assert (np.abs(off) > 2).mean() < 0.001


def every_corner_off_px(result: CalibrationResult, poses: list[ReadPose]) -> FloatArray:
    """(n,) float64: how far every corner that was found lies from where the calibration puts it, by OpenCV, px."""
    camera, shape_mm = result.calibration.cameras["cam0"], result.solution.board_shape_mm
    assert shape_mm is not None
    off = []
    for pose in poses:
        board_pose, view = result.solution.poses[pose.observation.name], pose.observation.views["cam0"]
        world = (BOARD.points_mm + shape_mm)[view.corner] @ board_pose.rotation.T + board_pose.translation_mm
        seen, _ = cv2.projectPoints(world, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
        off.append(np.linalg.norm(seen.reshape(-1, 2) - view.points_px, axis=1))
    return np.concatenate(off)


def test_the_real_boards_give_the_calibration_that_is_asked_for(
    result: CalibrationResult, poses: list[ReadPose]
) -> None:
    camera, projector = result.solution.residuals["cam0"], result.solution.residuals[PROJECTOR]
    off_px = every_corner_off_px(result, poses)
    rms_px = float(np.sqrt(np.mean(off_px**2)))
    # All 252 corners, outlying ones too, count here; the solve's own figure is of those that it did not leave out.
    assert len(off_px) == len(POSES) * BOARD.corner_count
    assert rms_px <= 0.22
    assert camera.rms_px <= rms_px
    assert projector.rms_px <= 0.16
    # As a stereo calibration counts: all points of both devices together, two coordinates each.
    assert np.sqrt((rms_px**2 + 2 * projector.rms_px**2) / 2) <= 0.20
    assert result.solution.outliers == {}


def test_the_paper_of_the_real_boards_is_found_to_be_bowed(result: CalibrationResult) -> None:
    bow = result.solution.bow
    assert bow is not None
    assert bow.solved
    # 1.07 ± 0.10 mm over 600 mm was found when this was written; nobody measured it otherwise.
    assert 0.7 < bow.height_mm < 1.5
    assert bow.sigma_mm < 0.2


def test_the_projectors_lens_is_shifted_and_its_row_is_known_so_well(result: CalibrationResult) -> None:
    projector = result.calibration.projector
    assert projector is not None
    row = len(PARAMETERS) + PARAMETERS.index("cy")
    sigma_px = float(np.sqrt(result.solution.covariance[row, row]))
    # Below the 768 rows of its image; others found 860 to 877, and three of the four poses alone 839 to 880.
    assert projector.matrix[1, 2] > projector.size.height_px
    assert 1 < sigma_px < 50
    assert abs(projector.matrix[1, 2] - 868.5) < 3 * sigma_px
    assert abs(projector.matrix[0, 0] - 1890) < 30
    assert abs(result.calibration.cameras["cam0"].matrix[0, 0] - 3450) < 60
    assert result.calibration.solved is not None


@pytest.fixture(scope="module")
def pairs(shared: Path, result: CalibrationResult) -> list[dict[str, PixelPairs]]:
    """Columns and rows of the four captures as scans."""
    folders = [shared / "captures" / "boards" / name for name in POSES]
    return pairs_of_scans(result.calibration, folders, lambda *_: None)


@pytest.mark.parametrize(("turned_deg", "holds"), [(0.0, True), (0.1, False)])
def test_scans_of_the_real_boards_contradict_a_projector_that_was_turned(
    result: CalibrationResult, pairs: list[dict[str, PixelPairs]], turned_deg: float, holds: bool
) -> None:
    projector = result.calibration.projector
    assert projector is not None
    turn = cv2.Rodrigues(np.deg2rad([turned_deg, 0.0, 0.0]))[0]
    before = replace(result.calibration, projector=replace(projector, rotation=turn @ projector.rotation))
    with nullcontext() if holds else pytest.raises(SolveRefusedError, match="scans contradict the calibration"):
        refined_by_pairs(before, pairs)


def test_a_pose_that_nobody_touched_is_not_stale(shared: Path, tmp_path: Path, result: CalibrationResult) -> None:
    """Four poses leave the projector's lens to bend: 4.6 times the residual at held-out ones. By a covariance without
    that the first pose, of those that the calibration was made of, was stale.
    """
    write_calibration(tmp_path / "calibration.json", result.calibration)
    told = CliRunner().invoke(
        app,
        [
            "verify", str(shared / "captures" / "boards" / POSES[0]), "--calibration",
            str(tmp_path / "calibration.json"), "--board", "chessboard", "--corners", "7x9", "--square-mm", "75",
        ],
    )  # fmt: skip
    assert told.exit_code == 0, told.output
    assert "the calibration holds" in told.output
    assert result.expected.point_mm > 0.3
    assert result.expected.point_mm < 1.5


def test_the_skull_covers_its_reference_points(shared: Path, tmp_path: Path) -> None:
    folder = shared / "captures" / "skull"
    report = reconstructed(folder, tmp_path / "out")
    assert report["method"] == "Gray-only"
    reference: FloatArray = np.load(folder / "reference_points_mm.npy").astype(np.float64)
    # From y up, z towards the rig, to the axes of the calibration.
    points, vertices = (
        np.asarray(trimesh.load(tmp_path / "out" / name, process=False).vertices) * [1, -1, -1]
        for name in ("points.ply", "mesh.ply")
    )
    to_points = _distances(reference, points)
    to_vertices = _distances(reference, vertices)
    assert (to_points < 1.0).mean() >= 0.95
    assert (to_vertices < 1.0).mean() >= 0.95
    assert np.median(to_points) <= 0.25
    assert np.percentile(to_points, 95) <= 0.8
    # The authors cut their points out. Vertices far from them are of the table and the wall, or there are too many.
    far = vertices[_distances(vertices, reference) > 10.0]
    for _ in range(2):
        far = _off_plane(far, within_mm=1.5)
    assert len(far) <= 0.003 * len(vertices)


def _off_plane(points: FloatArray, *, within_mm: float) -> FloatArray:
    """The points that do not lie on the plane that most of them lie on."""
    rng = np.random.default_rng(0)
    off = np.ones(len(points), dtype=bool)
    for _ in range(500):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        apart = np.abs((points - a) @ normal) > within_mm * np.linalg.norm(normal)
        if apart.sum() < off.sum():
            off = apart
    return points[off]


def _distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """(n,) float64: from each point to the nearest of the others."""
    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)

"""Scans of a region: what is measured of it is what a scan of everything measures there, and nothing else is."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.bundle import read_bundle, write_bundle
from slrig.capture.verifier import check_capture
from slrig.errors import ConfigError, NothingToReconstructError
from slrig.model import Mesh, Pinhole, Refusal, Region
from slrig.model.capture import CaptureHeader
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.reconstruct import reconstruct_bundle
from slrig.scan.stream import LiveScan
from tests.prepared_bundles import prepared_bundle

BOX = ((-45.0, -45.0, -400.0), (20.0, 35.0, 400.0))


class Scanned:
    """A recorded scan, and meshes of it in `folder`."""

    def __init__(self, bundle: Path, folder: Path) -> None:
        self.bundle, self.folder = bundle, folder
        self.made: dict[str, tuple[Mesh, Mapping[str, Any], Path]] = {}

    def __call__(self, region: Region | None = None, *, live: LiveScan | None = None) -> tuple[Mesh, Any, Path]:
        key = f"{region}{live is None}"
        if key not in self.made:
            output = self.folder / f"out{len(list(self.folder.iterdir()))}"
            reconstruct_bundle(self.bundle, output, plan=ReconstructionPlan(region=region), live=live)
            report = json.loads((output / "report.json").read_text())
            self.made[key] = decode_mesh_ply((output / "mesh.ply").read_bytes()), report, output
        return self.made[key]

    @property
    def camera(self) -> tuple[str, Pinhole]:
        calibration = read_bundle(self.bundle).calibration
        assert calibration is not None
        return next(iter(calibration.cameras.items()))

    def pixels(self, points_mm: NDArray[np.float32]) -> NDArray[np.float64]:
        """(n, 2): where OpenCV sees points."""
        device = self.camera[1]
        turn = cv2.Rodrigues(device.rotation)[0]
        points = points_mm.astype(np.float64)
        return np.asarray(
            cv2.projectPoints(points, turn, device.translation_mm, device.matrix, device.distortion)[0]
        ).reshape(-1, 2)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    return Scanned(prepared_bundle(tmp_path_factory, "ball"), tmp_path_factory.mktemp("limited"))


def same_points(part: Mesh, whole: Mesh, kept: Any) -> None:
    """The points of a region are those that are `kept`, (V,) bool, of a whole scan, as near as noise estimates are."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(whole.vertices_mm).query(part.vertices_mm)
    sigma = float(np.median(whole.sigma_mm))
    assert np.quantile(distance, 0.5) < 0.05 * sigma
    assert np.quantile(distance, 0.95) < 0.5 * sigma
    # The boundary is moved by the paper's smoothing, and a region has more of it.
    assert abs(len(part.vertices_mm) / np.count_nonzero(kept) - 1) < 0.02
    assert np.median(part.sigma_mm) == pytest.approx(np.median(whole.sigma_mm[kept]), rel=0.1)


def check_box(scanned: Scanned) -> tuple[Mesh, Any, Path]:
    """Check the points of BOX in a scan of it, and of every camera that something is left out; return that scan."""
    whole, _, _ = scanned()
    part, report, output = scanned(Region(box_mm=BOX))
    inside = ((whole.vertices_mm >= BOX[0]) & (whole.vertices_mm <= BOX[1])).all(axis=1)
    assert 0.1 < inside.mean() < 0.8
    assert ((part.vertices_mm >= BOX[0]) & (part.vertices_mm <= BOX[1])).all()
    same_points(part, whole, inside)
    assert all(each["refused_pixels"]["outside_region"] > 0 for each in report["cameras"].values())
    return part, report, output


def test_a_box_gives_the_points_of_the_whole_scan_in_it_and_no_others(scanned: Scanned) -> None:
    _, all_of_it, _ = scanned()
    part, report, output = check_box(scanned)
    name, _ = scanned.camera
    assert all_of_it["cameras"][name]["refused_pixels"]["outside_region"] == 0
    assert report["plan"]["region"]["box_mm"] == [list(corner) for corner in BOX]
    causes = cv2.imread(str(output / f"causes-{name}.png"), cv2.IMREAD_UNCHANGED)
    assert causes is not None
    pixels = np.rint(scanned.pixels(part.vertices_mm)).astype(int)
    assert (causes[pixels[:, 1], pixels[:, 0]] == Refusal.OUTSIDE_REGION).mean() < 0.001


@pytest.mark.slow
def test_what_is_outside_of_the_region_is_neither_missing_nor_wrong(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    told = Scanned(prepared_bundle(tmp_path_factory, "ball with its truth"), tmp_path)
    whole, part = (told(region)[1]["truth"] for region in (None, Region(box_mm=BOX)))
    assert part["complete_0.3mm"] == pytest.approx(whole["complete_0.3mm"], abs=0.03)
    assert part["rms_mm"] < 1.2 * whole["rms_mm"]


def test_depths_count_along_the_optical_axis_of_the_camera(scanned: Scanned) -> None:
    whole, _, _ = scanned()
    _, device = scanned.camera
    depth = whole.vertices_mm @ device.rotation[2] + device.translation_mm[2]
    near, far = (float(each) for each in np.quantile(depth, (0.2, 0.7)))
    part, _, _ = scanned(Region(depth_mm=(near, far)))
    found = part.vertices_mm @ device.rotation[2] + device.translation_mm[2]
    assert near - 1e-3 <= found.min() <= found.max() <= far + 1e-3
    same_points(part, whole, (depth >= near) & (depth <= far))


@pytest.mark.slow
def test_a_polygon_and_a_mask_cut_the_image(scanned: Scanned) -> None:
    whole, _, _ = scanned()
    name, device = scanned.camera
    pixels = scanned.pixels(whole.vertices_mm)
    x, y = np.quantile(pixels, 0.4, axis=0)
    polygon = ((0.0, 0.0), (float(x), 0.0), (float(x), float(y)), (0.0, float(y)))
    inside = (pixels[:, 0] <= x) & (pixels[:, 1] <= y)
    part, _, _ = scanned(Region(polygons_px={name: polygon}))
    same_points(part, whole, inside)
    found = scanned.pixels(part.vertices_mm)
    assert (found <= np.array([x, y]) + 1).all()  # a pixel counts whose centre, or sixteenth, is inside
    drawn = np.zeros(device.size.shape, dtype=np.uint8)
    drawn[: int(y) + 1, : int(x) + 1] = 255
    drawn[:, np.arange(device.size.width_px) // 16 % 2 == 1] = 0  # strips do not bridge what is narrower
    mask = base64.b64encode(cv2.imencode(".png", drawn)[1].tobytes()).decode()
    striped, _, _ = scanned(Region(masks={name: mask}))
    columns, rows = np.rint(scanned.pixels(striped.vertices_mm)).astype(int).T
    assert drawn[rows, columns].all()
    assert len(striped.vertices_mm) == pytest.approx(len(part.vertices_mm) / 2, rel=0.1)


@pytest.mark.slow
def test_weak_contrast_and_large_deviations_are_left_out(scanned: Scanned) -> None:
    whole, _, _ = scanned()
    limit_mm = float(np.quantile(whole.sigma_mm, 0.8))
    part, report, _ = scanned(Region(max_sigma_mm=limit_mm))
    assert part.sigma_mm.max() <= np.float32(limit_mm)
    assert len(part.vertices_mm) == pytest.approx(0.8 * len(whole.vertices_mm), rel=0.05)
    assert report["mesh"]["sigma_limit"]["triangles"] > 0
    bright, _, _ = scanned(Region(min_contrast=0.4))
    capture = read_bundle(scanned.bundle).capture
    ends = [shot.image.astype(float) for shot in capture.shots[:2]]
    contrast = abs(ends[0] - ends[1]) / 255
    columns, rows = np.rint(scanned.pixels(bright.vertices_mm)).astype(int).T
    assert (contrast[rows, columns] >= 0.39).mean() > 0.999
    dark = contrast[tuple(np.rint(scanned.pixels(whole.vertices_mm)).astype(int).T[::-1])] < 0.4
    assert dark.mean() > 0.03
    assert len(bright.vertices_mm) == pytest.approx(np.count_nonzero(~dark), rel=0.02)


@pytest.mark.slow
def test_two_halves_make_the_whole(scanned: Scanned) -> None:
    """Where a region ends nothing is lost and nothing found twice."""
    whole, _, _ = scanned()
    parts = [
        scanned(Region(box_mm=((-500.0, -500.0, -500.0), (0.0, 500.0, 500.0))))[0],
        scanned(Region(box_mm=((0.0, -500.0, -500.0), (500.0, 500.0, 500.0))))[0],
    ]
    total = sum(len(each.vertices_mm) for each in parts)
    assert total == pytest.approx(len(whole.vertices_mm), rel=0.003)
    assert parts[0].vertices_mm[:, 0].max() <= 0 <= parts[1].vertices_mm[:, 0].min()


@pytest.mark.parametrize(
    "announced",
    [Region(box_mm=BOX), pytest.param(Region(box_mm=BOX, depth_mm=(1.0, 2.0)), marks=pytest.mark.slow)],
    ids=["this region", "another region, so that the bundle is read"],
)
def test_frames_that_came_live_give_the_same_bytes(scanned: Scanned, announced: Region) -> None:
    region = Region(box_mm=BOX)
    _, _, recorded = scanned(region)
    bundle = read_bundle(scanned.bundle)
    assert bundle.calibration is not None
    live = LiveScan(CaptureHeader.from_capture(bundle.capture), bundle.calibration, announced)
    for shot in bundle.capture.shots:
        live.take(shot)
    live.end(check_capture(bundle.capture, ()))
    scanned.made.pop(f"{region}{False}", None)
    _, _, streamed = scanned(region, live=live)
    assert (streamed / "mesh.ply").read_bytes() == (recorded / "mesh.ply").read_bytes()


def test_a_camera_that_is_not_there_is_no_region(scanned: Scanned) -> None:
    with pytest.raises(ConfigError, match=r"expected one of the cameras \['left'\], found 'middle'"):
        scanned(Region(polygons_px={"middle": ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0))}))


@pytest.mark.slow
def test_a_region_without_a_surface_and_one_out_of_sight_are_told_apart(scanned: Scanned) -> None:
    with pytest.raises(ConfigError, match="nothing of it is in the image of camera"):
        scanned(Region(box_mm=((5000.0, 0.0, 0.0), (5001.0, 1.0, 1.0))))
    _, device = scanned.camera
    with pytest.raises(NothingToReconstructError, match="outside the region that was asked for"):
        scanned(Region(depth_mm=(1.0, 2.0)))
    before = device.centre_mm - 100 * device.rotation[2]
    least, most = before - 5, before + 5
    with pytest.raises(NothingToReconstructError, match="outside the region"):
        scanned(Region(box_mm=(tuple(least), tuple(most)), min_contrast=0.001))


@pytest.mark.slow
@pytest.mark.parametrize("projector", [True, False], ids=["with the projector", "without it"])
def test_two_cameras_are_limited_each_in_its_own_image(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, *, projector: bool
) -> None:
    """Without a projector nothing says where a pixel looks before points are there: the points do."""
    bundle = read_bundle(prepared_bundle(tmp_path_factory, "ball by two cameras"))
    assert bundle.calibration is not None
    calibration = bundle.calibration if projector else replace(bundle.calibration, projector=None)
    write_bundle(tmp_path / "bundle", bundle.capture, calibration)
    check_box(Scanned(tmp_path / "bundle", tmp_path))


@pytest.mark.slow
def test_a_bracket_is_limited_as_one_exposure_is(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    check_box(Scanned(prepared_bundle(tmp_path_factory, "ball by a bracket"), tmp_path))

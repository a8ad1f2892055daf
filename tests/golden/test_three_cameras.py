"""Three rendered cameras and a projector: one surface, no worse than any two of them make, with one σ that is right."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.bundle import read_calibration, read_truth
from slrig.meshing.quality import SearchTree
from slrig.model import FloatArray, Mesh, Pinhole
from slrig.reconstruction import project
from slrig.scan.artefacts import decode_mesh_ply
from tests.golden.conftest import Scan
from tests.golden.test_bundles import reconstructed

pytestmark = pytest.mark.slow
NAMES = ("above", "left", "right")
SAME_MM = 0.15  # far beyond noise, and well below what lies behind another surface
LAYER_MM = 1.0
SAMPLES = 10_000


@pytest.fixture(scope="module")
def whole(scan_of: Callable[[str], Scan]) -> Scan:
    """The scan with all three."""
    return scan_of("three_cameras")


def mesh_of(folder: Path) -> tuple[Mesh, SearchTree]:
    mesh = decode_mesh_ply((folder / "mesh.ply").read_bytes())
    return mesh, SearchTree.build(mesh.vertices_mm, mesh.faces)


def with_cameras(bundle: Path, folder: Path, names: tuple[str, ...]) -> Path:
    """The result of a bundle with the frames of these cameras only."""
    part = folder / "-".join(names)
    shutil.copytree(bundle, part)
    document = json.loads((part / "bundle.json").read_text())
    document["frames"] = [frame for frame in document["frames"] if frame["camera"] in names]
    document["cameras"] = {name: document["cameras"][name] for name in names}
    (part / "bundle.json").write_text(json.dumps(document))
    reconstructed(part, part / "out")
    return part / "out"


def triangles(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """(n, 3) middles and (n, 3) normals of triangles, chosen evenly by area."""
    corners = np.asarray(mesh.vertices_mm, dtype=np.float64)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    chosen = np.random.default_rng(0).choice(len(areas), SAMPLES, p=areas / areas.sum())
    return corners[chosen].mean(axis=1), normals[chosen] / areas[chosen, None]


def sees(device: Pinhole, truth: SearchTree, points_mm: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: points inside a device's image with nothing before them."""
    pixels = project(device, points_mm)
    inside = (pixels > 0) & (pixels < [device.size.width_px - 1, device.size.height_px - 1])
    reach = truth.first_hits(device.centre_mm, points_mm - device.centre_mm)
    return np.asarray(inside.all(axis=1) & (reach > 0.999))


def test_three_cameras_are_no_worse_than_any_two_of_them(whole: Scan, tmp_path: Path) -> None:
    surface = read_truth(whole.bundle)
    assert surface is not None
    truth = SearchTree.build(surface.surface.vertices_mm, surface.surface.faces)
    mesh, found = mesh_of(whole.folder)
    places, _ = triangles(mesh)
    error_mm = truth.distances_mm(places)
    assert len(whole.report["redundancy"]["residual_px"]) == 3
    for pair in combinations(NAMES, 2):
        folder = with_cameras(whole.bundle, tmp_path, pair)
        other, tree = mesh_of(folder)
        theirs, _ = triangles(other)
        common, same = tree.distances_mm(places) < SAME_MM, found.distances_mm(theirs) < SAME_MM
        # On the surface that both have: a third camera also adds what only it sees, at its own accuracy.
        rms = [float(np.sqrt((each**2).mean())) for each in (error_mm[common], truth.distances_mm(theirs[same]))]
        assert rms[0] <= rms[1], pair
        report = json.loads((folder / "report.json").read_text())["truth"]
        assert whole.report["truth"]["rms_mm"] <= 1.02 * report["rms_mm"]
        assert whole.report["truth"]["complete_0.1mm"] >= report["complete_0.1mm"] - 0.002
        assert same.mean() > 0.99


def test_no_place_is_covered_by_two_layers(whole: Scan) -> None:
    mesh, tree = mesh_of(whole.folder)
    for place, normal in zip(*triangles(mesh), strict=True):
        for way in (normal, -normal):
            reach_mm = LAYER_MM * tree.first_hits(place + 1e-3 * way, LAYER_MM * way[None])[0]
            assert reach_mm > LAYER_MM, place


def test_sigma_holds_where_all_three_measured(whole: Scan) -> None:
    surface, calibration = read_truth(whole.bundle), read_calibration(whole.bundle / "calibration.json")
    assert surface is not None
    assert calibration.projector is not None
    truth = SearchTree.build(surface.surface.vertices_mm, surface.surface.faces)
    mesh, _ = mesh_of(whole.folder)
    points = np.asarray(mesh.vertices_mm, dtype=np.float64)
    counts = np.sum([sees(each, truth, points) for each in calibration.cameras.values()], axis=0)
    for number in (1, 2, 3):
        of = (counts == number) & np.isfinite(mesh.sigma_mm)
        assert np.count_nonzero(of) > 500
        within = truth.distances_mm(points[of]) <= mesh.sigma_mm[of]
        assert 0.64 <= within.mean() <= 0.8, number
    spread = [float(np.median(mesh.sigma_mm[counts == number])) for number in (2, 3)]
    assert spread[1] < spread[0]


def test_without_the_projectors_calibration_both_pairs_of_the_first_camera_are_used(
    whole: Scan, tmp_path: Path
) -> None:
    document = json.loads((whole.bundle / "calibration.json").read_text())
    del document["projector"]
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    shares = []
    for names in (NAMES, ("above", "right")):
        bundle = with_cameras(whole.bundle, tmp_path, names).parent
        report = reconstructed(bundle, tmp_path / "-".join(names) / "alone", calibration=tmp_path / "calibration.json")
        assert report["truth"]["gross_fraction"] < 0.001
        assert 0.85 <= report["truth"]["error_over_sigma_p68"] <= 1.1
        shares.append(report["truth"]["complete_0.1mm"])
    # The camera at the left sees what the one at the right does not, at a poor angle.
    assert shares[0] > shares[1] + 0.04

"""Scans of one scene by different instruments, and how far their meshes are from one another and from the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from simulated_rig.device import simulated_head
from slrig.config import read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.meshing.quality import TruthScore, score
from slrig.meshing.search_tree import SearchTree
from slrig.model import FloatArray, Mesh, Truth
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.e2e.conftest import Start, write_rig

EXPOSURE_S = 0.0167
SCENE = """
name = "ball before a wall"
[[object]]
name = "wall"
shape = "plane"
size_mm = [160.0, 130.0]
rotation_deg = [8.0, -12.0, 0.0]
position_mm = [0.0, 0.0, 20.0]
albedo = 0.8
[[object]]
name = "ball"
shape = "sphere"
radius_mm = 26.0
position_mm = [-8.0, 4.0, -8.0]
albedo = 0.6
"""


@dataclass(frozen=True)
class Scanned:
    """One scan: its mesh, and the folders of its results and of its frames."""

    mesh: Mesh
    results: Path
    bundle: Path

    @property
    def report(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.results / "report.json").read_text())
        return found


def rendered_rig(folder: Path, *, seed: int) -> Path:
    """The rig file of the simulator alone."""
    return write_rig(folder, scene=SCENE, head=f"seed = {seed}\nexposure_s = {EXPOSURE_S}")


def scanned_here(rig: Rig, folder: Path) -> Scanned:
    """Scan in this process."""
    bundle, results = folder / "bundle", folder / "results"
    with rig:
        capture_frames(rig, ScanPlan(), bundle, progress=lambda *_: None, cancelled=lambda: False).finish()
    reconstruct_bundle(bundle, results, plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False)
    return Scanned(mesh_in(results), results, bundle)


def rendered(folder: Path, *, seed: int) -> Scanned:
    """Scan by the simulator alone."""
    rig = open_rig(read_rig(rendered_rig(folder, seed=seed)))
    return scanned_here(rig, folder)


def served(start: Start, rig: Path, data: Path) -> Scanned:
    """Serve a rig, POST one scan, and wait for its end."""
    service = start(rig, data)
    with service.client() as client:
        scan = client.scans.start()
        for _ in client.follow(scan["links"]["events"]):
            pass
        record = client.get(scan["links"]["self"])
    assert record["state"] == "succeeded", f"{record}\n{service.log.read_text()[-3000:]}"
    assert service.stop() == 0
    folder = data / "scans" / str(record["id"])
    return Scanned(mesh_in(folder), folder, folder / "bundle")


def truth_of(rig: Path) -> Truth:
    """What the rendered rig of this file knows of its scene."""
    config = read_rig(rig)
    assert config.head is not None
    return simulated_head(config.head.options, rig.parent).truth()


def mesh_in(results: Path) -> Mesh:
    """The mesh that a scan wrote, as far as its shape goes."""
    read = trimesh.load_mesh(results / "mesh.ply", process=False)
    count = len(read.vertices)
    return Mesh(
        np.asarray(read.vertices, np.float32),
        np.asarray(read.faces, np.int32),
        np.asarray(read.vertex_normals, np.float32),
        np.zeros((count, 3), np.uint8),
        np.zeros(count, np.uint8),
        np.full(count, np.nan, np.float32),
        np.zeros(count, np.int32),
    )


def distances_mm(first: Mesh, second: Mesh) -> NDArray[np.float64]:
    """(n,): from the vertices of either mesh to the other's surface."""
    ways = []
    for mesh, other in ((first, second), (second, first)):
        surface = SearchTree.over(np.asarray(other.vertices_mm, np.float64), other.faces)
        ways.append(surface.distances_mm(np.asarray(mesh.vertices_mm, np.float64)))
    return np.concatenate(ways)


def rms_mm(pairs: Iterable[NDArray[np.float64]], *, below_mm: float) -> float:
    """Root mean square of the distances of pairs of meshes, each pair with the same weight, without gross ones."""
    return float(np.sqrt(np.mean([np.mean(distances[distances < below_mm] ** 2) for distances in pairs])))


def scored(mesh: Mesh, truth: Truth, eye_mm: FloatArray) -> TruthScore:
    """A mesh against what was there to be scanned."""
    (camera,) = truth.cameras.values()
    return score(mesh, truth.surface, camera.visible_points_mm, eye_mm)

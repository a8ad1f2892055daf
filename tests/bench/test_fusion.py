"""Fusion against what people use today, on the same views: Open3D's screened Poisson.

pip install '.[test,bench]'                          # in a virtual environment of its own
pytest tests/bench/test_fusion.py -s -p no:dash
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import trimesh

from slrig.meshing.search_tree import SearchTree
from slrig.meshing.topology import topology_counts
from slrig.views.fusion import fused
from tests.unit.views.known_views import View, around, plate_on_box, star, views_of

PIXEL_MM = 0.1
Surface = tuple[np.ndarray, np.ndarray]


def ours(views: list[View]) -> Surface:
    mesh = fused([view.mesh for view in views], [view.pose for view in views]).mesh
    return mesh.vertices_mm.astype(float), mesh.faces


def poisson(views: list[View], depth: int) -> Surface:
    import open3d as o3d

    points = np.concatenate([view.mesh.vertices_mm @ view.pose[:3, :3].T + view.pose[:3, 3] for view in views])
    normals = np.concatenate([view.mesh.normals @ view.pose[:3, :3].T for view in views])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals.astype(float))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=2)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


@pytest.mark.parametrize(("name", "share"), [("ball with bumps", 1.1), ("box with a thin plate", 0.9)])
def test_fusion_beside_poisson(name: str, share: float, capsys: pytest.CaptureFixture[str]) -> None:
    """Poisson smooths: on a surface without edges it may be a little better, at its best depth."""
    if importlib.util.find_spec("open3d") is None:
        pytest.skip("Open3D is not installed; pip install '.[test,bench]' in a fresh venv")
    truth = star(subdivisions=7) if name == "ball with bumps" else plate_on_box()
    views = views_of(truth, around(8), PIXEL_MM)
    known = SearchTree.over(truth.vertices, np.asarray(truth.faces, np.int32))
    ours(views)  # compiled

    def figures(method: str, made: Callable[[], Surface]) -> tuple[float, float]:
        begun = time.process_time()
        vertices, faces = made()
        cpu_s = time.process_time() - begun
        points = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), 100_000, seed=0)[0]
        off = known.distances_mm(points)
        rms_um = 1e3 * float(np.sqrt((off**2).mean()))
        crossed = topology_counts(np.asarray(faces, np.int32)).nonmanifold_edges
        with capsys.disabled():
            print(  # noqa: T201
                f"\n{name}, {method}: {len(faces)} triangles, rms {rms_um:.1f} µm, "
                f"99 % {1e3 * np.quantile(off, 0.99):.1f} µm, "
                f"{crossed} non-manifold edges, {cpu_s:.1f} CPU s",
                end="",
            )
        return rms_um, cpu_s

    rms_um, cpu_s = figures("slrig", lambda: ours(views))
    peers = [figures(f"Poisson, depth {depth}", partial(poisson, views, depth)) for depth in (8, 9)]
    assert rms_um < share * min(other for other, _ in peers)
    assert cpu_s <= min(other for _, other in peers)

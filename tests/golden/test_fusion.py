"""Eight views of surfaces that are known, fused at the default voxel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from slrig.meshing.quality import SearchTree
from slrig.meshing.topology import TopologyCounts, topology_counts
from slrig.multiview.fusion import fuse_views
from tests.unit.multiview.known_views import around, plate_on_box, star, torus, views_of

# 20 mm in size; a point each 0.12 mm, so that voxels are of 0.17 mm; σ from 10 µm and 4 µm that neighbours share.
PIXEL_MM = 0.12
OBJECTS: dict[str, tuple[Callable[[], trimesh.Trimesh], int]] = {
    "ball with bumps": (star, 2),
    "box with a thin plate": (plate_on_box, 2),
    "torus": (torus, 0),
}


def require_one_model(truth: trimesh.Trimesh, count: int) -> TopologyCounts:
    """See that views from all around make one model, better than each of them; its topology."""
    views = views_of(truth, around(count), PIXEL_MM)
    known = SearchTree.build(truth.vertices, np.asarray(truth.faces, np.int32))
    model = fuse_views([view.mesh for view in views], [view.pose for view in views])

    def errors_mm(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return known.distances_mm(trimesh.sample.sample_surface(mesh, 100_000, seed=0)[0])

    single = [
        errors_mm(view.mesh.vertices_mm @ view.pose[:3, :3].T + view.pose[:3, 3], view.mesh.faces) for view in views
    ]
    off = errors_mm(model.mesh.vertices_mm, model.mesh.faces)
    assert np.sqrt((off**2).mean()) < 0.8 * np.mean([np.sqrt((each**2).mean()) for each in single])
    assert np.quantile(off, 0.99) < 0.040
    counts = topology_counts(model.mesh.faces)
    assert (counts.nonmanifold_edges, counts.misoriented_edges, counts.duplicate_faces) == (0, 0, 0)
    seen = np.concatenate([view.seen_mm for view in views])[::7]
    assert (SearchTree.build(model.mesh.vertices_mm, model.mesh.faces).distances_mm(seen) < 0.1).mean() > 0.995
    over_sigma = np.quantile(known.distances_mm(model.mesh.vertices_mm) / model.mesh.sigma_mm, 0.6827)
    assert 0.8 < over_sigma < 1.25
    return counts


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_eight_views_make_one_model(name: str) -> None:
    made, euler = OBJECTS[name]
    counts = require_one_model(made(), 8)
    # In the corner between plate and box there are places that no view has a point near.
    holes = counts.boundary_edges // 3
    assert holes <= (1 if name == "box with a thin plate" else 0)
    assert counts.euler_characteristic == euler - holes

"""What a rendered rig knows of its scene, kept beside its bundle.

`truth.ply` is the surface (binary little endian), `visible_points.npy` the points of it that the first camera sees lit
by the projector, `truth-CAMERA.npz` the maps of each camera. Maps and surface are float32 on disk: at a distance of one
metre that is 0.06 micrometres, far below what is measured.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slrig.bundle.storage import write_file
from slrig.errors import BundleError
from slrig.model import CameraTruth, FloatArray, Surface, Truth

SURFACE = "truth.ply"
VISIBLE = "visible_points.npy"
MAPS = "truth-{camera}.npz"


@dataclass(frozen=True, slots=True)
class BundleTruth:
    """Truth read from a bundle. Bundles of other renderers have no maps: `cameras` is empty then.

    visible_points_mm : (n, 3) float64, world: surface points seen by the first camera and lit by the projector.
    """

    surface: Surface
    visible_points_mm: FloatArray
    cameras: Mapping[str, CameraTruth]


def write_truth(folder: Path, truth: Truth) -> None:
    """Write the truth into a bundle's folder, each file whole or not at all. Raises StorageError: the disk refused."""
    import trimesh

    mesh = trimesh.Trimesh(truth.surface.vertices_mm, truth.surface.faces, process=False)
    write_file(folder / SURFACE, mesh.export(file_type="ply", vertex_normal=False))
    first = next(iter(truth.cameras.values()))
    data = io.BytesIO()
    np.save(data, first.visible_points_mm, allow_pickle=False)
    write_file(folder / VISIBLE, data.getvalue())
    for name, camera in truth.cameras.items():
        data = io.BytesIO()
        np.savez(
            data,
            depth_mm=camera.depth_mm.astype(np.float32),
            projector_px=camera.projector_px.astype(np.float32),
            visible_points_mm=camera.visible_points_mm,
        )
        write_file(folder / MAPS.format(camera=name), data.getvalue())


def read_truth(folder: Path) -> BundleTruth | None:
    """Return the truth beside a bundle, or None where there is none.
    Raises BundleError: one of its files is missing, cut, or of another shape.
    """
    if not (folder / SURFACE).exists() and not (folder / VISIBLE).exists():
        return None
    # A second, for what no live scan has.
    import trimesh

    path = folder / SURFACE
    try:
        mesh = trimesh.load_mesh(path, process=False)
        surface = Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))
        path = folder / VISIBLE
        visible = _points(np.load(path, allow_pickle=False))
        cameras = {}
        for path in sorted(folder.glob(MAPS.format(camera="*"))):
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as maps:
                cameras[path.stem.removeprefix("truth-")] = CameraTruth(
                    np.asarray(maps["depth_mm"], dtype=np.float64),
                    np.asarray(maps["projector_px"], dtype=np.float64),
                    _points(maps["visible_points_mm"]),
                )
    except (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as cause:
        message = f"{path}: expected truth beside the bundle, found: {cause}; render the scene again"
        raise BundleError(message) from cause
    return BundleTruth(surface, visible, cameras)


def _points(array: FloatArray) -> FloatArray:
    points = np.asarray(array, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"an array {points.shape} where (n, 3) was expected")
    return points

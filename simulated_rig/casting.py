"""Which triangle a ray meets first: embree where it is built (x86-64), trimesh's own caster elsewhere."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from slrig.errors import ConfigError
from slrig.model import FloatArray, IntArray

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    EMBREE = True
except ImportError:  # no wheel for this processor
    EMBREE = False


class RayCaster(Protocol):
    """A surface that rays can be cast at."""

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """(n,) int32: index of the first triangle along each ray, -1 where there is none.

        origin_mm : (3,) float64; directions : (n, 3) float64, unit.
        """
        ...


class EmbreeCaster:
    """Embree, in single precision about the middle of the scene.

    It only names the triangle; the caller computes the point in double precision, so its rounding moves no surface.
    """

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        self._middle = (vertices_mm.min(axis=0) + vertices_mm.max(axis=0)) / 2
        self._scene = EmbreeScene()
        # embreex reads the buffers as they lie in memory: by rows.
        vertices = np.ascontiguousarray(vertices_mm - self._middle, np.float32)
        TriangleMesh(scene=self._scene, vertices=vertices, indices=np.ascontiguousarray(faces, np.int32))

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """See `RayCaster`. Runs without the interpreter's lock."""
        origins = np.broadcast_to((origin_mm - self._middle).astype(np.float32), directions.shape)
        found: NDArray[np.int32] = self._scene.run(
            np.ascontiguousarray(origins), np.ascontiguousarray(directions, np.float32)
        )
        return found


class TreeCaster:
    """trimesh's R-tree caster: a hundred times slower, and everywhere."""

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        mesh = trimesh.Trimesh(vertices_mm, faces, process=False)
        self._mesh = trimesh.ray.ray_triangle.RayMeshIntersector(mesh)

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """See `RayCaster`."""
        origins = np.broadcast_to(origin_mm, directions.shape)
        return np.asarray(self._mesh.intersects_first(origins, directions), np.int32)


def build_caster(vertices_mm: FloatArray, faces: IntArray) -> RayCaster:
    """Return the fastest caster that this machine has. Raises ConfigError when it has none."""
    if EMBREE:
        return EmbreeCaster(vertices_mm, faces)
    try:
        return TreeCaster(vertices_mm, faces)
    except ImportError as error:
        message = "the rendered rig needs a ray caster: found neither embreex nor rtree; install one of them with pip"
        raise ConfigError(message) from error

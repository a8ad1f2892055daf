"""Peers: Delaunay triangles of the image, and a crust, both of the same cloud by Qhull through scipy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from slrig.model import FloatArray, IntArray, Surface
from tests.bench.peers.measuring import Meter, Phase
from tests.bench.peers.scene import Cloud, towards_camera, without_long_edges

_FLAT_MM3 = 1e-12
_FARTHEST_POLE_IN_EXTENTS = 10.0
_CORNERS_OF_SIDES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def image_delaunay(cloud: Cloud, meter: Meter) -> Surface:
    """Triangulate where the camera sees the points; drop long edges."""
    meter.enter(Phase.MESH)
    faces = Delaunay(cloud.pixels_px).simplices
    kept = without_long_edges(cloud.points_mm, faces, spacing_mm=cloud.spacing_mm)
    return towards_camera(cloud.points_mm, kept, cloud.eye_mm)


def crust(cloud: Cloud, meter: Meter) -> Surface:
    """The crust of Amenta, Bern and Kamvysselis (SIGGRAPH 1998): Delaunay triangles that no pole comes between.

    The triangles of the Delaunay tetrahedra of points and poles whose three corners are points. Long edges are
    dropped. The paper's last two steps, which filter by normals and extract a manifold, are not done.
    """
    meter.enter(Phase.MESH)
    # Centred, so that Qhull's tolerances are taken at the size of the object.
    points = cloud.points_mm - cloud.points_mm.mean(axis=0)
    both = np.concatenate((points, _poles(points)))
    solids = Delaunay(both).simplices
    sides = np.concatenate([solids[:, corners] for corners in _CORNERS_OF_SIDES])
    sides = sides[(sides < len(points)).all(axis=1)]
    faces = np.unique(np.sort(sides, axis=1), axis=0)
    kept = without_long_edges(cloud.points_mm, faces, spacing_mm=cloud.spacing_mm)
    return towards_camera(cloud.points_mm, kept, cloud.eye_mm)


def _poles(points: FloatArray) -> FloatArray:
    """(p, 3) float64: for each point, the two Voronoi vertices of its cell that lie farthest out on either side.

    A point on the convex hull has a cell without end: its first pole is at infinity, along the mean of the outward
    normals of its hull triangles, and only its second is a pole that counts. Poles farther than ten times the cloud's
    extent are left out too: they are at infinity but for rounding, and make Qhull ten times slower.
    """
    cells = Delaunay(points)
    centres, solid = _circumcentres(points, cells.simplices)
    point = np.asarray(cells.simplices)[solid].ravel()
    centre = np.repeat(np.arange(len(centres)), 4)
    reach = centres[centre] - points[point]
    far = np.einsum("ij,ij->i", reach, reach)

    first = _farthest(point, far, len(points))
    outward = np.zeros_like(points)
    has = first >= 0
    outward[has] = reach[first[has]]
    on_hull, hull_normals = _hull_normals(points, cells)
    outward[on_hull] = hull_normals[on_hull]

    behind = np.where(np.einsum("ij,ij->i", reach, outward[point]) < 0, far, -1.0)
    second = _farthest(point, behind, len(points))
    firsts = first[has & ~on_hull]
    seconds = second[second >= 0]
    seconds = seconds[behind[seconds] > 0]
    poles = centres[np.unique(centre[np.concatenate((firsts, seconds))])]
    extent = np.linalg.norm(np.ptp(points, axis=0))
    return np.asarray(poles[np.linalg.norm(poles, axis=1) < _FARTHEST_POLE_IN_EXTENTS * extent])


def _circumcentres(points: FloatArray, solids: NDArray[np.intc]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(m, 3) float64: centres of the spheres through the corners of each tetrahedron with a volume; which have one."""
    origin = points[solids[:, 0]]
    edges = points[solids[:, 1:]] - origin[:, None]
    solid = np.abs(np.linalg.det(edges)) > _FLAT_MM3
    half_squares = np.einsum("ijk,ijk->ij", edges, edges)[solid] / 2
    centres = np.linalg.solve(edges[solid], half_squares[..., None])[..., 0] + origin[solid]
    return np.asarray(centres), solid


def _farthest(point: NDArray[np.intc], far: FloatArray, count: int) -> NDArray[np.intp]:
    """(count,) intp: for each point the entry with its greatest value, -1 where it has no entry."""
    order = np.lexsort((far, point))
    last = np.flatnonzero(np.diff(point[order], append=-1))
    found = np.full(count, -1, dtype=np.intp)
    found[point[order][last]] = order[last]
    return found


def _hull_normals(points: FloatArray, cells: Delaunay) -> tuple[NDArray[np.bool_], FloatArray]:
    """(n,) bool: which points are on the convex hull; (n, 3) float64: sum of their outward triangle normals."""
    hull: IntArray = np.asarray(cells.convex_hull, dtype=np.int32)
    a, b, c = (points[hull[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    inward = np.einsum("ij,ij->i", normals, a - points.mean(axis=0)) < 0
    normals[inward] *= -1
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, hull[:, corner], normals)
    on_hull = np.zeros(len(points), dtype=bool)
    on_hull[hull] = True
    return on_hull, total

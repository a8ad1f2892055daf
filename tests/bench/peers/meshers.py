"""Peers that mesh our cloud: ball pivoting and Poisson by Open3D, Delaunay triangles of the image by scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import Delaunay, KDTree

from slrig.model import Surface
from tests.bench.peers.measuring import Meter, Phase
from tests.bench.peers.scene import Cloud, towards_camera, without_long_edges

_NORMAL_NEIGHBOURS = 16
_BALL_RADII_IN_SPACINGS = (1.0, 2.0, 4.0)
_POISSON_DEPTH = 9
_FARTHEST_IN_SPACINGS = 2.0


def image_delaunay(cloud: Cloud, meter: Meter) -> Surface:
    """Triangulate where the camera sees the points; drop long edges."""
    meter.enter(Phase.MESH)
    faces = Delaunay(cloud.pixels_px).simplices
    kept = without_long_edges(cloud.points_mm, faces, spacing_mm=cloud.spacing_mm)
    return towards_camera(cloud.points_mm, kept, cloud.eye_mm)


def ball_pivoting(cloud: Cloud, meter: Meter) -> Surface:
    """Balls of one, two and four spacings rolled over the cloud (Bernardini et al. 1999)."""
    import open3d

    meter.enter(Phase.MESH)
    radii_mm = [ratio * cloud.spacing_mm for ratio in _BALL_RADII_IN_SPACINGS]
    mesh = open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(
        _with_normals(cloud), open3d.utility.DoubleVector(radii_mm)
    )
    return _surface(mesh)


def poisson(cloud: Cloud, meter: Meter) -> Surface:
    """Screened Poisson at depth 9 (Kazhdan and Hoppe 2013), cut two spacings from the points.

    Cutting by support, as Open3D's tutorial does, either leaves surface where nothing was seen or takes more of what
    was: the share to cut is another for every scene.
    """
    import open3d

    meter.enter(Phase.MESH)
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(_with_normals(cloud), depth=_POISSON_DEPTH)
    away_mm, _ = KDTree(cloud.points_mm).query(np.asarray(mesh.vertices))
    mesh.remove_vertices_by_mask(away_mm > _FARTHEST_IN_SPACINGS * cloud.spacing_mm)
    return _surface(mesh)


def _with_normals(cloud: Cloud) -> Any:
    import open3d

    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points_mm))
    points.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    points.orient_normals_towards_camera_location(cloud.eye_mm)
    return points


def _surface(mesh: Any) -> Surface:
    return Surface(
        np.asarray(mesh.vertices, dtype=np.float64).copy(), np.asarray(mesh.triangles, dtype=np.int32).copy()
    )

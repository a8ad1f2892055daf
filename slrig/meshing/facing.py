"""Orientation of triangles to the devices, and detection of mirror images.

A triangle of the surface faces every device that measured it: the camera that sees it and the projector that lights it,
or both cameras of a pair. Light that a mirror sends on reverses the order of the columns in the camera's image, so the
triangles of such a phantom face only one of the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.topology import component_sizes
from slrig.model import FloatArray, IntArray

_MIN_SIGMA = 3.0
"""Standard deviations from edge-on; below them noise may have turned a triangle."""


@dataclass(frozen=True, slots=True)
class Viewpoints:
    """The devices that measured the points of a surface, by their centres of projection in the world, mm.

    centres_mm : (k, 3) float64. camera : (n,) int32, index of the camera whose pixel each point has; second : (n,)
    int32, that of the device with its second ray: the projector, or in a pair of cameras the second one. deviation_mm :
    (n, 3) float64, displacement of each point for one standard deviation.
    """

    centres_mm: FloatArray
    camera: NDArray[np.int32]
    second: NDArray[np.int32]
    deviation_mm: FloatArray


def facing_sides(points_mm: FloatArray, faces: IntArray, views: Viewpoints, /) -> NDArray[np.int8]:
    """(F,) int8: 1 where every device that measured a triangle sees its front (counter-clockwise), -1 where every one
    sees its back, 0 where they differ or one sees it edge-on.
    """
    sides = np.zeros(len(faces), dtype=np.int8)
    given = np.ascontiguousarray(points_mm), np.ascontiguousarray(faces), views.camera, views.second, views.centres_mm
    in_bands(_sides, len(faces), *given, sides)
    return sides


@dataclass(frozen=True, slots=True)
class FrontSides:
    """Orientation of triangles to the devices that measured them.

    mirrored : (F,) bool, mirror images: they face only one of their devices, and not because of noise.
    turned : (F,) bool, those whose vertices have to be reversed to run counter-clockwise seen from their camera.
    """

    mirrored: NDArray[np.bool_]
    turned: NDArray[np.bool_]


def front_sides(points_mm: FloatArray, faces: IntArray, views: Viewpoints, among: NDArray[np.bool_], /) -> FrontSides:
    """The sides of the triangles of strips, which wind alike between curves that follow each other.

    points_mm : (n, 3) float64; faces : (F, 3) int32. among : (F,) bool, the triangles that count.

    Noise turns single triangles that are nearly edge-on. So triangles oriented otherwise than the others that meet in a
    vertex are judged together: one of them has to be three standard deviations from edge-on for every device. Triangles
    turned by noise wind as the others, and flips of edges may correct them.
    """
    sides = facing_sides(points_mm, faces, views)
    usual = 1 if int(np.sum(sides, where=among, dtype=np.int64)) >= 0 else -1
    certain = np.zeros(len(faces), dtype=np.bool_)
    others = np.flatnonzero(among & (sides != usual))
    certain[others] = _is_certain(points_mm, faces[others], views)
    mirrored = _pieces_with(certain, faces, others[sides[others] == 0])
    # Only a pair of cameras sees both: its projector may light a part by way of a mirror, which reverses the columns.
    reversed_too = _pieces_with(certain, faces, others[sides[others] == -usual])
    return FrontSides(mirrored, reversed_too if usual > 0 else ~reversed_too)


def _pieces_with(certain: NDArray[np.bool_], faces: IntArray, members: IntArray) -> NDArray[np.bool_]:
    """(F,) bool: the members, indices of faces, in connected pieces of them with at least one certain face."""
    mask = np.zeros(len(faces), dtype=np.bool_)
    if certain[members].any():
        every = np.ones(len(members), dtype=np.bool_)
        mask[members] = component_sizes(faces[members], every, counted=certain[members]) > 0
    return mask


def _is_certain(points_mm: FloatArray, faces: IntArray, views: Viewpoints) -> NDArray[np.bool_]:
    """(F,) bool: no device sees the triangle within three standard deviations of edge-on."""
    certain = np.ones(len(faces), dtype=np.bool_)
    for index, centre_mm in enumerate(views.centres_mm):
        a, b, c = (points_mm[faces[:, corner]] - centre_mm for corner in range(3))
        # Six times the volume between triangle and centre, and how it changes with each corner.
        slopes = np.cross(b, c), np.cross(c, a), np.cross(a, b)
        volume = np.einsum("ij,ij->i", a, slopes[0])
        variance = np.zeros(len(faces))
        for corner, slope in enumerate(slopes):
            variance += np.einsum("ij,ij->i", slope, views.deviation_mm[faces[:, corner]]) ** 2
        unseen = ((views.camera[faces] != index) & (views.second[faces] != index)).all(axis=1)
        certain &= unseen | (volume**2 > _MIN_SIGMA**2 * variance)
    return certain


@kernel
def _sides(first: int, last: int, points: Any, faces: Any, camera: Any, second: Any, centres: Any, sides: Any) -> None:
    for face in range(first, last):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        least, most = np.inf, -np.inf
        for corner in range(3):
            point = faces[face, corner]
            for which in range(2):
                k = camera[point] if which == 0 else second[point]
                if corner > 0 and k == (camera[a] if which == 0 else second[a]):
                    continue
                px, py, pz = centres[k, 0] - points[a, 0], centres[k, 1] - points[a, 1], centres[k, 2] - points[a, 2]
                towards = x * px + y * py + z * pz
                least, most = min(least, towards), max(most, towards)
        sides[face] = 1 if least > 0.0 else -1 if most < 0.0 else 0

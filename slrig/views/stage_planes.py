"""What stands behind an object on a stage, its plate and backdrops, as planes; and views without it.

Found in a scan of the empty stage: the plane that most vertices lie on (RANSAC, Fischler and Bolles 1981), by least
squares then, and again without its vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import StageRefusedError
from slrig.meshing import used_vertices
from slrig.model import FloatArray, Mesh, PlaneKind, StageAxis, StagePlane

MARGIN_MM, MARGIN_SIGMAS = 1.0, 4.0
"""Of a plane: what is not flat, and turns with a plate that is not square to its axis; and its noise."""
_MOST_PLANES = 4
_LEAST_SHARE = 0.1
"""Of a scan's vertices: what is smaller is no plate and no backdrop."""
_FAR_MM, _NEAR_SIGMAS = 1.0, 4.0
"""How far a vertex of a plane may be from it at first, and of all deviations then. A surface that needs all of that
is curved.
"""
_TRIALS, _TRIED = 600, 4000
"""Planes through three vertices, of which one hits a plane of a fifth of all with 99 %; vertices that judge them."""
_LEAST_FLAT = 0.8
"""Share of a plane's vertices whose normal is within 30° of it: noise tilts triangles, and a crowd has any normal."""
_COSINE = 0.87
_PLATE_COSINE = 0.97
"""Of a plate's normal and the axis: 14°, more than any plate wobbles, and less than a backdrop leans."""
_LEAST_LEFT = 0.01
"""Of a view's vertices, after a cut: less is dust, and what is to be modelled lies behind the planes."""


def stage_planes(empty: Mesh, axis: StageAxis | None = None) -> tuple[StagePlane, ...]:
    """The planes of an empty stage, the largest first. axis : tells the plate from backdrops; without, all are those.

    Raises
    ------
    StageRefusedError
        Nothing in the scan is planar.
    """
    points, normals = empty.vertices_mm.astype(np.float64), empty.normals.astype(np.float64)
    if len(points) < 3:
        raise StageRefusedError(f"expected a scan of the empty stage, found {len(points)} vertices: scan it again")
    random = np.random.default_rng(len(points))  # by chance, and the same every time
    left = np.ones(len(points), dtype=np.bool_)
    found: list[StagePlane] = []
    while len(found) < _MOST_PLANES and left.sum() > max(_LEAST_SHARE * len(points), 3):
        middle, normal = _commonest(points[left], random)
        mine, middle, normal, sigma = _fitted(points, left, middle, normal)
        flat = float(np.mean(np.abs(normals[mine] @ normal) > _COSINE)) if mine.any() else 0.0
        if mine.mean() < _LEAST_SHARE or flat < _LEAST_FLAT or _NEAR_SIGMAS * sigma > _FAR_MM:
            break
        found.append(_plane(points[mine], normals[mine], middle, normal, sigma, axis))
        # What is near it, and behind it, is part of it or hidden by it.
        left &= (points - middle) @ found[-1].normal > found[-1].margin_mm
    if not found:
        raise StageRefusedError(
            f"expected a plate or a backdrop in the scan of the empty stage, found no plane that holds "
            f"{_LEAST_SHARE:.0%} of its {len(points):,} vertices and is flat to {_FAR_MM / _NEAR_SIGMAS:g} mm: take "
            "the object away, light the plate, and scan it again"
        )
    return tuple(found)


def fitted_plane(points: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """A point (3,) and the normal (3,) of the plane that most points (n, 3) lie on, and the deviation of those; None
    where that is not half of them.
    """
    if len(points) < 3:
        return None
    everywhere = np.ones(len(points), dtype=np.bool_)
    mine, middle, normal, sigma = _fitted(points, everywhere, *_commonest(points, np.random.default_rng(len(points))))
    return (middle, normal, sigma) if mine.mean() > 0.5 else None


def _commonest(points: FloatArray, random: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A point and the normal of the plane through three points that is near to most."""
    tried = points[random.integers(len(points), size=_TRIED)]
    a, b, c = points[random.integers(len(points), size=(3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, np.inf)
    near = np.abs(tried @ normals.T - (a * normals).sum(axis=1)) < _FAR_MM
    best = int(np.argmax(np.where(length[:, 0] > 0, near.sum(axis=0), -1)))
    return a[best], normals[best]


def _fitted(
    points: FloatArray, left: NDArray[np.bool_], middle: FloatArray, normal: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, float]:
    """Which points are of a plane, and its middle, normal and deviation, by least squares within a narrowing reach."""
    reach, sigma = _FAR_MM, _FAR_MM
    mine = left & (np.abs((points - middle) @ normal) < reach)
    for _ in range(6):
        if mine.sum() < 3:
            break
        middle = points[mine].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[mine] - middle).T))[1][:, 0]
        off = (points - middle) @ normal
        sigma = float(1.4826 * np.median(np.abs(off[mine])))
        reach = min(_FAR_MM, max(_NEAR_SIGMAS * sigma, 1e-3))
        mine = left & (np.abs(off) < reach)
    return mine, middle, normal, sigma


def _plane(
    points: FloatArray, seen: FloatArray, middle: FloatArray, normal: FloatArray, sigma: float, axis: StageAxis | None
) -> StagePlane:
    # Normals of a scan's vertices point to the side from which they were seen.
    normal = normal * (1.0 if np.nanmedian(seen @ normal) > 0 else -1.0)
    radius = float(np.percentile(np.linalg.norm(points - middle, axis=1), 99))
    square = 0.0 if axis is None else abs(float(normal @ axis.direction))
    kind = PlaneKind.PLATE if square > _PLATE_COSINE else PlaneKind.BACKDROP
    margin = MARGIN_MM + MARGIN_SIGMAS * sigma
    if kind is PlaneKind.PLATE:
        # As it turns, a plate that leans against the axis rises at its rim, as seen, by twice what it leans.
        margin += 2 * radius * float(np.sqrt(max(1 - square**2, 0.0)))
    return StagePlane(kind, middle, normal, sigma, radius, margin)


class Cut(NamedTuple):
    """A view without the stage. removed : share of its vertices that went, by plane in order: of what is behind
    several, the first one's.
    """

    mesh: Mesh
    removed: tuple[float, ...]


def cut(view: Mesh, planes: Sequence[StagePlane], *, name: str = "the view") -> Cut:
    """A view without what lies behind planes or within their margin before them; triangles go with any vertex.

    Raises
    ------
    StageRefusedError
        Less than a hundredth would be left.
    """
    if not planes:
        return Cut(view, ())
    points = view.vertices_mm.astype(np.float64)
    kept = np.ones(len(points), dtype=np.bool_)
    removed = []
    for plane in planes:
        before = (points - plane.point_mm) @ plane.normal > plane.margin_mm
        removed.append(float(np.mean(kept & ~before)))
        kept &= before
    faces = view.faces[kept[view.faces].all(axis=1)]
    used = used_vertices(faces, len(points))
    if used.mean() < _LEAST_LEFT:
        told = ", ".join(f"{plane.kind} {share:.0%}" for plane, share in zip(planes, removed, strict=True))
        raise StageRefusedError(
            f"{name}: expected an object before the planes of the stage, found that a cut would leave "
            f"{used.mean():.1%} of the view ({told}). The stage or the cameras were moved: scan the empty stage again, "
            "or do not cut"
        )
    numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
    mesh = Mesh(
        vertices_mm=view.vertices_mm[used],
        faces=numbers[faces],
        normals=view.normals[used],
        colour=view.colour[used],
        mark=view.mark[used],
        sigma_mm=view.sigma_mm[used],
        stripe=view.stripe[used],
    )
    return Cut(mesh, tuple(removed))

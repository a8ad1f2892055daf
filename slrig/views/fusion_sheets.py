"""The views as sheets in the model's frame: what the kernels of fusion read, of all views in one set of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.kernels import kernel
from slrig.meshing import neighbours
from slrig.model import FloatArray, IntArray, Mesh
from slrig.views.matching import moved, turned

_RIGID = 1e-6  # a product of many poses in double precision keeps to 1e-12; what was typed or in float32 to 1e-7
_SAMPLED_FACES = 20_000  # of each view: their median area is known to a per cent
_SWEEPS = 4  # two each way follow any border over the few edges that an inset is wide


class Sheets(NamedTuple):
    """n vertices and T triangles of V views, the model's frame, millimetres.

    points_mm : (n, 3) float64; normals : (n, 3) float32; sigma_mm : (n,) float32; colour : (n, 3) uint8, sRGB;
    mark : (n,) uint8. inset_mm : (n,) float32, how far along edges the open border of the view is, cut at a limit.
    faces : (T, 3) int32 into all points. open_edges : (T,) uint8, bit k is set where no triangle lies across the edge
    opposite corner k. first_face, first_vertex : (V + 1,) int64, view v has the triangles
    first_face[v]:first_face[v + 1], and vertices alike.
    """

    points_mm: FloatArray
    normals: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    inset_mm: NDArray[np.float32]
    faces: IntArray
    open_edges: NDArray[np.uint8]
    first_face: NDArray[np.int64]
    first_vertex: NDArray[np.int64]


def sampling_mm(views: Sequence[Mesh]) -> float:
    """How far apart the views' vertices lie: the side of a square with the area of two triangles, median over views."""
    sides = []
    for view in views:
        a, b, c = (view.vertices_mm[corner].astype(np.float64) for corner in _sampled(view.faces).T)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        if np.isfinite(areas).any():
            sides.append(float(np.sqrt(2 * np.nanmedian(areas))))
    return float(np.median(sides)) if sides else float("nan")


def sheets(views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray, /, *, inset_mm: float) -> Sheets:
    """Take the views into the model's frame. Triangles with a vertex that has no place, normal or σ are left out.

    inset_mm : the insets are cut here.

    Raises
    ------
    ValueError
        The poses are not one for each view and rigid.
    InvalidInputError
        A view is no manifold (`neighbours`).
    NothingToReconstructError
        No view has a triangle.
    """
    _require_rigid(len(views), poses)
    points, normals, insets, faces, open_edges = [], [], [], [], []
    before = 0
    for number, (view, pose) in enumerate(zip(views, poses, strict=True)):
        placed = moved(pose, view.vertices_mm)
        # One sum each: an axis of three is slow.
        sound = np.isfinite(placed[:, 0] + placed[:, 1] + placed[:, 2] + view.normals[:, 0] + view.sigma_mm)
        kept = view.faces if sound.all() else view.faces[sound[view.faces].all(axis=1)]
        try:
            across = neighbours(kept, vertex_count=len(placed))
        except ValueError as error:
            message = f"view {number} is no manifold: {error}; take its mesh as slrig wrote it"
            raise InvalidInputError(message) from error
        a, b, c = (across < 0).astype(np.uint8).T
        border = a | b << 1 | c << 2
        inset = np.full(len(placed), inset_mm, dtype=np.float32)
        _insets(placed, np.ascontiguousarray(kept), border, inset)
        points.append(placed)
        normals.append(turned(pose, view.normals).astype(np.float32))
        insets.append(inset)
        faces.append(kept + np.int32(before))
        open_edges.append(border)
        before += len(placed)
    first_face = np.cumsum([0, *map(len, faces)])
    if first_face[-1] == 0:
        message = f"asked to fuse {len(views)} views, and none has a triangle with known normals and σ; scan again"
        raise NothingToReconstructError(message)
    return Sheets(
        np.concatenate(points), np.concatenate(normals), np.concatenate([view.sigma_mm for view in views]),
        np.concatenate([view.colour for view in views]), np.concatenate([view.mark for view in views]),
        np.concatenate(insets), np.concatenate(faces), np.concatenate(open_edges),
        first_face, np.cumsum([0, *map(len, points)]),
    )  # fmt: skip


def _sampled(faces: IntArray) -> IntArray:
    return faces[:: max(1, len(faces) // _SAMPLED_FACES)]


def _require_rigid(count: int, poses: Sequence[FloatArray] | FloatArray) -> None:
    if count != len(poses):
        message = f"expected one pose for each of the {count} views, found {len(poses)}"
        raise ValueError(message)
    for number, pose in enumerate(poses):
        if pose.shape != (4, 4):
            message = f"pose {number}: expected shape (4, 4), found {pose.shape}"
            raise ValueError(message)
        turn = pose[:3, :3]
        off = max(np.abs(turn @ turn.T - np.eye(3)).max(), np.abs(pose[3] - (0, 0, 0, 1)).max())
        if not (off < _RIGID and np.linalg.det(turn) > 0 and np.isfinite(pose).all()):
            message = (
                f"pose {number} is not rigid: it is {off:.2g} off a rotation and a shift; "
                "give R and t of x_model = R x_view + t as [[R, t], [0, 1]]"
            )
            raise ValueError(message)


@kernel(in_every_scan=False)
def _insets(points: Any, faces: Any, open_edges: Any, inset: Any) -> None:
    """Distances along edges from the open border, from 0 there up to what `inset` holds already."""
    for face in range(len(faces)):
        for corner in range(3):
            if open_edges[face] >> corner & 1:
                inset[faces[face, (corner + 1) % 3]] = inset[faces[face, (corner + 2) % 3]] = 0.0
    for sweep in range(_SWEEPS):
        changed = False
        for step in range(len(faces)):
            face = len(faces) - 1 - step if sweep % 2 else step
            for corner in range(3):
                a, b = faces[face, corner], faces[face, (corner + 1) % 3]
                gap = abs(inset[a] - inset[b])
                if gap == 0.0:
                    continue
                x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
                length = np.sqrt(x * x + y * y + z * z)
                if gap > length * (1 + 1e-6):  # of single precision
                    changed = True
                    if inset[a] > inset[b]:
                        inset[a] = inset[b] + length
                    else:
                        inset[b] = inset[a] + length
        if not changed:
            break

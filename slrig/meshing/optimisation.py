"""Global optimisation of a mesh by edge flips (Yang & Chen 2010, section 3.3).

Turn by turn: triangles wait in a queue, worst harmonic index first; each is tested against its neighbours and the first
edge that the rule would exchange is flipped; the two new triangles and their neighbours are tested in the next turn.

Departures from the paper:

- The first turn asks for every edge at once, on all cores, and only queues triangles with an edge to flip: on a scanned
  surface that is about one in a thousand. The sum of the indices is kept as an integer, so that it, and with it the
  mesh, is the same for any number of threads.
- The mean index does not fall at every flip: a flip that γ forces may raise it, and so may one that unfolds a tangle.
  Where it did not fall over a turn, the paper stops with the worse mesh. Here the turn is taken back and done again
  with only those flips that lower the index by themselves, and so from there on. The index then falls from turn to
  turn, without exception, so the end is sure and the mesh is never worse than before. Without this, noise as large as
  the spacing makes a mesh go round in circles for all 200 turns; on the strips of clean scans the guard is not met.
  It also means that the constrained rule does not undo what Dyer's rule has made of a mesh.
- An edge that joins two vertices which are joined already is never made, seen by walking round them.

Refusing flips that fold the surface over (normals more than 90° apart where they were not) was measured and left out:
on an unevenly sampled face 31 folds beyond 60° then remain of 75, without it none, since edges on their way out of a
fold pass through another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.adjacency import neighbours
from slrig.meshing.flips import BLOCK, GAMMA, constraint, prefer_flips, prefers_flip
from slrig.model import FlipRule, FloatArray, IntArray

NO_FLIPS, INDEX, TURN_LIMIT = "no flips", "index", "turn limit"
_FLAT_INDEX = 1e5  # that of a triangle some 30 000 times as long as high
_UNITS_PER_INDEX = 2.0**20  # 64 bits then hold the sum over 88 million triangles of the greatest index
_FACES_AT_ONCE = 16384  # that are worth calling a kernel for


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn (the paper's Fig. 10): triangles tested, edges flipped, mean harmonic index after it (Eq. 3 and 4)."""

    tested_triangles: int
    flipped_edges: int
    harmonic_index: float


@dataclass(frozen=True, slots=True)
class Optimised:
    """The optimised mesh and how it came about.

    faces, adjacency : (F, 3) int32, the same vertices, boundary and number of triangles as before, and `neighbours`.
    harmonic_index_before : mean over the triangles with an area, as in each turn; NaN if there are none.
    ended_by : "no flips", nothing was left to flip; "index", nothing was left that would also lower the mean index,
        which a turn without that condition had failed to lower; or "turn limit".
    """

    faces: IntArray
    adjacency: IntArray
    harmonic_index_before: float
    turns: tuple[Turn, ...]
    ended_by: str


def optimised(
    points_mm: FloatArray,
    faces: IntArray,
    /,
    *,
    rule: FlipRule = FlipRule.CONSTRAINED,
    gamma: float = GAMMA,
    most_turns: int = 200,
    among: NDArray[np.bool_] | None = None,
    adjacency: IntArray | None = None,
) -> Optimised:
    """Flip edges until the rule keeps all of them.

    Parameters
    ----------
    points_mm : (n, 3) float64.
    faces : (F, 3) int32, a consistently wound manifold; vertices may be pinched.
    gamma : radians; of no effect on the Delaunay rule.
    among : (F,) bool, the first turn tests the edges of these triangles only; later turns go where flips lead.
    adjacency : (F, 3) int32, `neighbours` of the faces, if known already.

    Raises
    ------
    ValueError
        gamma is not in [0, π], the shapes do not fit, or the faces are no manifold (`neighbours`).
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    for name, array, shape in (("among", among, faces.shape[:1]), ("adjacency", adjacency, faces.shape)):
        if array is not None and array.shape != shape:
            message = f"{name}: expected shape {shape}, as of the {len(faces)} faces, found {array.shape}"
            raise ValueError(message)
    cosine, sine = constraint(rule, gamma)
    across = neighbours(faces, vertex_count=len(points)) if adjacency is None else adjacency
    faces, across = faces.copy(order="C"), across.copy(order="C")
    everyone = np.ones(len(faces), dtype=np.bool_) if among is None else among
    flagged = np.zeros(len(faces), dtype=np.uint8)
    counted = in_bands(
        _scanned, len(faces), points, faces, across, everyone, cosine, sine, flagged, rows_at_least=_FACES_AT_ONCE
    )
    units, flat = (sum(each) for each in zip(*counted, strict=True)) if counted else (0, 0)
    before = _mean_index(len(faces), units, flat)
    stamps = np.zeros((2, len(faces)), dtype=np.int32)
    queue = _both_sides(flagged, across, stamps[0])
    valence = _valences(faces, len(points))

    turns: list[Turn] = []
    must_fall = False
    pass_number = 1
    ended_by = TURN_LIMIT
    while len(turns) < most_turns:
        # By index, worst first; the queue rises, and a stable sort keeps it so among equals.
        ordered = queue[np.argsort(-_indices_of(points, faces, queue), kind="stable")]
        while True:
            pass_number += 1
            log = np.zeros((len(ordered), 4), dtype=np.int32)
            following = np.zeros(6 * len(ordered), dtype=np.int32)
            tested, flips, waiting, more_units, more_flat = _turn(
                points, faces, across, valence, ordered, pass_number, stamps,
                cosine, sine, must_fall, log, following,
            )  # fmt: skip
            if must_fall or flips == 0 or (more_flat, more_units) < (0, 0):
                break
            _taken_back(faces, across, valence, log[:flips])
            must_fall = True
        units, flat = units + more_units, flat + more_flat
        if not turns:
            tested = int(np.count_nonzero(everyone))
        turns.append(Turn(tested, flips, _mean_index(len(faces), units, flat)))
        if flips == 0:
            ended_by = INDEX if must_fall else NO_FLIPS
            break
        queue = np.sort(following[:waiting])
    return Optimised(faces, across, before, tuple(turns), ended_by)


def _mean_index(count: int, units: int, flat: int) -> float:
    return units / _UNITS_PER_INDEX / (count - flat) if count > flat else math.nan


@kernel_part(inline="always")
def _index_units(points: Any, a: int, b: int, c: int) -> int:
    """4 (cot α + cot β + cot η) = (a² + b² + c²) / area in units of 2⁻²⁰, -1 for a triangle too flat to have one."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = 0.5 * math.sqrt(x * x + y * y + z * z)
    dots = ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz - (ux * vx + uy * vy + uz * vz)
    if area * _FLAT_INDEX > 2.0 * dots:
        return int(2.0 * dots / area * _UNITS_PER_INDEX)
    return -1


@kernel
def _indices_of(points: Any, faces: Any, queue: Any) -> Any:
    """(m,) float64: harmonic indices of the queued triangles, infinite where flat."""
    found = np.zeros(len(queue))
    for at in range(len(queue)):
        a, b, c = faces[queue[at]]
        units = _index_units(points, a, b, c)
        found[at] = units if units >= 0 else np.inf
    return found


@kernel
def _valences(faces: Any, vertex_count: int) -> Any:
    """(n,) int32: triangles at each vertex."""
    valence = np.zeros(vertex_count, dtype=np.int32)
    for face in range(len(faces)):
        for corner in range(3):
            valence[faces[face, corner]] += 1
    return valence


@kernel_part(inline="always")
def _corner_across(across: Any, face: int, other: int) -> int:
    """The corner of `face` that lies opposite its edge with `other`."""
    if across[face, 0] == other:
        return 0
    return 1 if across[face, 1] == other else 2


@kernel
def _scanned(
    first: int, last: int, points: Any, faces: Any, across: Any, among: Any, cosine: float, sine: float, flagged: Any
) -> Any:
    """Flag edges to flip, bit k of the lower-numbered face; return the sum of the indices in units, and flat faces."""
    units, flat, count = 0, 0, np.int64(0)
    corners, wanted = np.zeros(12 * BLOCK), np.zeros(BLOCK, dtype=np.bool_)
    edges = np.zeros(BLOCK, dtype=np.int32)
    for face in range(first, last):
        index = _index_units(points, faces[face, 0], faces[face, 1], faces[face, 2])
        if index >= 0:
            units += index
        else:
            flat += 1
        for k in range(3):
            other = across[face, k]
            if other > face and (among[face] or among[other]):
                p, q = faces[face, k + 1 if k < 2 else 0], faces[face, k - 1 if k else 2]
                # The corner that p and q leave over. Found by the edge, not by the neighbour: two triangles back
                # to back share three edges.
                w = faces[other, 0] + faces[other, 1] + faces[other, 2] - p - q
                for axis in range(3):
                    corners[axis * BLOCK + count] = points[p, axis]
                    corners[(3 + axis) * BLOCK + count] = points[q, axis]
                    corners[(6 + axis) * BLOCK + count] = points[faces[face, k], axis]
                    corners[(9 + axis) * BLOCK + count] = points[w, axis]
                edges[count] = 4 * face + k
                count += 1
        if count > BLOCK - 3 or face + 1 == last:
            prefer_flips(count, corners, cosine, sine, wanted)
            for at in range(count):
                if wanted[at]:
                    flagged[edges[at] >> 2] |= 1 << (edges[at] & 3)
            count = np.int64(0)
    return units, flat


@kernel
def _both_sides(flagged: Any, across: Any, queued: Any) -> Any:
    """The triangles on both sides of flagged edges, rising."""
    for face in range(len(flagged)):
        if flagged[face]:
            queued[face] = 1
            for k in range(3):
                if flagged[face] >> k & 1:
                    queued[across[face, k]] = 1
    return np.flatnonzero(queued).astype(np.int32)


@kernel_part
def _may_be_joined(faces: Any, across: Any, valence: Any, start: int, vertex: int, sought: int) -> bool:
    """False when the triangles round `vertex`, one of them `start`, are all of its triangles and none has `sought`."""
    seen = 1
    for side in range(2):
        face = start
        while True:
            k = 0 if faces[face, 0] == vertex else 1 if faces[face, 1] == vertex else 2
            after, before = k + 1 if k < 2 else 0, k - 1 if k else 2
            if faces[face, after] == sought or faces[face, before] == sought:
                return True
            face = across[face, after if side == 0 else before]
            if face == start:
                return bool(seen != valence[vertex])
            if face < 0:
                break
            seen += 1
    return bool(seen != valence[vertex])


@kernel
def _turn(
    points: Any, faces: Any, across: Any, valence: Any, queue: Any, pass_number: int, stamps: Any,
    cosine: float, sine: float, must_fall: bool, log: Any, following: Any,
) -> Any:  # fmt: skip
    """Flip what is to be flipped, in the order of the queue.

    stamps : (2, F) int32, the last pass in which a triangle was queued for the next turn, in which it was replaced.
    Returns triangles tested, edges flipped (in `log`), triangles to test next (in `following`), and by how much the
    sum of the indices and the number of flat triangles rose.
    """
    tested, flips, waiting, more_units, more_flat = 0, 0, 0, 0, 0
    queued, replaced = stamps[0], stamps[1]
    for at in range(len(queue)):
        t = queue[at]
        if replaced[t] == pass_number:
            continue
        tested += 1
        for k in range(3):
            u = across[t, k]
            if u < 0:
                continue
            # t = (f, p, q) and u = (w, q, p) become (f, p, w) and (w, q, f).
            m = _corner_across(across, u, t)
            k1, k2 = k + 1 if k < 2 else 0, k - 1 if k else 2
            m1, m2 = m + 1 if m < 2 else 0, m - 1 if m else 2
            f, p, q, w = faces[t, k], faces[t, k1], faces[t, k2], faces[u, m]
            if f == w or not prefers_flip(points, p, q, f, w, cosine, sine):
                continue
            # At a pinched vertex the walk does not see everything; the other end may then show that they are apart.
            if _may_be_joined(faces, across, valence, t, f, w) and _may_be_joined(faces, across, valence, u, w, f):
                # The edge in the way may be flipped yet.
                if queued[t] != pass_number:
                    queued[t] = pass_number
                    following[waiting] = t
                    waiting += 1
                continue
            units, flat = 0, 0
            for sign, a, b, c in ((-1, f, p, q), (-1, w, q, p), (1, f, p, w), (1, w, q, f)):
                index = _index_units(points, a, b, c)
                if index >= 0:
                    units += sign * index
                else:
                    flat += sign
            if must_fall and (flat, units) >= (0, 0):
                continue
            more_units += units
            more_flat += flat
            log[flips, 0], log[flips, 1], log[flips, 2], log[flips, 3] = t, k, u, m
            flips += 1
            beyond_pw, beyond_qf = across[u, m1], across[t, k1]
            faces[t, k2], faces[u, m2] = w, f
            across[t, k], across[t, k1] = beyond_pw, u
            across[u, m], across[u, m1] = beyond_qf, t
            if beyond_pw >= 0:
                across[beyond_pw, _corner_across(across, beyond_pw, u)] = t
            if beyond_qf >= 0:
                across[beyond_qf, _corner_across(across, beyond_qf, t)] = u
            valence[p] -= 1
            valence[q] -= 1
            valence[f] += 1
            valence[w] += 1
            replaced[t], replaced[u] = pass_number, pass_number
            for touched in (t, u, beyond_pw, beyond_qf, across[t, k2], across[u, m2]):
                if touched >= 0 and queued[touched] != pass_number:
                    queued[touched] = pass_number
                    following[waiting] = touched
                    waiting += 1
            break
    return tested, flips, waiting, more_units, more_flat


@kernel(in_every_scan=False)
def _taken_back(faces: Any, across: Any, valence: Any, log: Any) -> None:
    """Undo the flips of a turn, the last one first."""
    for at in range(len(log) - 1, -1, -1):
        t, k, u, m = log[at]
        k1, k2 = k + 1 if k < 2 else 0, k - 1 if k else 2
        m1, m2 = m + 1 if m < 2 else 0, m - 1 if m else 2
        f, p, w, q = faces[t, k], faces[t, k1], faces[t, k2], faces[u, m1]
        beyond_pw, beyond_qf = across[t, k], across[u, m]
        faces[t, k2], faces[u, m2] = q, p
        across[t, k], across[t, k1] = u, beyond_qf
        across[u, m], across[u, m1] = t, beyond_pw
        if beyond_pw >= 0:
            across[beyond_pw, _corner_across(across, beyond_pw, t)] = u
        if beyond_qf >= 0:
            across[beyond_qf, _corner_across(across, beyond_qf, u)] = t
        valence[p] += 1
        valence[q] += 1
        valence[f] -= 1
        valence[w] -= 1

"""The constrained edge-flip rule (Yang & Chen 2010, section 3.1), and Dyer's, which it extends.

For an edge pq with opposite vertices f and w: θ_pq = max(∠fpw, ∠fqw), θ_fw = max(∠pfq, ∠pwq).
θ_fw - θ_pq > γ: flip; θ_pq - θ_fw > γ: keep; otherwise Delaunay: flip if ∠pfq + ∠pwq > ∠fpw + ∠fqw.
The last alone is the rule of Dyer et al. (2007); differences of angles never exceed π, so γ = π leaves only that.

No angle is computed: each is kept as the pair (cosine, sine) up to a positive factor, so that sums and differences of
angles are products of complex numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.topology import neighbours
from slrig.model import FlipRule, FloatArray, IntArray

_HALF_PI, _QUARTER_PI = math.pi / 2, math.pi / 4
_TAN_EIGHTH_PI = math.sqrt(2.0) - 1.0
# Rational minimax approximation of (atan(x) - x) / x³ in x²: S. L. Moshier, "Methods and Programs for Mathematical
# Functions", 1989 (Cephes, atan.c); the denominator's leading coefficient is 1.
_P = (-8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1,
      -1.228866684490136173410e2, -6.485021904942025371773e1)  # fmt: skip
_Q = (2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2,
      4.853903996359136964868e2, 1.945506571482613964425e2)  # fmt: skip


@kernel_part(inline="always")
def angle_rad(sine: float, cosine: float) -> float:
    """atan2(sine, cosine) for sine >= 0, to two units in the last place: in [0, π]; 0 where both are 0."""
    across = abs(cosine)
    low, high = min(across, sine), max(across, sine)
    # atan(low / high) = π/4 + atan((low - high) / (low + high)) keeps the argument of the series below tan(π/8).
    near = low > _TAN_EIGHTH_PI * high
    x = (low - high if near else low) / (low + high if near else high)
    z = x * x
    above = (((_P[0] * z + _P[1]) * z + _P[2]) * z + _P[3]) * z + _P[4]
    below = ((((z + _Q[0]) * z + _Q[1]) * z + _Q[2]) * z + _Q[3]) * z + _Q[4]
    angle = x + x * z * above / below + (_QUARTER_PI if near else 0.0)
    angle = _HALF_PI - angle if sine > across else angle
    angle = math.pi - angle if cosine < 0.0 else angle
    return angle if high > 0.0 else 0.0


GAMMA = math.pi / 6  # the paper's γ
_COS_GAMMA, _SIN_GAMMA = math.cos(GAMMA), math.sin(GAMMA)
_TIE = 1e-12  # far above rounding: of two equal sums of angles neither is the wider
BLOCK = 488  # not a power of two: rows of a page each would share cache sets


class Constraint(NamedTuple):
    """γ as a unit complex number: the last arguments of `prefers_flip`."""

    cosine: float
    sine: float


def constraint(rule: FlipRule, gamma: float = GAMMA) -> Constraint:
    """γ of the constrained rule, radians; the Delaunay rule ignores it. Raises ValueError: gamma is not in [0, π]."""
    if not 0 <= gamma <= math.pi:
        message = f"gamma: expected an angle from 0 to π radians, found {gamma:g}; π/6 is the paper's"
        raise ValueError(message)
    if rule is FlipRule.DELAUNAY:
        return Constraint(-1.0, 0.0)
    return Constraint(math.cos(gamma), math.sin(gamma))


@kernel_part(inline="always")
def _angle(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any, cx: Any, cy: Any, cz: Any) -> Any:
    """∠abc in [0, π] as (cosine, sine) times a common positive factor."""
    ux, uy, uz = ax - bx, ay - by, az - bz
    vx, vy, vz = cx - bx, cy - by, cz - bz
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return ux * vx + uy * vy + uz * vz, math.sqrt(x * x + y * y + z * z)


@kernel_part(inline="always")
def _larger(c1: float, s1: float, c2: float, s2: float) -> Any:
    # sin(first - second) > 0 for angles in [0, π]. Without a branch, which could not be predicted.
    first = s1 * c2 - c1 * s2 > 0
    return c1 if first else c2, s1 if first else s2


@kernel_part(inline="always")
def _prefers(
    px: float, py: float, pz: float, qx: float, qy: float, qz: float,
    fx: float, fy: float, fz: float, wx: float, wy: float, wz: float, cos_gamma: float, sin_gamma: float,
) -> Any:  # fmt: skip
    """`prefers_flip` of coordinates, without a branch: a loop over it is vectorised."""
    fc, fs = _angle(px, py, pz, fx, fy, fz, qx, qy, qz)
    wc, ws = _angle(px, py, pz, wx, wy, wz, qx, qy, qz)
    pc, ps = _angle(fx, fy, fz, px, py, pz, wx, wy, wz)
    qc, qs = _angle(fx, fy, fz, qx, qy, qz, wx, wy, wz)
    at_fw_c, at_fw_s = _larger(fc, fs, wc, ws)
    at_pq_c, at_pq_s = _larger(pc, ps, qc, qs)
    # θ_fw - θ_pq as a complex number; |difference| > γ when the sine of |difference| - γ is positive.
    real = at_fw_c * at_pq_c + at_fw_s * at_pq_s
    imaginary = at_fw_s * at_pq_c - at_fw_c * at_pq_s
    forced = abs(imaginary) * cos_gamma - real * sin_gamma > 0
    # Both sums lie in [0, 2π): compare half-planes first, then the sine of their difference.
    fw_real, fw_imaginary = fc * wc - fs * ws, fc * ws + fs * wc
    pq_real, pq_imaginary = pc * qc - ps * qs, pc * qs + ps * qc
    fw_beyond, pq_beyond = fw_imaginary < 0, pq_imaginary < 0
    sine = fw_imaginary * pq_real - fw_real * pq_imaginary
    scale = math.sqrt(
        (fw_real * fw_real + fw_imaginary * fw_imaginary) * (pq_real * pq_real + pq_imaginary * pq_imaginary)
    )
    wider = (fw_beyond & (not pq_beyond)) | ((fw_beyond == pq_beyond) & (sine > _TIE * scale))
    return (forced & (imaginary > 0)) | ((not forced) & wider)


@kernel_part
def prefers_flip(
    points: Any, p: int, q: int, f: int, w: int, cos_gamma: float = _COS_GAMMA, sin_gamma: float = _SIN_GAMMA
) -> bool:
    """True when edge fw represents the surface better than edge pq. points : (n, 3) float64, mm."""
    wanted = _prefers(
        points[p, 0], points[p, 1], points[p, 2], points[q, 0], points[q, 1], points[q, 2],
        points[f, 0], points[f, 1], points[f, 2], points[w, 0], points[w, 1], points[w, 2], cos_gamma, sin_gamma,
    )  # fmt: skip
    return bool(wanted)


@kernel_part
def prefer_flips(count: int, corners: Any, cos_gamma: float, sin_gamma: float, flips: Any) -> None:
    """`prefers_flip` of up to BLOCK edges at once: flips, (BLOCK,) bool.

    corners : (12 BLOCK,) float64, BLOCK coordinates each: x, y and z of p, then of q, of f and of w.
    """
    for at in range(count):
        flips[at] = _prefers(
            corners[at], corners[BLOCK + at], corners[2 * BLOCK + at],
            corners[3 * BLOCK + at], corners[4 * BLOCK + at], corners[5 * BLOCK + at],
            corners[6 * BLOCK + at], corners[7 * BLOCK + at], corners[8 * BLOCK + at],
            corners[9 * BLOCK + at], corners[10 * BLOCK + at], corners[11 * BLOCK + at], cos_gamma, sin_gamma,
        )  # fmt: skip


NO_FLIPS, INDEX, ROUND_LIMIT = "no flips", "index", "turn limit"
_FLAT_INDEX = 1e5  # of a triangle about 30 000 times as long as high
_UNITS_PER_INDEX = 2.0**20  # 64 bits hold the sum over 88 million triangles of the largest index
_FACES_AT_ONCE = 16384  # enough to be worth a call of a kernel


@dataclass(frozen=True, slots=True)
class FlipRound:
    """One round of flips (Fig. 10): triangles tested, edges flipped, mean harmonic index after it (Eq. 3 and 4)."""

    tested_triangles: int
    flipped_edges: int
    harmonic_index: float


@dataclass(frozen=True, slots=True)
class EdgeOptimisation:
    """The optimised mesh and the statistics of its optimisation.

    faces, adjacency : (F, 3) int32, the same vertices, boundary and number of triangles as before, and `neighbours`.
    harmonic_index_before : mean over the triangles with an area, as in each turn; NaN if there are none.
    ended_by : "no flips", nothing was left to flip; "index", nothing was left that would also lower the mean index,
        which a turn without that condition had failed to lower; or "turn limit".
    """

    faces: IntArray
    adjacency: IntArray
    harmonic_index_before: float
    turns: tuple[FlipRound, ...]
    ended_by: str


def optimise_edges(
    points_mm: FloatArray,
    faces: IntArray,
    /,
    *,
    rule: FlipRule = FlipRule.CONSTRAINED,
    gamma: float = GAMMA,
    max_turns: int = 200,
    among: NDArray[np.bool_] | None = None,
    adjacency: IntArray | None = None,
) -> EdgeOptimisation:
    """Flip edges until the rule keeps all of them.

    points_mm : (n, 3) float64; faces : (F, 3) int32, a consistently wound manifold; vertices may be pinched. gamma :
    radians; the Delaunay rule ignores it. among : (F,) bool, the first turn tests the edges of these triangles only;
    later turns test around the flips. adjacency : (F, 3) int32, result of `neighbours`, if available.

    Raises ValueError: gamma is not in [0, π], the shapes do not fit, or the faces are not a manifold (see
    `neighbours`).
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
        _scan_edges, len(faces), points, faces, across, everyone, cosine, sine, flagged, rows_at_least=_FACES_AT_ONCE
    )
    units, flat = (sum(each) for each in zip(*counted, strict=True)) if counted else (0, 0)
    before = _mean_index(len(faces), units, flat)
    stamps = np.zeros((2, len(faces)), dtype=np.int32)
    queue = _faces_of_flagged_edges(flagged, across, stamps[0])
    valence = _valences(faces, len(points))

    turns: list[FlipRound] = []
    must_fall = False
    pass_number = 1
    ended_by = ROUND_LIMIT
    while len(turns) < max_turns:
        # By index, worst first; the queue rises, and a stable sort keeps it so among equals.
        ordered = queue[np.argsort(-_harmonic_indices(points, faces, queue), kind="stable")]
        while True:
            pass_number += 1
            log = np.zeros((len(ordered), 4), dtype=np.int32)
            following = np.zeros(6 * len(ordered), dtype=np.int32)
            tested, flips, waiting, more_units, more_flat = _flip_edges(
                points, faces, across, valence, ordered, pass_number, stamps,
                cosine, sine, must_fall, log, following,
            )  # fmt: skip
            if must_fall or flips == 0 or (more_flat, more_units) < (0, 0):
                break
            _undo_flips(faces, across, valence, log[:flips])
            must_fall = True
        units, flat = units + more_units, flat + more_flat
        if not turns:
            tested = int(np.count_nonzero(everyone))
        turns.append(FlipRound(tested, flips, _mean_index(len(faces), units, flat)))
        if flips == 0:
            ended_by = INDEX if must_fall else NO_FLIPS
            break
        queue = np.sort(following[:waiting])
    return EdgeOptimisation(faces, across, before, tuple(turns), ended_by)


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
def _harmonic_indices(points: Any, faces: Any, queue: Any) -> Any:
    """(m,) float64: harmonic indices of the queued triangles; infinite for flat ones."""
    found = np.zeros(len(queue))
    for at in range(len(queue)):
        a, b, c = faces[queue[at]]
        units = _index_units(points, a, b, c)
        found[at] = units if units >= 0 else np.inf
    return found


@kernel
def _valences(faces: Any, vertex_count: int) -> Any:
    """(n,) int32: number of triangles at each vertex."""
    valence = np.zeros(vertex_count, dtype=np.int32)
    for face in range(len(faces)):
        for corner in range(3):
            valence[faces[face, corner]] += 1
    return valence


@kernel_part(inline="always")
def _corner_across(across: Any, face: int, other: int) -> int:
    """The corner of `face` opposite the edge that it shares with `other`."""
    if across[face, 0] == other:
        return 0
    return 1 if across[face, 1] == other else 2


@kernel
def _scan_edges(
    first: int, last: int, points: Any, faces: Any, across: Any, among: Any, cosine: float, sine: float, flagged: Any
) -> Any:
    """Flag edges to flip (bit k of the lower-numbered face); return the sum of the indices in units, and flat faces."""
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
                # The corner that is neither p nor q. Found by the edge, not by the neighbour: two triangles back
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
def _faces_of_flagged_edges(flagged: Any, across: Any, queued: Any) -> Any:
    """The triangles on both sides of flagged edges, in ascending order."""
    for face in range(len(flagged)):
        if flagged[face]:
            queued[face] = 1
            for k in range(3):
                if flagged[face] >> k & 1:
                    queued[across[face, k]] = 1
    return np.flatnonzero(queued).astype(np.int32)


@kernel_part
def _may_share_edge(faces: Any, across: Any, valence: Any, start: int, vertex: int, sought: int) -> bool:
    """True if `vertex` has an edge to `sought`, or may have one: a walk from the face `start` does not visit all of its
    triangles.
    """
    visited = 1
    for side in range(2):
        face = start
        while True:
            k = 0 if faces[face, 0] == vertex else 1 if faces[face, 1] == vertex else 2
            after, before = k + 1 if k < 2 else 0, k - 1 if k else 2
            if faces[face, after] == sought or faces[face, before] == sought:
                return True
            face = across[face, after if side == 0 else before]
            if face == start:
                return bool(visited != valence[vertex])
            if face < 0:
                break
            visited += 1
    return bool(visited != valence[vertex])


@kernel
def _flip_edges(
    points: Any, faces: Any, across: Any, valence: Any, queue: Any, pass_number: int, stamps: Any,
    cosine: float, sine: float, must_fall: bool, log: Any, following: Any,
) -> Any:  # fmt: skip
    """Flip edges in the order of the queue.

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
            # At a pinched vertex the walk is incomplete; the other end may show that they share none.
            if _may_share_edge(faces, across, valence, t, f, w) and _may_share_edge(faces, across, valence, u, w, f):
                # The edge in the way may still be flipped.
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
def _undo_flips(faces: Any, across: Any, valence: Any, log: Any) -> None:
    """Undo the flips of a round, in reverse order."""
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

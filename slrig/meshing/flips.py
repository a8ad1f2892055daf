"""The constrained edge-flip rule (Yang & Chen 2010, section 3.1), and Dyer's, which it extends.

For an edge pq with opposite vertices f and w: θ_pq = max(∠fpw, ∠fqw), θ_fw = max(∠pfq, ∠pwq).
θ_fw - θ_pq > γ: flip; θ_pq - θ_fw > γ: keep; otherwise Delaunay: flip if ∠pfq + ∠pwq > ∠fpw + ∠fqw.
The last alone is the rule of Dyer et al. (2007); differences of angles never exceed π, so γ = π leaves only that.

No angle is computed: each is kept as the pair (cosine, sine) up to a positive factor, so that sums and differences of
angles are products of complex numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

from slrig.model import FlipRule

GAMMA = math.pi / 6
_COS_GAMMA, _SIN_GAMMA = math.cos(GAMMA), math.sin(GAMMA)
_TIE = 1e-12


class Constraint(NamedTuple):
    """γ as a unit complex number: the last arguments of `prefers_flip`."""

    cosine: float
    sine: float


def constraint(rule: FlipRule, gamma: float = GAMMA) -> Constraint:
    """γ of the constrained rule, radians; the Delaunay rule has none, whatever `gamma` says.

    Raises
    ------
    ValueError
        gamma is not in [0, π].
    """
    if not 0 <= gamma <= math.pi:
        message = f"gamma: expected an angle from 0 to π radians, found {gamma:g}; π/6 is the paper's"
        raise ValueError(message)
    if rule is FlipRule.DELAUNAY:
        return Constraint(-1.0, 0.0)
    return Constraint(math.cos(gamma), math.sin(gamma))


@njit(cache=True, nogil=True, inline="always")
def _angle(points: Any, a: int, b: int, c: int) -> Any:
    """∠abc in [0, π] as (cosine, sine) times a common positive factor."""
    ux, uy, uz = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
    vx, vy, vz = points[c, 0] - points[b, 0], points[c, 1] - points[b, 1], points[c, 2] - points[b, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return ux * vx + uy * vy + uz * vz, math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, inline="always")
def _larger(c1: float, s1: float, c2: float, s2: float) -> Any:
    # sin(first - second) > 0 for angles in [0, π]
    if s1 * c2 - c1 * s2 > 0:
        return c1, s1
    return c2, s2


@njit(cache=True, nogil=True)
def prefers_flip(
    points: Any, p: int, q: int, f: int, w: int, cos_gamma: float = _COS_GAMMA, sin_gamma: float = _SIN_GAMMA
) -> bool:
    """True when edge fw represents the surface better than edge pq. points : (n, 3) float64, mm."""
    fc, fs = _angle(points, p, f, q)
    wc, ws = _angle(points, p, w, q)
    pc, ps = _angle(points, f, p, w)
    qc, qs = _angle(points, f, q, w)
    at_fw_c, at_fw_s = _larger(fc, fs, wc, ws)
    at_pq_c, at_pq_s = _larger(pc, ps, qc, qs)
    # θ_fw - θ_pq as a complex number; |difference| > γ when the sine of |difference| - γ is positive.
    real = at_fw_c * at_pq_c + at_fw_s * at_pq_s
    imaginary = at_fw_s * at_pq_c - at_fw_c * at_pq_s
    if abs(imaginary) * cos_gamma - real * sin_gamma > 0:
        return bool(imaginary > 0)
    # Both sums lie in [0, 2π): compare half-planes first, then the sine of their difference.
    fw_real, fw_imaginary = fc * wc - fs * ws, fc * ws + fs * wc
    pq_real, pq_imaginary = pc * qc - ps * qs, pc * qs + ps * qc
    fw_beyond, pq_beyond = fw_imaginary < 0, pq_imaginary < 0
    if fw_beyond != pq_beyond:
        return bool(fw_beyond)
    sine = fw_imaginary * pq_real - fw_real * pq_imaginary
    scale = math.sqrt((fw_real**2 + fw_imaginary**2) * (pq_real**2 + pq_imaginary**2))
    return bool(sine > _TIE * scale)

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

from slrig.kernels import kernel_part
from slrig.model import FlipRule

GAMMA = math.pi / 6  # the paper's γ
_COS_GAMMA, _SIN_GAMMA = math.cos(GAMMA), math.sin(GAMMA)
_TIE = 1e-12  # far above rounding: of two sums of angles that are equal, neither is the wider
BLOCK = 488  # not a power of two: rows of a page each would share their places in the cache


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


@kernel_part(inline="always")
def _angle(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any, cx: Any, cy: Any, cz: Any) -> Any:
    """∠abc in [0, π] as (cosine, sine) times a common positive factor."""
    ux, uy, uz = ax - bx, ay - by, az - bz
    vx, vy, vz = cx - bx, cy - by, cz - bz
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return ux * vx + uy * vy + uz * vz, math.sqrt(x * x + y * y + z * z)


@kernel_part(inline="always")
def _larger(c1: float, s1: float, c2: float, s2: float) -> Any:
    # sin(first - second) > 0 for angles in [0, π]. Which is larger cannot be foreseen: chosen without a jump.
    first = s1 * c2 - c1 * s2 > 0
    return c1 if first else c2, s1 if first else s2


@kernel_part(inline="always")
def _prefers(
    px: float, py: float, pz: float, qx: float, qy: float, qz: float,
    fx: float, fy: float, fz: float, wx: float, wy: float, wz: float, cos_gamma: float, sin_gamma: float,
) -> Any:  # fmt: skip
    """`prefers_flip` of coordinates, without a jump: a loop over it runs in vector registers."""
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

"""Angles of triangles, without a call into the mathematics library for each."""

from __future__ import annotations

import math

from slrig.kernels import kernel_part

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

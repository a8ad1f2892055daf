"""Small symmetric systems, in one thread.

The normal equations have a few hundred unknowns and are solved a thousand times. For matrices of that size a BLAS that
spreads its work over threads waits longer for them than it works, the more so when other programs use the processors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import kernel
from slrig.model import FloatArray


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """(n,) float64: x with matrix x = right, for a symmetric positive definite matrix (n, n); NaN where it is not that.

    By Cholesky's factors UᵀU.
    """
    factor = matrix.copy()
    x = right.copy()
    if not _solve_kernel(factor, x):
        x[:] = np.nan
    return x


@kernel(in_every_scan=False)
def _solve_kernel(a: Any, x: Any) -> bool:
    """Leave U in the upper triangle of a, and the solution in x; False for a pivot that is not positive."""
    count = len(x)
    for k in range(count):
        if not a[k, k] > 0:
            return False
        pivot = np.sqrt(a[k, k])
        for j in range(k, count):
            a[k, j] /= pivot
        x[k] /= pivot
        for i in range(k + 1, count):
            share = a[k, i]
            # Poses meet only through the devices: most of these are 0.
            if share != 0:
                for j in range(i, count):
                    a[i, j] -= share * a[k, j]
                x[i] -= share * x[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            x[k] -= a[k, j] * x[j]
        x[k] /= a[k, k]
    return True

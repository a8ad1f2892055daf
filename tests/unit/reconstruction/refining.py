"""The two steps of `refined`, each by itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.phase import FittedPoints, PositionMap, no_points, windows
from slrig.reconstruction.refinement import _crossings, _nothing_taken
from slrig.reconstruction.surface_fit import POINTS, fit_kernel


def line_crossings(
    seen: PositionMap, usable: NDArray[np.bool_], code: CodeMap, position_of: FloatArray, /
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Where lines cross pixels, by the position map alone: frame (n,) int32, starts_px (n, 2) and targets_px (n,)."""
    begun = _nothing_taken(len(position_of), usable.shape)
    return _crossings(seen, usable, code, position_of, *begun, no_points(0), np.zeros(0))


def fitted_points(
    seen: PositionMap, usable: NDArray[np.bool_], starts_px: FloatArray, targets_px: FloatArray, /
) -> FittedPoints:
    """Points of the image at which a local surface of the position map has the wanted positions."""
    fitted = no_points(len(starts_px))
    starts, targets = np.ascontiguousarray(starts_px), np.asarray(targets_px, dtype=np.float64)
    in_bands(fit_kernel, len(starts), *windows(seen, usable), starts, targets, fitted, rows_at_least=POINTS)
    return fitted

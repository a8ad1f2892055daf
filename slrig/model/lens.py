"""Brown's lens distortion and its derivatives (Brown 1966; parameters in OpenCV's form and order).

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y

with r² = x² + y². (x, y) are normalised coordinates in the plane at depth 1; they have no unit.

x and y are numbers, or float64 arrays of one shape. `slrig.model.lens_kernels` has the same functions compiled, and the
inverse. The rendered rig implements its own lens, so that an error of sign here cannot cancel in tests.
"""

from __future__ import annotations

from typing import TypeVar

from slrig.model.geometry import FloatArray

LENS_TERMS = ("k1", "k2", "p1", "p2", "k3")
"""The terms of the distortion, in the order of `Pinhole.distortion`."""

Coordinate = TypeVar("Coordinate", float, FloatArray)


def distort(
    lens: FloatArray, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]:
    """Return the distorted point and the derivatives: x', y', ∂x'/∂x, ∂x'/∂y = ∂y'/∂x, ∂y'/∂y.

    lens : (5,) float64, `LENS_TERMS`. The polynomial is valid only where the determinant of the derivatives is
    positive; beyond, it is no longer invertible and describes no light.
    """
    k1, k2, p1, p2, k3 = lens[0], lens[1], lens[2], lens[3], lens[4]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # ∂radial/∂r²
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def distortion_by_terms(
    a: float, b: float, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]:
    """Return the derivatives of a x' + b y' with respect to each of `LENS_TERMS`, in which x' and y' are linear."""
    r2 = x * x + y * y
    radial = (a * x + b * y) * r2
    return (
        radial,
        radial * r2,
        a * 2 * x * y + b * (r2 + 2 * y * y),
        a * (r2 + 2 * x * x) + b * 2 * x * y,
        radial * r2 * r2,
    )

"""The lens of a camera or projector: Brown's distortion and its derivatives (Brown 1966; the form and order of OpenCV).

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y

with r² = x² + y². (x, y) are normalised coordinates, of the plane at depth 1 before the device; they have no unit.

x and y are numbers, or float64 arrays of one shape. `slrig.model.lens_kernels` has the same functions compiled, and the
way back. The rendered rig has a lens of its own, so that an error of sign in this one cannot cancel itself.
"""

from __future__ import annotations

from typing import TypeVar

from slrig.model.rig import FloatArray

LENS_TERMS = ("k1", "k2", "p1", "p2", "k3")
"""The terms of the distortion, in the order of `Pinhole.distortion`."""

Coordinate = TypeVar("Coordinate", float, FloatArray)


def distorted(
    lens: FloatArray, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]:
    """Where the lens sends an undistorted point, and the slopes there: x', y', ∂x'/∂x, ∂x'/∂y = ∂y'/∂x, ∂y'/∂y.

    lens : (5,) float64, `LENS_TERMS`. Where the determinant of the slopes is not positive the distortion has turned
    back: whatever the polynomial says, the lens sends no light there.
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


def by_terms(
    a: float, b: float, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]:
    """The derivatives of a x' + b y' by each of `LENS_TERMS`, whatever these are: x' and y' are linear in them."""
    r2 = x * x + y * y
    radial = (a * x + b * y) * r2
    return (
        radial,
        radial * r2,
        a * 2 * x * y + b * (r2 + 2 * y * y),
        a * (r2 + 2 * x * x) + b * 2 * x * y,
        radial * r2 * r2,
    )

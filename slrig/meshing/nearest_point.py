"""The point of a triangle that is nearest to another point."""

from __future__ import annotations

from typing import Any

from slrig.kernels import kernel_part


@kernel_part
def on_triangle(
    px: float, py: float, pz: float, points: Any, a: int, b: int, c: int
) -> tuple[float, float, float, float]:
    """Squared distance from p to a triangle, and the weights of its corners in the nearest point: they add up to 1.

    Exact for slivers and collapsed triangles too. points : (n, 3), that a, b, c are rows of. Weights are exactly 0
    where the nearest point is on an edge. It is the foot of the perpendicular if that lies inside, else on an edge that
    the foot lies beyond (Ericson 2004, "Real-time collision detection", 5.1).
    """
    ax, ay, az = points[a, 0] - px, points[a, 1] - py, points[a, 2] - pz
    bx, by, bz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
    cx, cy, cz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    at_a, at_b, at_c = -1.0, -1.0, -1.0
    if square > 0.0:
        # Areas opposite each corner, times the square of the whole: negative where the foot is beyond that edge.
        at_a = nx * (by * cz - bz * cy) + ny * (bz * cx - bx * cz) + nz * (bx * cy - by * cx)
        at_b = nx * (cy * az - cz * ay) + ny * (cz * ax - cx * az) + nz * (cx * ay - cy * ax)
        at_c = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
        if at_a >= 0.0 and at_b >= 0.0 and at_c >= 0.0:
            height = nx * ax + ny * ay + nz * az
            return height * height / square, at_a / square, at_b / square, at_c / square
    best, wa, wb, wc = -1.0, 0.0, 0.0, 0.0
    if at_c < 0.0:
        gap, t = _on_edge(ax, ay, az, ux, uy, uz)
        best, wa, wb, wc = gap, 1.0 - t, t, 0.0
    if at_b < 0.0:
        gap, t = _on_edge(ax, ay, az, vx, vy, vz)
        if best < 0.0 or gap < best:
            best, wa, wb, wc = gap, 1.0 - t, 0.0, t
    if at_a < 0.0:
        gap, t = _on_edge(bx, by, bz, cx - bx, cy - by, cz - bz)
        if best < 0.0 or gap < best:
            best, wa, wb, wc = gap, 0.0, 1.0 - t, t
    return best, wa, wb, wc


@kernel_part(inline="always")
def _on_edge(px: float, py: float, pz: float, dx: float, dy: float, dz: float) -> tuple[float, float]:
    """Squared distance from the origin to the segment from p to p + d, and how far along it the nearest point is."""
    square = dx * dx + dy * dy + dz * dz
    t = 0.0
    if square > 0.0:
        t = min(max(-(px * dx + py * dy + pz * dz) / square, 0.0), 1.0)
    qx, qy, qz = px + t * dx, py + t * dy, pz + t * dz
    return qx * qx + qy * qy + qz * qz, t

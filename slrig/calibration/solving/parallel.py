"""Boards that are parallel to one another, of which no focal length follows.

Parallel boards have one vanishing line, and any lens turns one line into one normal: whatever the focal length, they
look parallel. So tilts are judged by the lens that was found; where its focal length is all but open, by an ordinary
one, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, Size

LEAST_TILT_DEG = 5.0
"""The least turn of the board between some two poses, about one axis."""

_ORDINARY_FOCAL = 1.3  # over the image's width
_WELL_KNOWN = 0.01

Lens = tuple[FloatArray, FloatArray]
"""Matrix (3, 3) and distortion (5,)."""


def refuse_parallel(
    name: str, size: Size, lens: Lens, found: tuple[Sequence[FloatArray], Sequence[FloatArray]],
    objects: Sequence[FloatArray], images: Sequence[FloatArray], /,
) -> None:  # fmt: skip
    """See that the boards of a camera's views are tilted to one another.

    found : turns and shifts of the views with that lens; objects, images : corners on the board and in the image.

    Raises
    ------
    SolveRefusedError
        They are not: the words say which tilts are missing.
    """
    sideways, upright = tilts_deg(lens, lens[0], objects, images)
    if not focal_deviation(lens, found, objects, images) <= _WELL_KNOWN * lens[0][0, 0]:
        focal = _ORDINARY_FOCAL * size.width_px
        ordinary = np.array([
            [focal, 0, (size.width_px - 1) / 2], [0, focal, (size.height_px - 1) / 2], [0, 0, 1]
        ])  # fmt: skip
        by_ordinary = tilts_deg(lens, ordinary, objects, images)
        if max(by_ordinary) < max(sideways, upright):
            sideways, upright = by_ordinary
    if max(sideways, upright) >= LEAST_TILT_DEG:
        return
    message = (
        f"in camera '{name}' the board is all but parallel to itself in all {len(objects)} poses: between them "
        f"it turns by {sideways:.1f}° sideways and nods by {upright:.1f}°, so that the focal length is not determined; "
        "shoot poses turned by 20° to 40° to the left and to the right, and nodded as much up and down"
    )
    raise SolveRefusedError(message)


def tilts_deg(
    lens: Lens, matrix: FloatArray, objects: Sequence[FloatArray], images: Sequence[FloatArray]
) -> tuple[float, float]:
    """Between all views, by how many degrees the board's normal turns sideways, and up and down.

    Distortion is taken off by the lens, directions are told by the matrix. The normal of a plane that vanishes in the
    line l is Kᵀ l (Hartley and Zisserman, §8.6).
    """
    normals = []
    for on_board, in_image in zip(objects, images, strict=True):
        straight = cv2.undistortPoints(in_image.reshape(-1, 1, 2), lens[0], lens[1], P=lens[0]).reshape(-1, 2)
        homography, _ = cv2.findHomography(on_board[:, :2], straight)
        if homography is None:
            continue
        normal = matrix.T @ np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        normals.append(normal / np.linalg.norm(normal) * (1 if normal[2] > 0 else -1))
    spread = np.array(normals)
    turned = np.degrees(np.arctan2(spread[:, 0], spread[:, 2]))
    nodded = np.degrees(np.arctan2(spread[:, 1], spread[:, 2]))
    return float(np.ptp(turned)), float(np.ptp(nodded))


def focal_deviation(
    lens: Lens, found: tuple[Sequence[FloatArray], Sequence[FloatArray]], objects: Sequence[FloatArray],
    images: Sequence[FloatArray],
) -> float:  # fmt: skip
    """Standard deviation of the focal length (fx), px, the poses and one radial term open; infinite where it is open.

    OpenCV states one of its own, and near a singular matrix that is far too small.
    """
    inner = 5
    whole, squares, count = np.zeros((inner, inner)), 0.0, 0
    for turn, shift, on_board, in_image in zip(*found, objects, images, strict=True):
        projected, jacobian = cv2.projectPoints(on_board.astype(np.float64), turn, shift, lens[0], lens[1])
        squares += float(np.sum((projected.reshape(-1, 2) - in_image) ** 2))
        count += 2 * len(in_image) - 6
        of_pose, of_lens = jacobian[:, :6], jacobian[:, 6 : 6 + inner]
        held = np.linalg.lstsq(of_pose, of_lens, rcond=None)[0]
        left = of_lens - of_pose @ held
        whole += left.T @ left
    scale = 1 / np.sqrt(np.maximum(np.diagonal(whole), 1e-300))
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    if values[0] <= 1e-12 or count <= inner:
        return np.inf
    variance = float(np.sum(vectors[0] ** 2 / values)) * scale[0] ** 2
    return float(np.sqrt(variance * squares / (count - inner)))

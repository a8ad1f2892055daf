"""A mesh as a camera sees it, under a headlight and a light from above: clay whose back is red.

Pictures are (H, W, 3) uint8, blue, green, red, as OpenCV has them.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing import rasterise, rasterise_normals
from slrig.model import Mesh, Pinhole, Pixels, Size
from slrig.scan.placing import placed_vertices, resampled

Picture = NDArray[np.uint8]

_SUPERSAMPLING = 2
_ROWS_AT_LEAST = 64  # in a band, a fifth of a millisecond
_BACKDROP = (74, 67, 63)
_COLOURS = np.array(((196, 209, 219), (92, 92, 176)), dtype=np.float64)  # of the front and of the back
_DARK, _HEADLIGHT, _SIDE_LIGHT = 0.12, 0.46, 0.44  # of the colour: everywhere, and from each light at most
_TO_VIEWER = np.array((0.0, 0.0, -1.0), dtype=np.float64)
_TO_SIDE_LIGHT = np.array((0.55, -0.65, -0.52), dtype=np.float64)  # above and on one side, in the camera's frame


def shaded(mesh: Mesh, camera: Pinhole) -> Picture:
    """The picture of `camera`, the second light on the side to which the surface leans."""
    wide, high = (extent * _SUPERSAMPLING for extent in (camera.size.width_px, camera.size.height_px))
    finer = resampled(camera, _SUPERSAMPLING, Size(wide, high))
    placed = placed_vertices(mesh.vertices_mm, finer)
    view = rasterise(placed, mesh.faces, finer.size)
    normals, front = rasterise_normals(view, placed, mesh.normals, mesh.faces)
    leaning = float(normals.sum(axis=0).sum(axis=0, dtype=np.float64) @ camera.rotation[0])
    to_side = _TO_SIDE_LIGHT * (math.copysign(1.0, leaning), 1.0, 1.0) / np.linalg.norm(_TO_SIDE_LIGHT)
    # Normals are in the world: rather than each of them, the lights are turned.
    lights = np.stack((_HEADLIGHT * _TO_VIEWER, _SIDE_LIGHT * to_side)) @ camera.rotation
    picture = np.full((*view.face.shape, 3), _BACKDROP, dtype=np.uint8)
    in_bands(_lit, len(picture), view.face, normals, front, lights, _COLOURS, picture, rows_at_least=_ROWS_AT_LEAST)
    return np.asarray(resized(picture, camera.size), dtype=np.uint8)


def resized(picture: Pixels, size: Size) -> Pixels:
    """The picture, (H, W) or (H, W, 3), at another size; itself if it has that size."""
    if picture.shape[:2] == size.shape:
        return picture
    larger = size.width_px > picture.shape[1]
    how = cv2.INTER_NEAREST if larger else cv2.INTER_AREA
    return np.asarray(cv2.resize(picture, (size.width_px, size.height_px), interpolation=how))


@kernel
def _lit(first: int, last: int, face: Any, normals: Any, front: Any, lights: Any, colours: Any, picture: Any) -> None:
    """Fill the rows from first to last where a triangle is seen: of each light, (2, 3), what falls on the normal."""
    for row in range(first, last):
        for column in range(face.shape[1]):
            if face[row, column] < 0:
                continue
            light = _DARK
            for number in range(2):
                falling = 0.0
                for axis in range(3):
                    falling += lights[number, axis] * normals[row, column, axis]
                light += max(falling, 0.0)
            side = 0 if front[row, column] else 1
            for channel in range(3):
                picture[row, column, channel] = min(light * colours[side, channel], 255.0)

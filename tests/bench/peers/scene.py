"""What a peer is given: the frames of a bundle's first camera, or the cloud of points that our own method found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slrig.bundle import read_bundle
from slrig.model import Axis, Black, FloatArray, Gray, IntArray, Pattern, Pinhole, Pixels, Surface, White

_RING = 6
_LONGEST_EDGE_RATIO = 6.0


@dataclass(frozen=True, slots=True)
class GrayFrames:
    """A column Gray code of one projector column per cell as the first camera saw it.

    direct, inverse : (bits, H, W) uint8, most significant bit first; white, black : (H, W) uint8.
    """

    direct: NDArray[np.uint8]
    inverse: NDArray[np.uint8]
    white: NDArray[np.uint8]
    black: NDArray[np.uint8]
    camera: Pinhole
    projector: Pinhole


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of a scan: points_mm (n, 3) float64, world; pixels_px (n, 2) float64, where the camera sees them.

    spacing_mm : the median over points of the mean distance to the six nearest, as a vertex has six neighbours.
    """

    points_mm: FloatArray
    pixels_px: FloatArray
    eye_mm: FloatArray
    spacing_mm: float


def read_gray_frames(bundle: Path) -> GrayFrames:
    """Return the Gray-code frames of a bundle's first camera.

    Raises
    ------
    ValueError
        The bundle has no calibration, or no 8-bit code of single columns with inverses, white and black.
    """
    recorded = read_bundle(bundle)
    calibration = recorded.calibration
    name, form = next(iter(recorded.capture.cameras.items()))
    if calibration is None or calibration.projector is None or form.bit_depth != 8:
        message = f"{bundle}: the peer needs a calibrated projector and camera, and 8-bit frames"
        raise ValueError(message)
    images: dict[Pattern, Pixels] = {
        recorded.capture.patterns[shot.pattern]: shot.image for shot in recorded.capture.shots if shot.camera == name
    }
    code = {p for p in images if isinstance(p, Gray) and p.axis is Axis.COLUMN}
    bits = max((p.bits for p in code), default=0)
    wanted = [[Gray(Axis.COLUMN, bit, bits, inverted=inverted) for bit in range(bits)] for inverted in (False, True)]
    if not code or not {White(), Black(), *wanted[0], *wanted[1]} <= images.keys():
        message = f"{bundle}: OpenCV's GrayCodePattern needs white, black, and a code of single columns with inverses"
        raise ValueError(message)
    direct, inverse = (np.stack([images[p] for p in side]).astype(np.uint8) for side in wanted)
    white, black = (images[p].astype(np.uint8) for p in (White(), Black()))
    return GrayFrames(direct, inverse, white, black, calibration.cameras[name], calibration.projector)


def read_cloud(bundle: Path, points_file: Path) -> Cloud:
    """Return the points that our own method wrote, with their pixels in the bundle's first camera."""
    recorded = read_bundle(bundle)
    if recorded.calibration is None:
        message = f"{bundle}: no calibration"
        raise ValueError(message)
    camera = recorded.calibration.cameras[next(iter(recorded.capture.cameras))]
    points_mm = np.ascontiguousarray(trimesh.load(points_file).vertices, dtype=np.float64)
    nearest_mm, _ = KDTree(points_mm).query(points_mm, k=_RING + 1)
    spacing_mm = float(np.median(np.asarray(nearest_mm)[:, 1:].mean(axis=1)))
    return Cloud(points_mm, projected_px(points_mm, camera), camera.centre_mm, spacing_mm)


def projected_px(points_mm: FloatArray, device: Pinhole) -> FloatArray:
    """(n, 2) float64: the pixels of points in the world, (n, 3), by OpenCV."""
    turn, _ = cv2.Rodrigues(device.rotation)
    pixels, _ = cv2.projectPoints(points_mm[:, None], turn, device.translation_mm, device.matrix, device.distortion)
    return np.asarray(pixels[:, 0], dtype=np.float64)


def without_long_edges(points_mm: FloatArray, faces: NDArray[Any], *, spacing_mm: float) -> IntArray:
    """(F, 3) int32: the triangles none of whose edges is longer than six spacings: the others skin a depth step."""
    corners = points_mm[faces]
    sides_mm = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return np.asarray(faces[(sides_mm <= _LONGEST_EDGE_RATIO * spacing_mm).all(axis=1)], dtype=np.int32)


def towards_camera(points_mm: FloatArray, faces: IntArray, eye_mm: FloatArray) -> Surface:
    """Return the surface with every triangle wound counter-clockwise as seen from the camera."""
    a, b, c = (points_mm[faces[:, corner]] for corner in range(3))
    away = np.einsum("ij,ij->i", np.cross(b - a, c - a), eye_mm - a) < 0
    turned = faces.copy()
    turned[away] = faces[away][:, ::-1]
    return Surface(points_mm, turned)

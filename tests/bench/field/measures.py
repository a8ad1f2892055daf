"""What a cloud of points covers, and how far it is from a capture's reference: one definition for all methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Camera = Mapping[str, Any]
"""As calibration.json describes it. All points are in its axes, mm."""

NEAR_PX, GROSS_PX = 4.0, 20.0  # camera pixels, at the distance of the surface
_NEIGHBOURS = 24  # reference points whose plane is the surface
_COMPANY = 5  # points near one another, itself one of them: one that has fewer is a stray
_ROUNDS = 20  # of a fit without gross errors


@dataclass(frozen=True, slots=True)
class Reference:
    """lit : pixels whose surface is asked for. compared : those of them where the reference is. points : (n, 3) of a
    published cloud; None where the reference is the plane of the points that are compared.
    """

    lit: Mask
    compared: Mask
    points: Floats | None = None


@dataclass(frozen=True, slots=True)
class Figures:
    """points : at lit pixels. covered : share of the lit pixels that have a point within `NEAR_PX` which is no stray.
    Of those that are compared: rms_mm : without gross errors. p95_mm : with them. gross : share. within_sigma : share
    whose error is below the stated one; None where none is stated.
    """

    points: int
    covered: float
    rms_mm: float
    p95_mm: float
    gross: float
    within_sigma: float | None


def among(cloud: Floats, lit: Mask, camera: Camera) -> Reference:
    """A published cloud without its strays, and the lit pixels among its own, but not those of its rim: beyond it is
    a surface as well.
    """
    cloud = cloud[_in_company(cloud, _pixel_mm(cloud, camera))]
    beside = cv2.dilate(_marked(cloud, lit.shape, camera), np.ones((5, 5), np.uint8))
    return Reference(lit, lit & (cv2.erode(beside, np.ones((9, 9), np.uint8)) > 0), cloud)


def figures(points: Floats, sigma_mm: Floats | None, reference: Reference, camera: Camera) -> Figures:
    """Compare (n, 3) points."""
    pixels = _pixels(points, camera)
    lit, compared = _in(reference.lit, pixels), _in(reference.compared, pixels)
    pixel_mm = _pixel_mm(points[lit] if reference.points is None else reference.points, camera)
    marked = _marked(points[_in_company(points, pixel_mm)], reference.lit.shape, camera)
    far = cv2.distanceTransform(1 - marked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    points = points[compared]
    if reference.points is None:
        error = from_plane(points, pixel_mm)
    else:
        error = from_surface(points, reference.points, pixel_mm)
    gross = error > GROSS_PX * pixel_mm
    return Figures(
        int(lit.sum()),
        float((far[reference.lit] <= NEAR_PX).mean()),
        float(np.sqrt((error[~gross] ** 2).mean())),
        float(np.percentile(error, 95)),
        float(gross.mean()),
        None if sigma_mm is None else float((error <= sigma_mm[compared]).mean()),
    )


def from_plane(points: Floats, pixel_mm: float) -> Floats:
    """Distance from the least-squares plane of all points but gross errors."""
    chosen, centre = points, np.median(points, axis=0)
    for _ in range(_ROUNDS):
        normal = np.linalg.svd(np.cov((chosen - centre).T))[2][2]
        off = np.abs((points - centre) @ normal)
        chosen = points[off <= max(GROSS_PX * pixel_mm, 4 * float(np.median(off)))]
        centre = chosen.mean(axis=0)
    return np.asarray(np.abs((points - centre) @ normal))


def from_surface(points: Floats, cloud: Floats, pixel_mm: float) -> Floats:
    """Distance from the plane of the nearest points of a cloud, at most that from the nearest one."""
    apart, index = cKDTree(cloud).query(points, _NEIGHBOURS)
    nearest = np.asarray(apart)[:, 0]
    around = cloud[index]
    centre = around.mean(axis=1)
    around -= centre[:, None]
    normal = np.linalg.svd(np.einsum("nki,nkj->nij", around, around))[2][:, 2]
    off = np.abs(np.einsum("ni,ni->n", points - centre, normal))
    return np.where(nearest <= NEAR_PX * pixel_mm, np.minimum(off, nearest), nearest)


def _in_company(points: Floats, pixel_mm: float) -> Mask:
    return np.asarray(np.asarray(cKDTree(points).query(points, _COMPANY)[0])[:, -1] <= NEAR_PX * pixel_mm)


def _pixel_mm(points: Floats, camera: Camera) -> float:
    return float(np.median(points[:, 2]) / camera["matrix"][0][0])


def _pixels(points: Floats, camera: Camera) -> NDArray[np.int64]:
    lens = np.array(camera["matrix"]), np.array(camera["distortion"])
    return np.asarray(np.rint(cv2.projectPoints(points, np.zeros(3), np.zeros(3), *lens)[0][:, 0]), dtype=np.int64)


def _in(mask: Mask, pixels: NDArray[np.int64]) -> Mask:
    inside: Mask = np.asarray(((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1))
    inside[inside] = mask[pixels[inside, 1], pixels[inside, 0]]
    return inside


def _marked(points: Floats, shape: tuple[int, ...], camera: Camera) -> NDArray[np.uint8]:
    marked = np.zeros(shape, dtype=np.uint8)
    pixels = _pixels(points, camera)
    column, row = pixels[_in(np.ones(shape, dtype=np.bool_), pixels)].T
    marked[row, column] = 1
    return marked

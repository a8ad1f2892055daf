"""Markers in a scan's own frames, and where on its surface they lie. Run by the worker and by `slrig model`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import DESCRIPTION, open_bundle
from slrig.calibration.detection import (
    MAX_SIGMA_PX,
    SIGMA_FLOOR_PX,
    GreyImage,
    PointFit,
    detect_markers,
    fit_corners,
    patch_offsets,
)
from slrig.calibration.printing import marker_dictionary
from slrig.errors import BundleError
from slrig.model import FloatArray, Mesh, Pinhole, Pixels, White
from slrig.multiview import MarkerObservation, fit_plane
from slrig.reconstruction import pixel_rays, project
from slrig.scan.artefacts import MESH

_REACH = 0.7
"""Of a module, from a marker's corner: inwards is its border, one wide, outwards paper, by a ChArUco board's least."""
_LEAST_HALF_PX, _MOST_HALF_PX = 3, 12
_FEWEST_VERTICES = 30
"""Of the mesh, on a marker: fewer tell no plane."""
_ALIKE = 30
"""So many neighbouring vertices err alike: rendered planes are as far off at their corners as that makes of them."""


def bundle_of(mesh_file: Path) -> Path:
    """The frames that a mesh was made of: beside it as the service and `slrig model --shoot` keep them, or the folder
    that it lies in. Raises BundleError: there are none.
    """
    scan = mesh_file.absolute().parent
    places = [scan / "bundle", scan, scan.parent / scan.name.replace("view-", "bundle-")]
    of_one = mesh_file.name == MESH  # any other file may be of any scan
    found = next((place for place in places if of_one and (place / DESCRIPTION).is_file()), None)
    if found is None:
        message = (
            f"{mesh_file}: expected the frames that it was made of, in which markers are looked for, found no "
            f"{DESCRIPTION} in {places[0]} or {scan} beside a {MESH}. Put the bundle "
            "there, or say in another way where scans belong"
        )
        raise BundleError(message)
    return found


def markers_of(mesh_file: Path, mesh: Mesh, dictionary: str) -> dict[int, MarkerObservation]:
    """The markers of a scan, by number, in the frame of its mesh: where rays through their corners, in each white frame
    of each camera, meet the plane of the mesh there. dictionary : OpenCV's name.

    Of several frames the corners are the mean, and known no better than in the best: they share the surface. A marker
    that is twice in a frame, or on which the mesh is no plane, is left out.

    Raises
    ------
    BundleError
        There are no frames, or none in white, or no calibration beside them.
    CalibrationError
        There is no such dictionary.
    """
    files = open_bundle(bundle_of(mesh_file))
    outline, known = files.outline, files.calibration
    white = [k for k, shot in enumerate(outline.shots) if isinstance(outline.patterns[shot.pattern], White)]
    if known is None or not white:
        what = "calibration.json" if known is None else "frame in white"
        message = f"{files.folder}: expected a {what}, without which no marker can be put on the surface, found none"
        raise BundleError(f"{message}; say in another way where the scan belongs")
    found: dict[int, list[MarkerObservation]] = {}
    for shot in files.shots(white, colour=False):
        camera = known.cameras.get(shot.camera)
        if camera is not None:
            for number, each in markers_in_view(
                shot.image, camera, outline.cameras[shot.camera].full_scale, mesh, dictionary
            ):
                found.setdefault(number, []).append(each)
    return {number: _mean(each) for number, each in found.items()}


def markers_in_view(
    image: Pixels, camera: Pinhole, full_scale: float, mesh: Mesh, dictionary: str
) -> Iterator[tuple[int, MarkerObservation]]:
    """The markers of one frame, (H, W), whose pixels clip at `full_scale`; see `markers_of`."""
    grey = GreyImage.from_pixels(image, full_scale)
    outlines, numbers = detect_markers(grey.image_8bit, dictionary)
    modules = int(marker_dictionary(dictionary).markerSize) + 2
    vertices = mesh.vertices_mm.astype(np.float64)
    places = project(camera, vertices)
    for number, rough in zip(numbers.tolist(), outlines, strict=True):
        mine = vertices[_inside(rough, places)]
        plane = fit_plane(mine) if len(mine) >= _FEWEST_VERTICES else None
        if plane is None or np.count_nonzero(numbers == number) > 1:
            continue
        middle, normal, off_mm = plane
        # Of a plane by n points, where these end: of its middle and two tilts, 1 / n each.
        off_mm *= np.sqrt(3 * _ALIKE / len(mine))
        placed = _placed(grey.level, rough, modules)
        sigma_px = np.hypot(placed.sigma_px, SIGMA_FLOOR_PX)
        if not (sigma_px < MAX_SIGMA_PX).all():  # NaN where a fit failed
            continue
        ways = pixel_rays(camera, placed.points_px)
        depth = (middle - camera.centre_mm) @ normal / (ways @ normal)
        cosine = np.abs(ways @ normal) / np.linalg.norm(ways, axis=1)
        # Of three coordinates the rms: pixels move a corner within the plane, farther where it is seen at a slant, and
        # the plane's own error along the ray.
        across_mm = sigma_px * depth / camera.matrix[0, 0]
        sigma = np.sqrt((across_mm**2 * (1 + cosine**-2) + (off_mm / cosine) ** 2) / 3)
        yield number, MarkerObservation(camera.centre_mm + depth[:, None] * ways, sigma)


def _placed(level: FloatArray, rough: FloatArray, modules: int) -> PointFit:
    """A marker's corners (4, 2), which OpenCV gives clockwise, by a fit to the pixels about each."""
    # Columns: one module along the side that follows a corner, and one along the side before it.
    slope = np.stack([np.roll(rough, -1, axis=0) - rough, np.roll(rough, 1, axis=0) - rough], axis=2) / modules
    half = int(np.clip(np.ceil(_REACH * np.abs(slope).sum(axis=2).max()), _LEAST_HALF_PX, _MOST_HALF_PX))
    offsets = patch_offsets(half) + (np.round(rough) - rough)[:, None]
    usable = np.abs(np.einsum("nij,nmj->nmi", np.linalg.inv(slope), offsets)).max(axis=2) < _REACH
    sides = slope.transpose(0, 2, 1) * np.array([[1.0], [-1.0]])
    return fit_corners(level, rough, sides, usable, half_px=half, outer=True)


def _inside(outline: FloatArray, places: FloatArray) -> NDArray[np.bool_]:
    """(n,): which places (n, 2) lie in a convex outline (4, 2), whichever way round it runs."""
    sides = np.roll(outline, -1, axis=0) - outline
    to = places[:, None] - outline
    left = sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0] > 0
    # NaN, behind the camera, is on no side.
    return np.asarray((left.all(axis=1) | ~left.any(axis=1)) & np.isfinite(places).all(axis=1))


def _mean(seen: list[MarkerObservation]) -> MarkerObservation:
    weight = np.array([each.sigma_mm for each in seen])[..., None] ** -2
    corners = (weight * [each.corners_mm for each in seen]).sum(axis=0) / weight.sum(axis=0)
    return MarkerObservation(corners, np.min([each.sigma_mm for each in seen], axis=0))

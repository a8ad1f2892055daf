"""The surface of a scan in the grid of one camera: for each pixel the point where its ray meets the mesh; and its
files.

It is made of the files of a finished scan, so that it can be made long after: the mesh, the calibration, and the
camera's map of causes.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from slrig.bundle import CALIBRATION, BundleFiles, open_bundle, read_calibration, read_description, stored_json
from slrig.disk import storage_errors
from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.jobs.data_folder import BUNDLE
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import merge_depth_buffers
from slrig.model import Calibration, FloatArray, IntArray, Mesh, Pinhole, Pixels, Refusal, White
from slrig.model.lens_kernels import distort, undistort
from slrig.plugins import formats
from slrig.reconstruction import CONVERGED, distorted_from_pixel, optical_depths_mm, pack_device, project
from slrig.ros_messages import POINT_FIELDS, point_table
from slrig.scan.artefacts import MESH, REPORT, decode_mesh_ply
from slrig.scan.formats import causes_picture

_NO_SURFACE = Refusal.NO_SURFACE.name.lower()
_MOST_BANDS = 4  # each has a picture of its own, which is 12 bytes a pixel
_FACES_AT_LEAST = 50_000
_ROWS_AT_LEAST = 16
_NEAR_PX = 0.02  # beside a triangle, that are tried: rounding, and what a lens bends an edge of _LARGE_PX
_FARTHEST_PX = 1e9  # beyond the picture, that corners lie
_LARGE_PX = 4.0  # of a triangle whose edges' bending is looked at


@dataclass(frozen=True, slots=True)
class OrganisedCloud:
    """Points in the grid of a camera, (H, W). They are finite exactly where `cause` is 0.

    device : the camera. points_mm : (H, W, 3) float32, in the world, on the ray of the pixel's centre, NaN for none.
    normals : (H, W, 3) float32, unit, as the mesh has them; NaN for none. sigma_mm : (H, W) float32, standard
    deviation along the normal. colour : (H, W, 3) uint8, sRGB. mark : (H, W) uint8, `AlbedoMark`. cause : (H, W) uint8,
    why there is no point, a place in `causes`, which are names.
    """

    camera: str
    device: Pinhole
    points_mm: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    cause: NDArray[np.uint8]
    causes: tuple[str, ...]


def organised(
    mesh: Mesh, camera: str, device: Pinhole, refused: NDArray[np.uint8], causes: Sequence[str]
) -> OrganisedCloud:
    """The mesh in the grid of a camera.

    refused : (H, W) uint8, the camera's causes; where there is one there is no point, even if a triangle, seen by
    another camera or closed over a gap, covers the pixel. causes : their names.
    """
    causes = causes if _NO_SURFACE in causes else [*causes, _NO_SURFACE]
    high, wide = device.size.shape
    seen = np.ascontiguousarray(mesh.vertices_mm.astype(np.float64) @ device.rotation.T + device.translation_mm)
    at_home = replace(device, rotation=np.eye(3), translation_mm=np.zeros(3))
    sight, faces = np.zeros((high, wide, 2)), np.ascontiguousarray(mesh.faces)
    in_bands(_sighted, high, pack_device(at_home), sight, rows_at_least=_ROWS_AT_LEAST)
    given = pack_device(at_home), seen, project(at_home, seen), faces, sight
    at_least = max(_FACES_AT_LEAST, -(-len(faces) // _MOST_BANDS))
    _, face = merge_depth_buffers(in_bands(_nearest, len(faces), *given, rows_at_least=at_least))
    # The map of causes was made of triangles in the image, whose edges a lens bends; and older ones do not say it.
    cause = np.where((refused == 0) & (face < 0), np.uint8(causes.index(_NO_SURFACE)), refused)
    points_mm, normals = (np.full((high, wide, 3), np.nan, dtype=np.float32) for _ in range(2))
    cloud = OrganisedCloud(
        camera=camera,
        device=device,
        points_mm=points_mm,
        normals=normals,
        sigma_mm=np.full((high, wide), np.nan, dtype=np.float32),
        colour=np.zeros((high, wide, 3), dtype=np.uint8),
        mark=np.zeros((high, wide), dtype=np.uint8),
        cause=cause,
        causes=tuple(causes),
    )
    of_mesh = mesh.vertices_mm, mesh.normals, mesh.sigma_mm, mesh.colour, mesh.mark
    of_cloud = cloud.points_mm, cloud.normals, cloud.sigma_mm, cloud.colour, cloud.mark
    in_bands(
        _filled, high, cause, face, sight, seen, faces,
        tuple(map(np.ascontiguousarray, of_mesh)), of_cloud, rows_at_least=_ROWS_AT_LEAST,
    )  # fmt: skip
    return cloud


@kernel(in_every_scan=False)
def _sighted(first: int, last: int, d: Any, sight: Any) -> None:
    """Fill the rows from first to last with the direction of each pixel's ray: (x, y) of (x, y, 1) in the device, NaN
    for what the lens cannot light.
    """
    for row in range(first, last):
        x, y, dx, dy = np.nan, np.nan, 0.0, 0.0
        for column in range(sight.shape[1]):
            xd, yd = distorted_from_pixel(d, column, row)
            # As far from the last pixel as that was from the one before: one step of Newton's method is then enough.
            nextx, nexty = undistort(d[5:10], xd, yd, x + dx, y + dy, CONVERGED)
            if np.isnan(nextx):
                nextx, nexty = undistort(d[5:10], xd, yd, xd, yd, CONVERGED)
            dx, dy = (nextx - x, nexty - y) if not np.isnan(x) else (0.0, 0.0)
            x, y = nextx, nexty
            sight[row, column, 0], sight[row, column, 1] = x, y


@kernel(in_every_scan=False)
def _nearest(
    first: int, last: int, d: Any, seen: Any, px: Any, faces: Any, sight: Any
) -> tuple[NDArray[np.float64], IntArray]:
    """Inverse depth, 0 where nothing is met, and number of the nearest among the triangles from first to last, -1 for
    none.

    A ray s meets the triangle a, b, c where s is a sum of the corners with the weights s·(b x c), s·(c x a), s·(a x b),
    none of another sign; these over a·(b x c) add up to inverse depth. Nothing is said of the picture, in which the
    lens bends edges: there only the pixels are chosen that are tried.
    """
    high, wide = sight.shape[:2]
    inverse = np.zeros((high, wide))
    nearest = np.full((high, wide), -1, dtype=np.int32)
    for face in range(first, last):
        a, b, c = seen[faces[face, 0]], seen[faces[face, 1]], seen[faces[face, 2]]
        if not (a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0):
            continue
        pa, pb, pc = px[faces[face, 0]], px[faces[face, 1]], px[faces[face, 2]]
        left, right, top, bottom = _box(d, a, b, c, pa, pb, pc, wide, high)
        # Most triangles of a dense scan lie between pixel centres.
        if left > right or top > bottom:
            continue
        ax, ay, az = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
        bx, by, bz = c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2], c[0] * a[1] - c[1] * a[0]
        cx, cy, cz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        volume = a[0] * ax + a[1] * ay + a[2] * az
        if not abs(volume) > 0.0:
            continue
        share = 1.0 / volume
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = sight[row, column, 0], sight[row, column, 1]
                wa = (x * ax + y * ay + az) * share
                wb = (x * bx + y * by + bz) * share
                wc = (x * cx + y * cy + cz) * share
                near = wa + wb + wc
                # Closed on all sides: a pixel on a shared edge is met twice, never missed.
                slack = -1e-9 * near
                if wa >= slack and wb >= slack and wc >= slack and near > inverse[row, column]:
                    inverse[row, column] = near
                    nearest[row, column] = face
    return inverse, nearest


@kernel_part
def _box(d: Any, a: Any, b: Any, c: Any, pa: Any, pb: Any, pc: Any, wide: int, high: int) -> Any:
    """First and last column, first and last row, of the pixels that may lie in a triangle's picture.

    a, b, c : its corners; pa, pb, pc : their pixels.
    """
    left, right = min(pa[0], pb[0], pc[0]), max(pa[0], pb[0], pc[0])
    top, bottom = min(pa[1], pb[1], pc[1]), max(pa[1], pb[1], pc[1])
    margin = _NEAR_PX
    if max(right - left, bottom - top) > _LARGE_PX:
        # An arc stays within its sagitta of the chord; twice as much, because a lens bends no arcs of circles.
        margin += 2 * max(_sagitta(d, a, b, pa, pb), _sagitta(d, b, c, pb, pc), _sagitta(d, c, a, pc, pa))
    if not (abs(left) + abs(right) + abs(top) + abs(bottom) + margin < _FARTHEST_PX):
        # A corner beside the camera, where the terms of the lens mean nothing.
        return 0, wide - 1, 0, high - 1
    return (
        int(np.ceil(max(left - margin, 0.0))),
        int(np.floor(min(right + margin, wide - 1.0))),
        int(np.ceil(max(top - margin, 0.0))),
        int(np.floor(min(bottom + margin, high - 1.0))),
    )


@kernel_part
def _sagitta(d: Any, a: Any, b: Any, pa: Any, pb: Any) -> Any:
    """How far, in pixels, the picture of the edge from a to b runs beside the middle of its chord."""
    xd, yd, _, _, _ = distort(d[5:10], (a[0] / a[2] + b[0] / b[2]) / 2, (a[1] / a[2] + b[1] / b[2]) / 2)
    across = abs(d[0] * xd + d[1] * yd + d[2] - (pa[0] + pb[0]) / 2)
    return max(across, abs(d[3] * yd + d[4] - (pa[1] + pb[1]) / 2))


@kernel(in_every_scan=False)
def _filled(first: int, last: int, cause: Any, face: Any, sight: Any, seen: Any, faces: Any, of: Any, to: Any) -> None:
    """Fill the rows from first to last where there is no cause against it. of : vertices, normals, deviations, colours
    and marks of the mesh; to : the same of the cloud.
    """
    vertices, normals, sigma, colour, mark = of
    to_points, to_normals, to_sigma, to_colour, to_mark = to
    weights = np.zeros(3)
    for row in range(first, last):
        for column in range(cause.shape[1]):
            if cause[row, column] != 0:
                continue
            corners = faces[face[row, column]]
            for k in range(3):
                p, q = seen[corners[(k + 1) % 3]], seen[corners[(k + 2) % 3]]
                weights[k] = (
                    sight[row, column, 0] * (p[1] * q[2] - p[2] * q[1])
                    + sight[row, column, 1] * (p[2] * q[0] - p[0] * q[2])
                    + (p[0] * q[1] - p[1] * q[0])
                )
            total = weights[0] + weights[1] + weights[2]
            largest, length, deviation = 0, 0.0, 0.0
            for k in range(3):
                weights[k] /= total
                deviation += weights[k] * sigma[corners[k]]
                if weights[k] > weights[largest]:
                    largest = k
            for axis in range(3):
                point, normal, shade = 0.0, 0.0, 0.0
                for k in range(3):
                    point += weights[k] * vertices[corners[k], axis]
                    normal += weights[k] * normals[corners[k], axis]
                    shade += weights[k] * colour[corners[k], axis]
                to_points[row, column, axis] = point
                to_normals[row, column, axis] = normal
                to_colour[row, column, axis] = np.uint8(shade + 0.5)
                length += normal * normal
            for axis in range(3):
                to_normals[row, column, axis] /= np.sqrt(length)
            to_sigma[row, column] = deviation
            to_mark[row, column] = mark[corners[largest]]


_MOST = 65535


def encode_npz(cloud: OrganisedCloud) -> bytes:
    """The arrays of a cloud as numpy's own archive, not packed: `numpy.load` reads it, and needs no pickle.

    Keys: points_mm, normals, sigma_mm, colour, mark, cause as in `OrganisedCloud`; causes (n,) str; camera and unit,
    () str.
    """
    out = io.BytesIO()
    np.savez(
        out,
        points_mm=cloud.points_mm,
        normals=cloud.normals,
        sigma_mm=cloud.sigma_mm,
        colour=cloud.colour,
        mark=cloud.mark,
        cause=cloud.cause,
        causes=np.array(cloud.causes),
        camera=np.array(cloud.camera),
        unit=np.array("mm"),
    )
    return out.getvalue()


def encode_depth_tiff(cloud: OrganisedCloud) -> bytes:
    """Depth along the camera's optical axis as a grey TIFF of 16 bits: offset + scale * value in mm, 0 for none.

    The nearest point is 1 and the farthest 65535, so that nothing is cut off; a step is a 65534th of what lies between.
    Scale, offset and unit are in the tag ImageDescription, as JSON, with the camera's matrix and lens: the picture is
    the camera's own, with the lens's distortion.
    """
    known = cloud.cause == 0
    z_mm = depths_mm(cloud)[known]
    offset, scale = 0.0, 1.0
    if len(z_mm):
        nearest = float(z_mm.min())
        scale = (float(z_mm.max()) - nearest) / (_MOST - 1) or 1.0
        offset = nearest - scale
    values = np.zeros(cloud.cause.shape, dtype=np.uint16)
    values[known] = np.clip(np.rint((z_mm - offset) / scale), 1, _MOST)
    told = {
        "depth": "offset + scale * value, along the optical axis",
        "unit": "mm",
        "scale": scale,
        "offset": offset,
        "none": 0,
        "camera": cloud.camera,
        "matrix": cloud.device.matrix.tolist(),
        "distortion": cloud.device.distortion.tolist(),
    }
    out = io.BytesIO()
    tifffile.imwrite(out, values, photometric="minisblack", description=json.dumps(told), metadata=None, software=False)
    return out.getvalue()


def depths_mm(cloud: OrganisedCloud) -> FloatArray:
    """(H, W) float64: depth of each point along the camera's optical axis, NaN for none."""
    points = cloud.points_mm.reshape(-1, 3).astype(np.float64)
    return optical_depths_mm(cloud.device, points).reshape(cloud.cause.shape)


def encode_pcd(cloud: OrganisedCloud) -> bytes:
    """PCD 0.7, binary, organised: x y z and sigma in mm, the normal, and rgb as PCL packs it; NaN where there is none.

    Points are in the world. VIEWPOINT is the camera there: its centre, mm, and the rotation from its axes to the
    world's as a quaternion, w x y z.
    """
    # Most of a second to load, and few scans are asked for as PCD.
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(cloud.device.rotation.T).as_quat(canonical=True)
    return pcd_of(point_table(cloud), POINT_FIELDS, (*cloud.device.centre_mm, w, x, y, z))


def pcd_of(table: NDArray[np.float32], fields: Sequence[str], viewpoint: Sequence[float]) -> bytes:
    """PCD 0.7, binary, organised. table : (H, W, fields) float32, little-endian. viewpoint : see `encode_pcd`."""
    high, wide, count = table.shape
    header = [
        "# .PCD v0.7 - slrig, millimetres",
        "VERSION 0.7",
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(['4'] * count)}",
        f"TYPE {' '.join(['F'] * count)}",
        f"COUNT {' '.join(['1'] * count)}",
        f"WIDTH {wide}",
        f"HEIGHT {high}",
        f"VIEWPOINT {' '.join(f'{float(each):.9g}' for each in viewpoint)}",
        f"POINTS {high * wide}",
        "DATA binary",
    ]
    return "\n".join(header).encode("ascii") + b"\n" + table.tobytes()


ENCODERS: Mapping[str, Callable[[OrganisedCloud], bytes]] = {
    "points-{camera}.npz": encode_npz,
    "points-{camera}.pcd": encode_pcd,
    "depth-{camera}.tiff": encode_depth_tiff,
}


def cloud_file(
    folder: Path,
    form: str,
    camera: str | None,
    *,
    bundle: Path | None = None,
    calibration: Path | None = None,
) -> bytes:
    """Make a file of a finished scan. form : of `slrig.scan.formats.requested_forms`. camera : None for a file of all.
    bundle : None for that of the scan. calibration : the one that the mesh was made with, None for that in the bundle.

    Raises
    ------
    InvalidInputError, CalibrationError, BundleError
        A file of the scan is not as slrig wrote it.
    ExtraMissingError
        The format takes a library that is not installed.
    NothingToReconstructError
        The camera sees nothing of the mesh, and the format has no form for that; or no camera has a map of causes.
    StorageError
        A file of the scan cannot be read.
    """
    bundle = bundle or folder / BUNDLE
    # A scan of a rig without a calibration has made its own.
    own = folder / CALIBRATION
    calibration = calibration or (own if own.exists() else bundle / CALIBRATION)
    encode: Callable[..., bytes] = ENCODERS.get(form) or next(each.encode for each in formats() if each.name == form)
    if "{camera}" not in form:
        return encode(*_whole_scan(folder, bundle, calibration))
    if camera is None:
        message = f"{form}: expected the name of a camera, found none"
        raise InvalidInputError(message)
    return encode(organised_scan(folder, camera, calibration=calibration))


def _whole_scan(
    folder: Path, bundle: Path, calibration: Path
) -> tuple[Calibration, Iterator[OrganisedCloud], Mapping[str, Pixels], datetime | None]:
    """Arguments of the encoder of a file of all cameras: see `slrig.plugins.FileFormat`."""
    known = read_calibration(calibration)
    cameras = {each: device for each, device in known.cameras.items() if (folder / causes_picture(each)).exists()}
    if not cameras:
        message = f"{folder}: no camera has a map of causes; reconstruct the bundle again"
        raise NothingToReconstructError(message)
    mesh = decode_mesh_ply(_read(folder / MESH))
    # One at a time: each takes some hundred megabytes.
    clouds = (_organised(folder, mesh, camera, device) for camera, device in cameras.items())
    return known, clouds, _white_images(open_bundle(bundle)), read_description(bundle).captured_at


def _white_images(bundle: BundleFiles) -> dict[str, Pixels]:
    """The first white frame of each camera that has one, in colour if it was recorded so. Raises BundleError."""
    outline = bundle.outline
    order: dict[str, int] = {}
    for index, shot in enumerate(outline.shots):
        if isinstance(outline.patterns[shot.pattern], White):
            order.setdefault(shot.camera, index)
    shots = bundle.shots(list(order.values()))
    return {shot.camera: shot.image if shot.colour is None else shot.colour for shot in shots}


def organised_scan(folder: Path, camera: str, *, calibration: Path) -> OrganisedCloud:
    """The cloud of a camera, of the files of a finished scan. Raises as `cloud_file`."""
    mesh = decode_mesh_ply(_read(folder / MESH))
    devices = read_calibration(calibration).cameras
    if camera not in devices:
        message = f"{calibration}: it knows cameras {sorted(devices)}, and not '{camera}'"
        raise InvalidInputError(message)
    return _organised(folder, mesh, camera, devices[camera])


def _organised(folder: Path, mesh: Mesh, camera: str, device: Pinhole) -> OrganisedCloud:
    return organised(mesh, camera, device, _refused(folder / causes_picture(camera), device), _causes(folder / REPORT))


def _read(path: Path) -> bytes:
    with storage_errors(path):
        return path.read_bytes()


def _refused(path: Path, device: Pinhole) -> NDArray[np.uint8]:
    found = cv2.imdecode(np.frombuffer(_read(path), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.shape != device.size.shape or found.dtype != np.uint8:
        what = "none that can be read" if found is None else f"{found.shape} {found.dtype}"
        message = (
            f"{path.name}: expected a grey picture of {device.size} as the calibration's camera has, found {what}; "
            "reconstruct the bundle again"
        )
        raise InvalidInputError(message)
    return np.asarray(found, dtype=np.uint8)


def _causes(path: Path) -> list[str]:
    try:
        return [str(cause["name"]) for cause in stored_json(_read(path))["causes"]]
    except (ValueError, KeyError, TypeError) as cause:
        message = f"{path.name}: it does not name the causes of refused pixels; reconstruct the bundle again"
        raise InvalidInputError(message) from cause

"""The files that are made of a finished scan by mathematics, on request: its surface in the grid of its cameras.

The service has them made by the worker: they take kernels, and libraries of other people.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import CALIBRATION, BundleFiles, open_bundle, read_calibration, read_description
from slrig.disk import storage_errors
from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.jobs.data_folder import BUNDLE
from slrig.model import Calibration, Mesh, Pinhole, Pixels, White
from slrig.plugins import formats
from slrig.scan.artefacts import MESH, REPORT, decode_mesh_ply
from slrig.scan.cloud_formats import encode_depth_tiff, encode_npz, encode_pcd
from slrig.scan.offered import causes_picture
from slrig.scan.organised import OrganisedCloud, organised
from slrig.scan.plan import ProgressCallback

STAGE = "organise points"


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
    progress: ProgressCallback = lambda *_: None,
) -> bytes:
    """Make a file of a finished scan. form : of `slrig.scan.offered.requested_forms`. camera : None for a file of all.
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
    progress(STAGE, 0.0, "")
    bundle = bundle or folder / BUNDLE
    calibration = calibration or bundle / CALIBRATION
    encode: Callable[..., bytes] = ENCODERS.get(form) or next(each.load() for each in formats() if each.name == form)
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
        return [str(cause["name"]) for cause in json.loads(_read(path))["causes"]]
    except (ValueError, KeyError, TypeError) as cause:
        message = f"{path.name}: it does not name the causes of refused pixels; reconstruct the bundle again"
        raise InvalidInputError(message) from cause

"""A scan bundle, read: the description checked first, then the frames, several files at a time."""

from __future__ import annotations

import os
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from slrig.bundle.calibration_file import check_calibration, read_calibration
from slrig.bundle.description import Description, read_description
from slrig.bundle.images import read_pages
from slrig.errors import BundleError
from slrig.model import Calibration, Capture, Pixels, Shot

CALIBRATION = "calibration.json"
MOST_READERS = 4  # threads, for files that are decoded at the same time


@dataclass(frozen=True, slots=True)
class Bundle:
    """A scan bundle in memory. `calibration` is None where the folder has none: it is needed only to triangulate."""

    capture: Capture
    calibration: Calibration | None
    folder: Path


def read_bundle(folder: Path, *, calibration_file: Path | None = None) -> Bundle:
    """Return the bundle in `folder`; `calibration_file` takes the place of the calibration.json beside the frames.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key;
    CalibrationError: the calibration is malformed, not finite, or made for devices of another size.
    """
    description = read_description(folder)
    path = calibration_file
    if path is None and (folder / CALIBRATION).exists():
        path = folder / CALIBRATION
    calibration = None if path is None else read_calibration(path)
    if calibration is not None:
        sizes = {name: camera.size for name, camera in description.camera_formats().items()}
        check_calibration(calibration, description.projector_size(), sizes, str(path))
    return Bundle(_capture(folder, description), calibration, folder)


def read_capture(folder: Path) -> Capture:
    """Return the frames of the bundle in `folder`, whatever its calibration: what a calibration is solved from.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key.
    """
    return _capture(folder, read_description(folder))


def _capture(folder: Path, description: Description) -> Capture:
    cameras = description.camera_formats()
    pages: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for frame in description.frames:
        pages[frame.camera, frame.file].append(frame.page)
    paths = {file: _inside(folder, file) for _, file in pages}

    def read(key: tuple[str, str]) -> dict[int, Pixels]:
        camera, file = key
        return read_pages(paths[file], pages[key], cameras[camera])

    # OpenCV and zlib let other threads run while they decode. `map` keeps the order, so the first fault in the order
    # of bundle.json is the one reported, however the threads were scheduled.
    with ThreadPoolExecutor(min(MOST_READERS, os.cpu_count() or 1)) as pool:
        images = dict(zip(pages, pool.map(read, pages), strict=True))
    shots = tuple(
        Shot(frame.pattern, frame.camera, images[frame.camera, frame.file][frame.page], frame.exposure_s, frame.time_s)
        for frame in description.frames
    )
    return Capture(description.projector_size(), description.pattern_list(), cameras, shots)


def _inside(folder: Path, file: str) -> Path:
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise BundleError(
            f"{path}: expected a file inside the bundle, found a link that leads out; copy the frame into the bundle"
        )
    return path

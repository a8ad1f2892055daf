"""A scan bundle, read: the description checked first, then the frames, several files at a time."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

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


@dataclass(frozen=True, slots=True)
class BundleFiles:
    """A scan bundle whose frames are read when they are asked for.

    outline : all of the capture but its pixels, which are black there and take no memory.
    """

    outline: Capture
    calibration: Calibration | None
    folder: Path
    _description: Description

    def shots(self, order: Sequence[int]) -> Iterator[Shot]:
        """The frames of these indices of the outline, while a few that follow are read on other threads. Raises
        BundleError: a frame is missing, cut, or of another size or depth; the first such in this order is told.
        """
        frames = [self._description.frames[index] for index in order]
        pages: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
        for frame in frames:
            pages[frame.camera, frame.file].append(frame.page)
        paths = {file: _inside(self.folder, file) for _, file in pages}

        def read(key: tuple[str, str]) -> dict[int, Pixels]:
            camera, file = key
            return read_pages(paths[file], pages[key], self.outline.cameras[camera])

        readers = min(MOST_READERS, os.cpu_count() or 1)
        keys, under_way = iter(pages), dict[tuple[str, str], Future[dict[int, Pixels]]]()
        left = {key: len(each) for key, each in pages.items()}
        # OpenCV and zlib let other threads run while they decode.
        with ThreadPoolExecutor(readers) as pool:
            for index, frame in zip(order, frames, strict=True):
                key = frame.camera, frame.file
                while key not in under_way or len(under_way) <= readers:
                    following = next(keys, None)
                    if following is None:
                        break
                    under_way[following] = pool.submit(read, following)
                image = under_way[key].result()[frame.page]
                left[key] -= 1
                if left[key] == 0:
                    del under_way[key]
                yield replace(self.outline.shots[index], image=image)


def read_bundle(folder: Path, *, calibration_file: Path | None = None) -> Bundle:
    """Return the bundle in `folder`; `calibration_file` takes the place of the calibration.json beside the frames.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key;
    CalibrationError: the calibration is malformed, not finite, or made for devices of another size.
    """
    files = open_bundle(folder, calibration_file=calibration_file)
    return Bundle(_whole(files), files.calibration, folder)


def open_bundle(folder: Path, *, calibration_file: Path | None = None) -> BundleFiles:
    """As `read_bundle`, for frames that are read later."""
    description = read_description(folder)
    path = calibration_file
    if path is None and (folder / CALIBRATION).exists():
        path = folder / CALIBRATION
    calibration = None if path is None else read_calibration(path)
    if calibration is not None:
        sizes = {name: camera.size for name, camera in description.camera_formats().items()}
        check_calibration(calibration, description.projector_size(), sizes, str(path))
    return BundleFiles(_outline(description), calibration, folder, description)


def read_capture(folder: Path) -> Capture:
    """Return the frames of the bundle in `folder`, whatever its calibration: what a calibration is solved from.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key.
    """
    description = read_description(folder)
    return _whole(BundleFiles(_outline(description), None, folder, description))


def _outline(description: Description) -> Capture:
    cameras = description.camera_formats()
    black = {name: np.broadcast_to(np.zeros(1, np.uint8), camera.size.shape) for name, camera in cameras.items()}
    shots = tuple(
        Shot(frame.pattern, frame.camera, black[frame.camera], frame.exposure_s, frame.time_s)
        for frame in description.frames
    )
    return Capture(description.projector_size(), description.pattern_list(), cameras, shots)


def _whole(files: BundleFiles) -> Capture:
    return replace(files.outline, shots=tuple(files.shots(range(len(files.outline.shots)))))


def _inside(folder: Path, file: str) -> Path:
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise BundleError(
            f"{path}: expected a file inside the bundle, found a link that leads out; copy the frame into the bundle"
        )
    return path

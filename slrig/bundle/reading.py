"""Reading a scan bundle: the description first, then the frames, several files at a time."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slrig.bundle.calibration import check_calibration, read_calibration
from slrig.bundle.description import Description, FrameEntry, read_description
from slrig.bundle.images import read_colour, read_with_colour
from slrig.errors import BundleError
from slrig.model import Black, Calibration, Capture, Pixels, Shot, White

CALIBRATION = "calibration.json"
MAX_READERS = 4  # threads, for files that are decoded at the same time

_Pages = tuple[dict[int, Pixels], dict[int | str, Pixels]]
"""Grey by page; colour by page, or by the name of a file of its own."""


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

    def shots(self, order: Sequence[int], *, colour: bool = True) -> Iterator[Shot]:
        """The frames of these indices of the outline, while a few that follow are read on other threads; white and
        black in colour, too, where there is any and `colour` asks for it. Raises BundleError: a frame is missing, cut,
        or of another size or depth; the first such in this order is told.
        """
        frames = [self._description.frames[index] for index in order]
        files: defaultdict[tuple[str, str], list[FrameEntry]] = defaultdict(list)
        for frame in frames:
            files[frame.camera, frame.file].append(frame)
        paths = {file: _path_inside(self.folder, file) for _, file in files}
        paths |= {each: _path_inside(self.folder, each) for frame in frames if (each := frame.colour_file) is not None}

        def read(key: tuple[str, str]) -> _Pages:
            form, entries = self.outline.cameras[key[0]], files[key]
            ends = [each for each in entries if colour and self._is_end(each)]
            pages, own = [each.page for each in entries], [each.page for each in ends if each.colour_file is None]
            grey, found = read_with_colour(paths[key[1]], pages, form, coloured=own)
            colours: dict[int | str, Pixels] = {page: found[page] for page in found}
            colours.update((file, read_colour(paths[file], form)) for each in ends if (file := each.colour_file))
            return grey, colours

        readers = min(MAX_READERS, os.cpu_count() or 1)
        keys, under_way = iter(files), dict[tuple[str, str], Future[_Pages]]()
        left = {key: len(each) for key, each in files.items()}
        # OpenCV and zlib let other threads run while they decode.
        with ThreadPoolExecutor(readers) as pool:
            for index, frame in zip(order, frames, strict=True):
                key = frame.camera, frame.file
                while key not in under_way or len(under_way) <= readers:
                    following = next(keys, None)
                    if following is None:
                        break
                    under_way[following] = pool.submit(read, following)
                images, colours = under_way[key].result()
                left[key] -= 1
                if left[key] == 0:
                    del under_way[key]
                seen = colours.get(frame.colour_file or frame.page) if self._is_end(frame) else None
                yield replace(self.outline.shots[index], image=images[frame.page], colour=seen)

    def _is_end(self, frame: FrameEntry) -> bool:
        return isinstance(self.outline.patterns[frame.pattern], White | Black)


def read_bundle(folder: Path, *, calibration_file: Path | None = None) -> Bundle:
    """Return the bundle in `folder`; `calibration_file` takes the place of the calibration.json beside the frames.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key;
    CalibrationError: the calibration is malformed, not finite, or made for devices of another size.
    """
    files = open_bundle(folder, calibration_file=calibration_file)
    return Bundle(_read_all(files, colour=True), files.calibration, folder)


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
    return _read_all(BundleFiles(_outline(description), None, folder, description), colour=False)


def _outline(description: Description) -> Capture:
    cameras = description.camera_formats()
    black = {name: np.broadcast_to(np.zeros(1, np.uint8), camera.size.shape) for name, camera in cameras.items()}
    shots = tuple(
        Shot(frame.pattern, frame.camera, black[frame.camera], frame.exposure_s, frame.time_s)
        for frame in description.frames
    )
    return Capture(description.projector_size(), description.pattern_list(), cameras, shots)


def _read_all(files: BundleFiles, *, colour: bool) -> Capture:
    return replace(files.outline, shots=tuple(files.shots(range(len(files.outline.shots)), colour=colour)))


def _path_inside(folder: Path, file: str) -> Path:
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise BundleError(
            f"{path}: expected a file inside the bundle, found a link that leads out; copy the frame into the bundle"
        )
    return path

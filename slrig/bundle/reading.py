"""Reading of a scan bundle: the description first, then the frames, several files at a time."""

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
from slrig.model import Black, Calibration, Capture, Pixels, Shot, White, require_millimetres

CALIBRATION = "calibration.json"
MAX_READERS = 4  # threads that decode files at the same time

_Pages = tuple[dict[int, Pixels], dict[int | str, Pixels]]
"""Grey by page; colour by page, or by the name of a separate file."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """A scan bundle in memory. calibration : None if the folder has none; needed only to triangulate."""

    capture: Capture
    calibration: Calibration | None
    folder: Path


@dataclass(frozen=True, slots=True)
class BundleFiles:
    """A scan bundle whose frames are read on request.

    outline : the capture without its pixels, which are black and take no memory.
    """

    outline: Capture
    calibration: Calibration | None
    folder: Path
    _description: Description

    @property
    def focal_px(self) -> dict[str, float]:
        """Focal lengths that imported pictures of cameras state."""
        return {name: each.focal_px for name, each in self._description.cameras.items() if each.focal_px is not None}

    def shots(self, order: Sequence[int], *, colour: bool = True) -> Iterator[Shot]:
        """Yield the frames with these indices of the outline, and read the next few on other threads.

        White and black come in colour too, if the bundle has it and `colour` is True. Raises BundleError: a frame is
        missing, cut, or of another size or depth; the first one in this order is reported.
        """
        frames = [self._description.frames[index] for index in order]
        files: defaultdict[tuple[str, str], list[FrameEntry]] = defaultdict(list)
        for frame in frames:
            files[frame.camera, frame.file].append(frame)
        paths = {file: _path_inside(self.folder, file) for _, file in files}
        paths |= {each: _path_inside(self.folder, each) for frame in frames if (each := frame.colour_file) is not None}

        def read(key: tuple[str, str]) -> _Pages:
            form, entries = self.outline.cameras[key[0]], files[key]
            references = [each for each in entries if colour and self._is_reference(each)]
            pages = [each.page for each in entries]
            embedded = [each.page for each in references if each.colour_file is None]
            grey, found = read_with_colour(paths[key[1]], pages, form, colour_pages=embedded)
            colours: dict[int | str, Pixels] = {page: found[page] for page in found}
            colours.update((file, read_colour(paths[file], form)) for each in references if (file := each.colour_file))
            return grey, colours

        readers = min(MAX_READERS, os.cpu_count() or 1)
        keys, running = iter(files), dict[tuple[str, str], Future[_Pages]]()
        remaining = {key: len(each) for key, each in files.items()}
        # OpenCV and zlib let other threads run while they decode.
        with ThreadPoolExecutor(readers) as pool:
            for index, frame in zip(order, frames, strict=True):
                key = frame.camera, frame.file
                while key not in running or len(running) <= readers:
                    following = next(keys, None)
                    if following is None:
                        break
                    running[following] = pool.submit(read, following)
                images, colours = running[key].result()
                remaining[key] -= 1
                if remaining[key] == 0:
                    del running[key]
                shot_colour = colours.get(frame.colour_file or frame.page) if self._is_reference(frame) else None
                yield replace(self.outline.shots[index], image=images[frame.page], colour=shot_colour)

    def _is_reference(self, frame: FrameEntry) -> bool:
        return isinstance(self.outline.patterns[frame.pattern], White | Black)


def read_bundle(folder: Path, *, calibration_file: Path | None = None) -> Bundle:
    """Return the bundle in `folder`; `calibration_file` replaces its calibration.json.
    Raises BundleError: bundle.json or a frame is missing, cut, of another size or depth, or has an unknown key;
    CalibrationError: the calibration is malformed, not finite, or made for devices of another size.
    """
    files = open_bundle(folder, calibration_file=calibration_file)
    return Bundle(_read_all(files, colour=True), files.calibration, folder)


def open_bundle(folder: Path, *, calibration_file: Path | None = None) -> BundleFiles:
    """Open the bundle as `read_bundle` does, but read its frames later."""
    description = read_description(folder)
    path = calibration_file
    if path is None and (folder / CALIBRATION).exists():
        path = folder / CALIBRATION
    calibration = None if path is None else read_calibration(path)
    if calibration is not None:
        sizes = {name: camera.size for name, camera in description.camera_formats().items()}
        check_calibration(calibration, description.projector_size(), sizes, str(path))
        require_millimetres(calibration, str(path))
    return BundleFiles(_outline(description), calibration, folder, description)


def read_capture(folder: Path) -> Capture:
    """Return the frames of the bundle in `folder`, without its calibration, for solving one.
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

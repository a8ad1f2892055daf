"""A scan bundle, written: each frame as it comes, the whole folder renamed into place once, or nothing left."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2

from slrig.bundle.calibration_file import write_calibration
from slrig.bundle.description import CAMERA_NAME, DESCRIPTION
from slrig.bundle.reading import CALIBRATION
from slrig.bundle.storage import refusals_of, staging_name, sync_folder, write_durably
from slrig.errors import BundleError
from slrig.model import Calibration, CameraFormat, Capture, Pattern, Pixels, Shot, Size


class BundleWriter:
    """Writes a scan bundle while the frames arrive. A context manager.

    The bundle grows in a hidden folder beside `folder`, which is renamed into place when the block ends well. Any
    error, in the block or on the disk, removes it: the folder is whole or absent.

    Raises
    ------
    BundleError
        `folder` exists already, a camera's name cannot be a file's name, or no frame was added.
    StorageError
        The disk refused.
    """

    def __init__(
        self,
        folder: Path,
        projector_size: Size,
        patterns: Sequence[Pattern],
        cameras: Mapping[str, CameraFormat],
        calibration: Calibration | None = None,
    ) -> None:
        wrong = [name for name in cameras if not re.fullmatch(CAMERA_NAME, name)]
        if wrong:
            message = (
                f"{folder}: expected camera names of letters, digits, '_' and '-', "
                f"found {', '.join(map(repr, wrong))}; "
                "rename the camera: its name becomes the name of a folder"
            )
            raise BundleError(message)
        self.folder = folder
        self._staging = staging_name(folder)
        self._projector = projector_size
        self._patterns = tuple(patterns)
        self._cameras = dict(cameras)
        self._calibration = calibration
        self._frames: list[dict[str, Any]] = []
        self._count: Counter[str] = Counter()

    def __enter__(self) -> Self:
        if self.folder.exists():
            message = (
                f"{self.folder}: expected a new folder, found one that exists; "
                "a bundle is never overwritten: remove it or choose another name"
            )
            raise BundleError(message)
        with refusals_of(self.folder):
            try:
                for name in self._cameras:
                    (self._staging / "frames" / name).mkdir(parents=True)
            except OSError:
                self._discard()
                raise
        return self

    def add(self, shot: Shot) -> None:
        """Write one frame to disk now.

        Raises
        ------
        BundleError
            The frame names an unknown pattern or camera, or is not as that camera's frames are.
        StorageError
            The disk refused.
        """
        self._check(shot)
        file = f"frames/{shot.camera}/{self._count[shot.camera]:03d}.png"
        with refusals_of(self._staging / file):
            write_durably(self._staging / file, _png(shot.image, file))
        self._count[shot.camera] += 1
        frame: dict[str, Any] = {"pattern": shot.pattern, "camera": shot.camera, "file": file}
        if shot.exposure_s is not None:
            frame["exposure_s"] = float(shot.exposure_s)
        if shot.time_s is not None:
            frame["time_s"] = float(shot.time_s)
        self._frames.append(frame)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._commit()
        finally:
            self._discard()

    def _commit(self) -> None:
        if not self._frames:
            message = f"{self.folder}: expected frames, found none; a bundle holds at least one frame"
            raise BundleError(message)
        data = {
            "format": "slrig-bundle",
            "version": 1,
            "projector": {"size_px": _extent(self._projector)},
            "cameras": {
                name: {"size_px": _extent(camera.size), "bit_depth": camera.bit_depth}
                for name, camera in self._cameras.items()
            },
            "patterns": [_pattern(pattern) for pattern in self._patterns],
            "frames": self._frames,
        }
        if self._calibration is not None:
            write_calibration(self._staging / CALIBRATION, self._calibration)
        with refusals_of(self.folder):
            text = json.dumps(data, indent=1, allow_nan=False) + "\n"
            write_durably(self._staging / DESCRIPTION, text.encode())
            for name in self._cameras:
                sync_folder(self._staging / "frames" / name)
            sync_folder(self._staging / "frames")
            sync_folder(self._staging)
            self._staging.rename(self.folder)
            sync_folder(self.folder.parent)

    def _discard(self) -> None:
        shutil.rmtree(self._staging, ignore_errors=True)

    def _check(self, shot: Shot) -> None:
        camera = self._cameras.get(shot.camera)
        if camera is None or not 0 <= shot.pattern < len(self._patterns):
            message = (
                f"{self.folder}: expected a frame of {', '.join(self._cameras)} and pattern 0 to "
                f"{len(self._patterns) - 1}, found camera '{shot.camera}' and pattern {shot.pattern}"
            )
            raise BundleError(message)
        if (
            not math.isfinite(shot.time_s or 0)
            or not 0 < (1 if shot.exposure_s is None else shot.exposure_s) < math.inf
        ):
            message = (
                f"{self.folder}: expected a finite time and a positive exposure, found time {shot.time_s} s and "
                f"exposure {shot.exposure_s} s; leave unknown ones out"
            )
            raise BundleError(message)
        wanted = "uint8" if camera.bit_depth <= 8 else "uint16"
        brightest = int(shot.image.max(initial=0))
        if shot.image.shape != camera.size.shape or shot.image.dtype != wanted or brightest > camera.full_scale:
            rows, columns = shot.image.shape
            message = (
                f"{self.folder}: expected {camera.size} {wanted} samples up to {camera.full_scale} from camera "
                f"'{shot.camera}', found {columns} x {rows} {shot.image.dtype} up to {brightest}; "
                "describe the camera's format as it delivers frames"
            )
            raise BundleError(message)


def write_bundle(folder: Path, capture: Capture, calibration: Calibration | None = None) -> None:
    """Write a capture as a bundle, whole or not at all. Raises as `BundleWriter` does."""
    with BundleWriter(folder, capture.projector, capture.patterns, capture.cameras, calibration) as writer:
        for shot in capture.shots:
            writer.add(shot)


def _png(image: Pixels, file: str) -> bytes:
    # imencode, and not imwrite: on a full disk imwrite returns False and leaves a cut file.
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        message = f"{file}: expected an image that PNG can hold, found {image.shape} {image.dtype}"
        raise BundleError(message)
    return bytes(data)


def _extent(size: Size) -> list[int]:
    return [size.width_px, size.height_px]


def _pattern(pattern: Pattern) -> dict[str, Any]:
    values = asdict(pattern)
    return {"kind": values.pop("kind"), **values}

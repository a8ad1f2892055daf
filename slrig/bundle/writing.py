"""Writing of a scan bundle: each frame when it arrives; the whole folder appears at once, or not at all."""

from __future__ import annotations

import math
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from slrig.bundle.calibration import write_calibration
from slrig.bundle.description import CAMERA_NAME, DESCRIPTION, PROJECTOR
from slrig.bundle.images import encode_frame
from slrig.bundle.reading import CALIBRATION
from slrig.bundle.sidecars import REFUSED_FOLDER, REFUSED_LIST, RefusedEntry, RefusedFrame, RefusedList
from slrig.bundle.storage import json_bytes, sync_folder, write_durably
from slrig.disk import staging_name, storage_errors
from slrig.errors import BundleError, CalibrationError, StorageError
from slrig.model import Calibration, CameraFormat, Capture, Pattern, Shot, Size


@dataclass(slots=True)
class _FrameSlot:
    """Entry of a frame in the list; `vacant` from its refusal until another frame replaces it."""

    frame: dict[str, Any]
    vacant: bool = False


class BundleWriter:
    """Writes a scan bundle while the frames arrive. A context manager.

    The bundle grows in a hidden folder next to `folder`, which is renamed when the block ends without an error. Any
    error, in the block or on the disk, removes it: the folder is complete or absent. Only `keep` leaves the bundle of
    an aborted capture, with a statement of that. captured_at : start of the capture, with the offset from UTC.
    focal_px : focal lengths that the pictures of cameras state.
    Raises BundleError: `folder` exists already, a camera's name cannot be a file's name, or no frame was added;
    StorageError: the disk refused.
    """

    def __init__(
        self,
        folder: Path,
        projector_size: Size,
        patterns: Sequence[Pattern],
        cameras: Mapping[str, CameraFormat],
        calibration: Calibration | None = None,
        *,
        captured_at: datetime | None = None,
        focal_px: Mapping[str, float] | None = None,
    ) -> None:
        wrong = [name for name in cameras if not re.fullmatch(CAMERA_NAME, name) or name == PROJECTOR]
        if wrong:
            raise BundleError(
                f"{folder}: expected camera names of letters, digits, '_' and '-', none of them '{PROJECTOR}', "
                f"found {', '.join(map(repr, wrong))}; "
                "rename the camera: its name becomes the name of a folder"
            )
        self.folder = folder
        self._staging = staging_name(folder)
        self._projector = projector_size
        self._patterns = tuple(patterns)
        self._cameras = dict(cameras)
        self._lost: set[str] = set()
        self._calibration = calibration
        self._captured_at = captured_at
        self._focal_px = dict(focal_px or {})
        self._slots: list[_FrameSlot] = []
        self._refused: list[RefusedEntry] = []
        self._count: Counter[str] = Counter()
        self._ended: str | None = None

    def __enter__(self) -> Self:
        if self.folder.exists():
            raise BundleError(
                f"{self.folder}: expected a new folder, found one that exists; "
                "a bundle is never overwritten: remove it or choose another name"
            )
        with storage_errors(self.folder):
            try:
                for name in self._cameras:
                    (self._staging / "frames" / name).mkdir(parents=True)
            except OSError:
                self._discard()
                raise
        return self

    def add(self, shot: Shot) -> None:
        """Write one frame to disk. A frame that replaces a refused one takes its entry in the list.
        Raises BundleError: the frame names an unknown pattern or camera, or does not have the format of that camera;
        StorageError: the disk refused.
        """
        self._check(shot)
        file = f"frames/{shot.camera}/{self._count[shot.camera]:03d}.png"
        with storage_errors(self._staging / file):
            write_durably(self._staging / file, encode_frame(shot.image, file))
        self._count[shot.camera] += 1
        frame: dict[str, Any] = {"pattern": shot.pattern, "camera": shot.camera, "file": file, **_times(shot)}
        if shot.colour is not None:
            frame["colour_file"] = file.replace(".png", "-colour.png")
            with storage_errors(self._staging / frame["colour_file"]):
                write_durably(self._staging / frame["colour_file"], encode_frame(shot.colour, frame["colour_file"]))
        slot = self._latest_slot(shot.pattern, shot.camera, vacant=True)
        if slot is None:
            self._slots.append(_FrameSlot(frame))
        else:
            slot.frame, slot.vacant = frame, False

    def refuse(self, refused: RefusedFrame) -> None:
        """Store a refused frame separately: the one given, or the one that was added before, withdrawn.
        Raises StorageError: the disk refused.
        """
        file = f"{REFUSED_FOLDER}/{len(self._refused):03d}.png"
        entry: dict[str, Any] = {"pattern": refused.pattern, "camera": refused.camera, "attempt": refused.attempt}
        with storage_errors(self._staging / REFUSED_FOLDER):
            (self._staging / REFUSED_FOLDER).mkdir(exist_ok=True)
            slot = self._latest_slot(refused.pattern, refused.camera, vacant=not refused.delivered)
            if refused.shot is not None:
                write_durably(self._staging / file, encode_frame(refused.shot.image, file))
                entry |= {"file": file, **_times(refused.shot)}
            elif refused.delivered and slot is not None:
                (self._staging / slot.frame["file"]).rename(self._staging / file)
                if "colour_file" in slot.frame:
                    # The grey frame is enough to find the fault.
                    (self._staging / slot.frame.pop("colour_file")).unlink()
                entry |= {**slot.frame, "file": file}
        if slot is None:
            # Frames stay in the order of their patterns, however often one is repeated.
            slot = _FrameSlot({"pattern": refused.pattern, "camera": refused.camera})
            self._slots.append(slot)
        slot.vacant = True
        entry |= {"cause": refused.cause, "left_out": refused.left_out or None}
        self._refused.append(RefusedEntry.model_validate(entry))

    def lose(self, camera: str) -> None:
        """Leave a camera out of the bundle, of which no frame counts."""
        self._lost.add(camera)

    def keep(self, ended: str) -> None:
        """Keep the written frames although the block will end with an error; `ended` is its message."""
        self._ended = ended

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._commit()
            elif self._ended is not None and (self._slots or self._refused):
                # The error that ended the capture matters, not those of keeping its frames.
                with suppress(BundleError, CalibrationError, StorageError):
                    self._commit()
        finally:
            self._discard()

    def _commit(self) -> None:
        frames = [slot.frame for slot in self._slots if not slot.vacant]
        if not frames and self._ended is None:
            raise BundleError(f"{self.folder}: expected frames, found none; a bundle holds at least one frame")
        data: dict[str, Any] = {
            "format": "slrig-bundle",
            "version": 1,
            "projector": {"size_px": _extent(self._projector)},
            "cameras": {
                name: {"size_px": _extent(camera.size), "bit_depth": camera.bit_depth}
                | ({"focal_px": self._focal_px[name]} if name in self._focal_px else {})
                for name, camera in self._cameras.items()
                if name not in self._lost
            },
            "patterns": [_pattern_document(pattern) for pattern in self._patterns],
            "frames": frames,
        }
        if self._captured_at is not None:
            data["captured_at"] = self._captured_at.isoformat(timespec="seconds")
        if self._calibration is not None:
            write_calibration(self._staging / CALIBRATION, self._calibration)
        with storage_errors(self.folder):
            if frames:
                # A bundle needs a frame; without one only the refused frames are kept.
                write_durably(self._staging / DESCRIPTION, json_bytes(data))
            self._write_refused()
            for name in self._cameras:
                sync_folder(self._staging / "frames" / name)
            sync_folder(self._staging / "frames")
            sync_folder(self._staging)
            self._staging.rename(self.folder)
            sync_folder(self.folder.parent)

    def _latest_slot(self, pattern: int, camera: str, *, vacant: bool) -> _FrameSlot | None:
        """Return the last slot of one pattern and camera that is vacant, or that is not."""
        for slot in reversed(self._slots):
            if (slot.frame["pattern"], slot.frame["camera"], slot.vacant) == (pattern, camera, vacant):
                return slot
        return None

    def _write_refused(self) -> None:
        if self._refused or self._ended is not None:
            folder = self._staging / REFUSED_FOLDER
            folder.mkdir(exist_ok=True)
            listed = RefusedList(ended=self._ended, frames=self._refused)
            write_durably(folder / REFUSED_LIST, json_bytes(listed.model_dump(exclude_none=True)))
            sync_folder(folder)

    def _discard(self) -> None:
        shutil.rmtree(self._staging, ignore_errors=True)

    def _check(self, shot: Shot) -> None:
        camera = self._cameras.get(shot.camera)
        if camera is None or not 0 <= shot.pattern < len(self._patterns):
            raise BundleError(
                f"{self.folder}: expected a frame of {', '.join(self._cameras)} and pattern 0 to "
                f"{len(self._patterns) - 1}, found camera '{shot.camera}' and pattern {shot.pattern}"
            )
        if (
            not math.isfinite(shot.time_s or 0)
            or not 0 < (1 if shot.exposure_s is None else shot.exposure_s) < math.inf
        ):
            raise BundleError(
                f"{self.folder}: expected a finite time and a positive exposure, found time {shot.time_s} s and "
                f"exposure {shot.exposure_s} s; leave unknown ones out"
            )
        dtype = "uint8" if camera.bit_depth <= 8 else "uint16"
        brightest = int(shot.image.max(initial=0))
        if shot.colour is not None:
            brightest = max(brightest, int(shot.colour.max(initial=0)))
        fits = shot.image.dtype == dtype and (shot.colour is None or shot.colour.dtype == dtype)
        if shot.image.shape != camera.size.shape or not fits or brightest > camera.full_scale:
            rows, columns = shot.image.shape
            raise BundleError(
                f"{self.folder}: expected {camera.size} {dtype} samples up to {camera.full_scale} from camera "
                f"'{shot.camera}', found {columns} x {rows} {shot.image.dtype} up to {brightest}; "
                "describe the camera's format as it delivers frames"
            )


def write_bundle(folder: Path, capture: Capture, calibration: Calibration | None = None) -> None:
    """Write a capture as a bundle, completely or not at all. Raises as `BundleWriter` does."""
    with BundleWriter(folder, capture.projector, capture.patterns, capture.cameras, calibration) as writer:
        for shot in capture.shots:
            writer.add(shot)


def _times(shot: Shot) -> dict[str, float]:
    times = {"exposure_s": shot.exposure_s, "time_s": shot.time_s}
    return {key: float(value) for key, value in times.items() if value is not None}


def _extent(size: Size) -> list[int]:
    return [size.width_px, size.height_px]


def _pattern_document(pattern: Pattern) -> dict[str, Any]:
    values = asdict(pattern)
    return {"kind": values.pop("kind"), **values}

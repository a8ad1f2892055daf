"""Further files of a bundle: truth of a rendered scene, health, notes, refused frames, turntable angle.

`truth.ply` is the surface (binary little endian), `visible_points.npy` its points that the first camera sees lit by the
projector, `truth-CAMERA.npz` the maps of each camera, `truth-calibration.json` the true calibration. Maps and surface
are float32 on disk: at a distance of one metre that is 0.06 micrometres, far below any measurement.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from slrig.bundle.arrays import read_arrays
from slrig.bundle.calibration import read_calibration, write_calibration
from slrig.bundle.description import CameraName
from slrig.bundle.storage import json_bytes, write_file
from slrig.bundle.validation import Strict, read_json, read_json_model, read_text
from slrig.errors import BundleError, CalibrationError
from slrig.model import Calibration, CameraTruth, FloatArray, Shot, Surface, Truth

_MAX_TRUTH_BYTES = 2**30

HEALTH_FILE = "health.json"
HEALTH_MAX_BYTES = 2**20

NOTES_FILE = "notes.json"
NOTES_MAX_BYTES = 2**20

REFUSED_FOLDER = "refused"
REFUSED_LIST = "refused.json"
_REFUSED_MAX_BYTES = 16 * 2**20

TURNTABLE_FILE = "turntable.json"
TURNTABLE_MAX_BYTES = 2**16

SURFACE_FILE = "truth.ply"
VISIBLE_POINTS_FILE = "visible_points.npy"
TRUTH_MAPS_FILE = "truth-{camera}.npz"
TRUE_CALIBRATION_FILE = "truth-calibration.json"
_SURFACE_HEAD = """ply
format binary_little_endian 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {triangles}
property list uchar int vertex_indices
end_header
"""
_SURFACE_PATTERN = re.compile(
    _SURFACE_HEAD.replace("1.0\n", r"1\.0\n(?:comment .*\n)*")
    .replace("{vertices}", r"(?P<vertices>\d{1,10})")
    .replace("{triangles}", r"(?P<triangles>\d{1,10})")
    .encode()
)
_TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_health(folder: Path, stamp: Mapping[str, Any]) -> None:
    """Write a health stamp into a bundle. Raises StorageError."""
    write_file(folder / HEALTH_FILE, json_bytes(stamp))


def read_health(folder: Path) -> dict[str, Any] | None:
    """Return the health stamp of a bundle, None if it has none.
    Raises BundleError: the file cannot be read, or is not a JSON object.
    """
    path = folder / HEALTH_FILE
    if not path.exists():
        return None
    found = read_json(read_text(path, HEALTH_MAX_BYTES, BundleError), path, BundleError)
    if not isinstance(found, dict):
        message = f"{path}: expected a JSON object, found {type(found).__name__}; remove the file, or copy it again"
        raise BundleError(message)
    return found


def write_notes(folder: Path, notes: Sequence[str]) -> None:
    """Write notes, if there are any, into a bundle. Raises StorageError."""
    if notes:
        write_file(folder / NOTES_FILE, json_bytes(list(notes)))


def read_notes(folder: Path) -> tuple[str, ...]:
    """Return the notes of a bundle. Raises BundleError: the file cannot be read, or is not a list of strings."""
    path = folder / NOTES_FILE
    if not path.exists():
        return ()
    found = read_json(read_text(path, NOTES_MAX_BYTES, BundleError), path, BundleError)
    if not isinstance(found, list) or not all(isinstance(each, str) for each in found):
        message = f"{path}: expected a JSON list of strings, found something else; remove the file, or copy it again"
        raise BundleError(message)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class RefusedFrame:
    """One exposure that does not count: its pattern and camera, the attempt at that pattern, and the reason.

    shot : its frame; None if no frame arrived, or if it had been accepted and `delivered` before. left_out : True if
    the whole exposure is useless to the camera, and is not repeated.
    """

    pattern: int
    camera: str
    attempt: int
    cause: str
    shot: Shot | None = None
    delivered: bool = False
    left_out: bool = False


class RefusedEntry(Strict):
    """One entry of the list. `file` is None if no frame arrived; times are those of bundle.json."""

    pattern: Annotated[int, Field(ge=0)]
    camera: CameraName
    attempt: Annotated[int, Field(ge=1)]
    cause: str
    file: str | None = None
    exposure_s: Annotated[float, Field(gt=0)] | None = None
    time_s: float | None = None
    left_out: Literal[True] | None = None


class RefusedList(Strict):
    """The whole of refused.json. ended : the reason why the scan ended before its last pattern, None if it did not."""

    format: Literal["slrig-refused"] = "slrig-refused"
    version: Literal[1] = 1
    ended: str | None = None
    frames: list[RefusedEntry]


def read_refused(folder: Path) -> tuple[RefusedFrame, ...]:
    """Return the frames that were refused during the capture, without their images.
    Raises BundleError: the list exists but is not as slrig wrote it.
    """
    path = folder / REFUSED_FOLDER / REFUSED_LIST
    if not path.is_file():
        return ()
    listed = read_json_model(
        path, RefusedList, "list of refused frames", max_bytes=_REFUSED_MAX_BYTES, error=BundleError
    )
    return tuple(
        RefusedFrame(entry.pattern, entry.camera, entry.attempt, entry.cause, left_out=bool(entry.left_out))
        for entry in listed.frames
    )


TurnedBy = Literal["table", "hand"]
"""The object is turned by the rig's turntable, or by a person."""


class TurntableAngle(Strict):
    """Angle of the turntable. angle_deg : right-handed about its axis, from an arbitrary zero. count : equal for
    angles of a turntable with the same zero; None if that is not known.
    """

    angle_deg: Annotated[float, Field(allow_inf_nan=False)]
    turned_by: TurnedBy
    count: Annotated[str, Field(max_length=80)] | None = None

    def document(self) -> dict[str, object]:
        """Return the angle as in turntable.json and in a scan's report."""
        return self.model_dump(exclude_none=True)


def write_turntable_angle(folder: Path, turntable: TurntableAngle) -> None:
    """Write the turntable angle into a bundle. Raises StorageError."""
    write_file(folder / TURNTABLE_FILE, json_bytes(turntable.document()))


def read_turntable_angle(folder: Path) -> TurntableAngle | None:
    """Return the turntable angle of a bundle, None if it has none. Raises BundleError: the file is invalid."""
    path = folder / TURNTABLE_FILE
    if not path.exists():
        return None
    return read_json_model(
        path, TurntableAngle, "angle of a turntable", max_bytes=TURNTABLE_MAX_BYTES, error=BundleError
    )


@dataclass(frozen=True, slots=True)
class BundleTruth:
    """Truth of a bundle. cameras : empty in bundles of other renderers, which have no maps.

    visible_points_mm : (n, 3) float64, world: surface points seen by the first camera and lit by the projector.
    calibration : the true one; None in bundles of other renderers, whose truth is in the world of the bundle's own.
    """

    surface: Surface
    visible_points_mm: FloatArray
    cameras: Mapping[str, CameraTruth]
    calibration: Calibration | None

    def in_world_of(self, calibration: Calibration) -> tuple[Surface, FloatArray]:
        """Surface and visible points in the world of another calibration of the rig: where its first camera is, the
        true one is. Nothing is fitted, so that every other error of the calibration stays one.
        """
        true_cameras = {} if self.calibration is None else self.calibration.cameras
        name = next((each for each in calibration.cameras if each in true_cameras), None)
        if name is None:
            return self.surface, self.visible_points_mm
        true, found = true_cameras[name], calibration.cameras[name]
        turn = found.rotation.T @ true.rotation
        shift_mm = found.rotation.T @ (true.translation_mm - found.translation_mm)
        vertices_mm, visible_mm = (
            each @ turn.T + shift_mm for each in (self.surface.vertices_mm, self.visible_points_mm)
        )
        return replace(self.surface, vertices_mm=vertices_mm), visible_mm


def write_truth(folder: Path, truth: Truth) -> None:
    """Write the truth into a bundle's folder, each file completely or not at all. Raises StorageError."""
    write_file(folder / SURFACE_FILE, _surface_bytes(truth.surface))
    first = next(iter(truth.cameras.values()))
    data = io.BytesIO()
    np.save(data, first.visible_points_mm, allow_pickle=False)
    write_file(folder / VISIBLE_POINTS_FILE, data.getvalue())
    for name, camera in truth.cameras.items():
        data = io.BytesIO()
        np.savez(
            data,
            depth_mm=camera.depth_mm.astype(np.float32),
            projector_px=camera.projector_px.astype(np.float32),
            visible_points_mm=camera.visible_points_mm,
        )
        write_file(folder / TRUTH_MAPS_FILE.format(camera=name), data.getvalue())
    if truth.calibration is not None:
        write_calibration(folder / TRUE_CALIBRATION_FILE, truth.calibration)


def read_truth(folder: Path) -> BundleTruth | None:
    """Return the truth of a bundle, or None if there is none.
    Raises BundleError: one of its files is missing, cut, or of another shape.
    """
    if not (folder / SURFACE_FILE).exists() and not (folder / VISIBLE_POINTS_FILE).exists():
        return None
    path = folder / SURFACE_FILE
    try:
        surface = _surface(path.read_bytes())
        path = folder / VISIBLE_POINTS_FILE
        visible = _points(read_arrays(path, _MAX_TRUTH_BYTES)[""])
        cameras = {}
        for path in sorted(folder.glob(TRUTH_MAPS_FILE.format(camera="*"))):
            maps = read_arrays(path, _MAX_TRUTH_BYTES)
            cameras[path.stem.removeprefix("truth-")] = CameraTruth(
                np.asarray(maps["depth_mm"], dtype=np.float64),
                np.asarray(maps["projector_px"], dtype=np.float64),
                _points(maps["visible_points_mm"]),
            )
        path = folder / TRUE_CALIBRATION_FILE
        calibration = read_calibration(path) if path.exists() else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, CalibrationError) as cause:
        message = f"{path}: expected truth of the bundle, found: {cause}; render the scene again"
        raise BundleError(message) from cause
    return BundleTruth(surface, visible, cameras, calibration)


def _surface_bytes(surface: Surface) -> bytes:
    """A PLY file with a surface."""
    triangles = np.zeros(len(surface.faces), _TRIANGLE)
    triangles["count"], triangles["corners"] = 3, surface.faces
    head = _SURFACE_HEAD.format(vertices=len(surface.vertices_mm), triangles=len(triangles))
    return head.encode() + surface.vertices_mm.astype("<f4").tobytes() + triangles.tobytes()


def _surface(ply: bytes) -> Surface:
    """The surface in a PLY file as `_surface_bytes` makes it. Raises ValueError."""
    head = _SURFACE_PATTERN.match(ply)
    if head is None:
        message = "another PLY file than slrig writes"
        raise ValueError(message)
    vertex_count, count = int(head["vertices"]), int(head["triangles"])
    vertices = np.frombuffer(ply, "<f4", 3 * vertex_count, head.end()).reshape(-1, 3)
    triangles = np.frombuffer(ply, _TRIANGLE, count, head.end() + vertices.nbytes)
    if (triangles["count"] != 3).any() or (triangles["corners"].astype(np.uint32) >= vertex_count).any():
        message = "faces that are no triangles of its vertices"
        raise ValueError(message)
    return Surface(vertices.astype(np.float64), triangles["corners"].astype(np.int32))


def _points(array: FloatArray) -> FloatArray:
    points = np.asarray(array, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"an array {points.shape} where (n, 3) was expected")
    return points

"""Files beside the frames of a bundle: truth of a rendered scene, health, notes, refused frames, turntable.

`truth.ply` is the surface (binary little endian), `visible_points.npy` the points of it that the first camera sees lit
by the projector, `truth-CAMERA.npz` the maps of each camera. Maps and surface are float32 on disk: at a distance of one
metre that is 0.06 micrometres, far below what is measured.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from slrig.bundle.description import CameraName
from slrig.bundle.storage import json_bytes, write_file
from slrig.bundle.validation import Strict, read_json, read_json_model, read_text
from slrig.errors import BundleError
from slrig.model import CameraTruth, FloatArray, Shot, Surface, Truth

HEALTH_FILE = "health.json"
HEALTH_MAX_BYTES = 2**20


def write_health(folder: Path, stamp: Mapping[str, Any]) -> None:
    """Put a stamp beside the frames. Raises StorageError."""
    write_file(folder / HEALTH_FILE, json_bytes(stamp))


def read_health(folder: Path) -> dict[str, Any] | None:
    """The stamp of a bundle, None where it has none.
    Raises BundleError: the file cannot be read, or is no JSON object.
    """
    path = folder / HEALTH_FILE
    if not path.exists():
        return None
    found = read_json(read_text(path, HEALTH_MAX_BYTES, BundleError), path, BundleError)
    if not isinstance(found, dict):
        message = f"{path}: expected a JSON object, found {type(found).__name__}; remove the file, or copy it again"
        raise BundleError(message)
    return found


NOTES_FILE = "notes.json"
NOTES_MAX_BYTES = 2**20


def write_notes(folder: Path, notes: Sequence[str]) -> None:
    """Put notes beside the frames, if there are any. Raises StorageError."""
    if notes:
        write_file(folder / NOTES_FILE, json_bytes(list(notes)))


def read_notes(folder: Path) -> tuple[str, ...]:
    """The notes of a bundle. Raises BundleError: the file cannot be read, or is no list of sentences."""
    path = folder / NOTES_FILE
    if not path.exists():
        return ()
    found = read_json(read_text(path, NOTES_MAX_BYTES, BundleError), path, BundleError)
    if not isinstance(found, list) or not all(isinstance(each, str) for each in found):
        message = f"{path}: expected a JSON list of strings, found something else; remove the file, or copy it again"
        raise BundleError(message)
    return tuple(found)


REFUSED_FOLDER = "refused"
REFUSED_LIST = "refused.json"
_REFUSED_MAX_BYTES = 16 * 2**20


@dataclass(frozen=True, slots=True)
class RefusedFrame:
    """One exposure that did not count: which pattern and camera, which attempt at that pattern, and why.

    shot : its frame; None where no frame came, and where it had been accepted and `delivered` before. left_out : the
    whole exposure is of no use to the camera, and is not shot again.
    """

    pattern: int
    camera: str
    attempt: int
    cause: str
    shot: Shot | None = None
    delivered: bool = False
    left_out: bool = False


class RefusedEntry(Strict):
    """One line of the list. `file` is None where no frame came; times are those of bundle.json."""

    pattern: Annotated[int, Field(ge=0)]
    camera: CameraName
    attempt: Annotated[int, Field(ge=1)]
    cause: str
    file: str | None = None
    exposure_s: Annotated[float, Field(gt=0)] | None = None
    time_s: float | None = None
    left_out: Literal[True] | None = None


class RefusedList(Strict):
    """The whole of refused.json. `ended` says why the scan ended before its last pattern, None if it did not."""

    format: Literal["slrig-refused"] = "slrig-refused"
    version: Literal[1] = 1
    ended: str | None = None
    frames: list[RefusedEntry]


def read_refused(folder: Path) -> tuple[RefusedFrame, ...]:
    """What was refused while the bundle in `folder` was captured, without the frames themselves; often nothing.
    Raises BundleError: the list is there and is not as slrig wrote it.
    """
    path = folder / REFUSED_FOLDER / REFUSED_LIST
    if not path.is_file():
        return ()
    listed = read_json_model(
        path, RefusedList, "list of refused frames", most_bytes=_REFUSED_MAX_BYTES, error=BundleError
    )
    return tuple(
        RefusedFrame(entry.pattern, entry.camera, entry.attempt, entry.cause, left_out=bool(entry.left_out))
        for entry in listed.frames
    )


TURNTABLE_FILE = "stage.json"
TURNTABLE_MAX_BYTES = 2**16


TurnedBy = Literal["table", "hand"]
"""What turns the object on its stage: the rig's turntable, or a person."""


class StageAngle(Strict):
    """Where the stage stood. angle_deg : right-handed about its axis, from wherever its owner counts. count : equal
    where a turntable's angles have one zero; None where nobody keeps that.
    """

    angle_deg: Annotated[float, Field(allow_inf_nan=False)]
    turned_by: TurnedBy
    count: Annotated[str, Field(max_length=80)] | None = None

    def document(self) -> dict[str, object]:
        """As stage.json and a scan's report have it."""
        return self.model_dump(exclude_none=True)


def write_stage(folder: Path, stage: StageAngle) -> None:
    """Put the angle beside the frames. Raises StorageError."""
    write_file(folder / TURNTABLE_FILE, json_bytes(stage.document()))


def read_stage(folder: Path) -> StageAngle | None:
    """The angle of a bundle, None where it has none. Raises BundleError: the file cannot be read, or is wrong."""
    path = folder / TURNTABLE_FILE
    if not path.exists():
        return None
    return read_json_model(path, StageAngle, "angle of a stage", most_bytes=TURNTABLE_MAX_BYTES, error=BundleError)


SURFACE_FILE = "truth.ply"
VISIBLE_POINTS_FILE = "visible_points.npy"
TRUTH_MAPS_FILE = "truth-{camera}.npz"


@dataclass(frozen=True, slots=True)
class BundleTruth:
    """Truth read from a bundle. Bundles of other renderers have no maps: `cameras` is empty then.

    visible_points_mm : (n, 3) float64, world: surface points seen by the first camera and lit by the projector.
    """

    surface: Surface
    visible_points_mm: FloatArray
    cameras: Mapping[str, CameraTruth]


def write_truth(folder: Path, truth: Truth) -> None:
    """Write the truth into a bundle's folder, each file whole or not at all. Raises StorageError: the disk refused."""
    import trimesh

    mesh = trimesh.Trimesh(truth.surface.vertices_mm, truth.surface.faces, process=False)
    write_file(folder / SURFACE_FILE, mesh.export(file_type="ply", vertex_normal=False))
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


def read_truth(folder: Path) -> BundleTruth | None:
    """Return the truth beside a bundle, or None where there is none.
    Raises BundleError: one of its files is missing, cut, or of another shape.
    """
    if not (folder / SURFACE_FILE).exists() and not (folder / VISIBLE_POINTS_FILE).exists():
        return None
    # A second, for what no live scan has.
    import trimesh

    path = folder / SURFACE_FILE
    try:
        mesh = trimesh.load_mesh(path, process=False)
        surface = Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))
        path = folder / VISIBLE_POINTS_FILE
        visible = _points(np.load(path, allow_pickle=False))
        cameras = {}
        for path in sorted(folder.glob(TRUTH_MAPS_FILE.format(camera="*"))):
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as maps:
                cameras[path.stem.removeprefix("truth-")] = CameraTruth(
                    np.asarray(maps["depth_mm"], dtype=np.float64),
                    np.asarray(maps["projector_px"], dtype=np.float64),
                    _points(maps["visible_points_mm"]),
                )
    except (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as cause:
        message = f"{path}: expected truth beside the bundle, found: {cause}; render the scene again"
        raise BundleError(message) from cause
    return BundleTruth(surface, visible, cameras)


def _points(array: FloatArray) -> FloatArray:
    points = np.asarray(array, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"an array {points.shape} where (n, 3) was expected")
    return points

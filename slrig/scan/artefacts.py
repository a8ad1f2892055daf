"""The files of a scan: mesh and points in the formats that other programs read, the report with its notes, the folder.

Everything is encoded in memory first and written through `write_file`, which leaves a whole file or none. The folder
appears whole or not at all. The same values give the same bytes: no file holds a time stamp, a path or a random name.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import stored_json, sync_folder, sync_tree, write_file
from slrig.disk import staging_name, storage_errors
from slrig.errors import InvalidInputError
from slrig.jobs.records import STAGES_S
from slrig.model import FloatArray, IntArray, Mesh, MeshAxes, PointCurves
from slrig.scan.formats import encode_coarse_glb, encode_mesh_3mf, encode_mesh_obj, encode_mesh_stl, encode_view_glb

MESH = "mesh.ply"
REPORT = "report.json"
REPORT_FORMAT = "slrig-report"
ON_REQUEST: Mapping[str, Callable[[Mesh], bytes]] = {
    "mesh.stl": encode_mesh_stl,
    "mesh.obj": encode_mesh_obj,
    "mesh.3mf": encode_mesh_3mf,
    "view.glb": encode_view_glb,
    "coarse.glb": encode_coarse_glb,
}
"""Files that are made of mesh.ply, and only when somebody wants them."""

_ROBOT_WORDS = "comment axes those of the robot's base: [R t] (x, y, z, 1) of those of the calibration, by rows"
_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}
_END_OF_HEADER = b"\nend_header\n"
_CALIBRATION_PART = "sigma_calibration_mm"
_MARK = "albedo_mark"
_VIEWS = "views"
_FACE = np.dtype([("count", "<u1"), ("vertices", "<i4", (3,))])
_NONE = np.zeros(0)
_NO_MESH = Mesh(
    vertices_mm=np.zeros((0, 3), dtype=np.float32),
    faces=np.zeros((0, 3), dtype=np.int32),
    normals=np.zeros((0, 3), dtype=np.float32),
    colour=np.zeros((0, 3), dtype=np.uint8),
    mark=np.zeros(0, dtype=np.uint8),
    sigma_mm=np.zeros(0, dtype=np.float32),
    stripe=np.zeros(0, dtype=np.int32),
)


def write_converted(folder: Path, name: str) -> None:
    """Write one of `ON_REQUEST` beside the mesh.ply of a finished scan, of which it is made.

    Raises
    ------
    InvalidInputError
        mesh.ply is not as slrig wrote it.
    StorageError
        mesh.ply cannot be read, or the disk refused.
    """
    with storage_errors(folder / MESH):
        data = (folder / MESH).read_bytes()
    write_file(folder / name, converted(data, name))


def converted(ply: bytes, name: str) -> bytes:
    """One of `ON_REQUEST`, made of a mesh.ply, in its axes; GLB in its own. Raises InvalidInputError: mesh.ply is not
    as slrig wrote it.
    """
    mesh, axes = decode_mesh_ply(ply), _axes_of(ply)
    if not name.endswith(".glb"):
        mesh = replace(mesh, vertices_mm=axes.points(mesh.vertices_mm), normals=axes.normals(mesh.normals))
    return ON_REQUEST[name](mesh)


def write_report(report: Mapping[str, object], path: Path) -> None:
    """Write a report, see `encode_report`. Raises StorageError: the disk refused."""
    write_file(path, encode_report(report))


def encode_report(report: Mapping[str, object]) -> bytes:
    """A report as JSON, keys in the order given. Numbers that are not finite become null.

    Raises
    ------
    TypeError
        The report holds something that JSON has no form for; the message says where.
    """
    text = json.dumps(_plain(report, "report"), indent=2, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


class FileAxes(NamedTuple):
    """Axes of a file. words : that state them in a PLY; pose : (4, 4) float64, of the calibration's axes in them."""

    words: str
    pose: FloatArray

    @classmethod
    def of(cls, axes: MeshAxes, rig_in_base: Sequence[Sequence[float]] | None = None) -> FileAxes:
        """The axes of a plan. rig_in_base : (4, 4), mm, which those of a robot need."""
        if axes is MeshAxes.ROBOT:
            pose = np.array(rig_in_base, dtype=np.float64)
            return cls(" ".join([_ROBOT_WORDS, *map(repr, pose[:3].ravel().tolist())]), pose)
        if axes is MeshAxes.RIG:
            return cls("comment axes those of the calibration", np.eye(4))
        words = "comment axes x right, y up, z towards the rig: those of the calibration are (x, -y, -z)"
        return cls(words, np.diag([1.0, -1.0, -1.0, 1.0]))

    @property
    def inverse(self) -> FileAxes:
        """Back from them."""
        return FileAxes("", np.asarray(np.linalg.inv(self.pose)))

    def points(self, points_mm: NDArray[Any]) -> NDArray[Any]:
        """Points (n, 3) of the calibration's axes in those of the file."""
        shift = self.pose[:3, 3]
        if not shift.any():
            return self.normals(points_mm)
        # In doubles: a robot is a metre away.
        return np.asarray((points_mm @ self.pose[:3, :3].T + shift).astype(points_mm.dtype))

    def normals(self, normals: NDArray[Any]) -> NDArray[Any]:
        """Directions (n, 3) of the calibration's axes in those of the file."""
        turn = self.pose[:3, :3]
        if (turn == np.diag(np.diagonal(turn))).all():
            return np.asarray(normals * np.diagonal(turn).astype(normals.dtype))
        return np.asarray((normals @ turn.T).astype(normals.dtype))


UPRIGHT = FileAxes.of(MeshAxes.UPRIGHT)


def encode_mesh_ply(
    mesh: Mesh,
    *,
    sigma_calibration_mm: FloatArray | None = None,
    views: IntArray | None = None,
    axes: FileAxes = UPRIGHT,
) -> bytearray:
    """Binary little-endian PLY in mm: position, normal, colour, `albedo_mark`, `sigma_mm`, `stripe` per vertex;
    triangles.

    Colours are sRGB; `albedo_mark` is a number of `slrig.model.AlbedoMark`.
    sigma_calibration_mm : (V,), the part of `sigma_mm` that the calibration's own error makes, one property more; None
    where the calibration does not state it. views : (V,), of how many views each vertex is the mean, one property more.
    axes : of the file; `mesh` is in those of the calibration.
    """
    properties = {**_vertex_properties(mesh, axes), **_further(sigma_calibration_mm, views)}
    kind = _record(properties)
    header = _ply_header(_mesh_elements(kind, len(mesh.vertices_mm), len(mesh.faces)), axes)
    data, (vertices, faces) = _room(header, (kind, len(mesh.vertices_mm)), (_FACE, len(mesh.faces)))
    _fill(vertices, properties)
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    return data


def decode_mesh_ply(data: bytes | bytearray) -> Mesh:
    """The mesh in a PLY that `encode_mesh_ply` made, in the axes of the calibration, without what that writes of its
    vertices besides.

    Raises
    ------
    InvalidInputError
        The PLY is cut, or of another layout: it was changed, or made by another program or version.
    """
    head, mark, body = data.partition(_END_OF_HEADER)
    counts = [int(count) for count in re.findall(rb"^element \w+ (\d{1,12})$", head, re.MULTILINE)]
    stated, views = (_NONE if f" {name}\n".encode() in head else None for name in (_CALIBRATION_PART, _VIEWS))
    axes = _axes_of(data)
    back = axes.inverse
    kind = _record({**_vertex_properties(_NO_MESH, axes), **_further(stated, views)})
    vertex_count, face_count = counts if len(counts) == 2 else (0, 0)
    vertex_bytes = vertex_count * kind.itemsize
    length = vertex_bytes + face_count * _FACE.itemsize
    elements = _mesh_elements(kind, vertex_count, face_count)
    as_written = head + mark in (_ply_header(elements, axes), _ply_header(elements, None))
    if not as_written or len(body) != length:
        message = (
            f"mesh.ply: expected the header that slrig writes and {length} bytes after it, found "
            f"{f'{len(body)} bytes' if as_written else 'another header'}; reconstruct the bundle again"
        )
        raise InvalidInputError(message)
    vertices = np.frombuffer(body, dtype=kind, count=vertex_count)
    faces = np.frombuffer(body, dtype=_FACE, count=face_count, offset=vertex_bytes)["vertices"]
    if len(faces) and not 0 <= faces.min() <= faces.max() < vertex_count:
        message = "mesh.ply: a triangle names a vertex that is not there; reconstruct the bundle again"
        raise InvalidInputError(message)
    return Mesh(
        vertices_mm=back.points(np.stack([vertices[name] for name in ("x", "y", "z")], axis=1)),
        faces=np.ascontiguousarray(faces),
        normals=back.normals(np.stack([vertices[name] for name in ("nx", "ny", "nz")], axis=1)),
        colour=np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1),
        mark=np.ascontiguousarray(vertices[_MARK]),
        sigma_mm=np.ascontiguousarray(vertices["sigma_mm"]),
        stripe=np.ascontiguousarray(vertices["stripe"]),
    )


def _axes_of(ply: bytes | bytearray) -> FileAxes:
    """Axes that the header of a PLY states; those of the calibration in files of earlier versions."""
    head, _, _ = ply.partition(_END_OF_HEADER)
    lines = head.decode("ascii", "replace").split("\n")
    robot = next((line.removeprefix(_ROBOT_WORDS).split() for line in lines if line.startswith(_ROBOT_WORDS)), None)
    if robot is not None:
        with suppress(ValueError):
            pose = np.vstack([np.array(robot, dtype=np.float64).reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])
            # A damaged header is refused: it is not as it would be written again.
            if np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6):
                return FileAxes.of(MeshAxes.ROBOT, pose.tolist())
    return UPRIGHT if UPRIGHT.words in lines else FileAxes.of(MeshAxes.RIG)


def _vertex_properties(mesh: Mesh, axes: FileAxes) -> dict[str, tuple[str, NDArray[Any]]]:
    return {
        **_columns(("x", "y", "z"), "f4", axes.points(mesh.vertices_mm)),
        **_columns(("nx", "ny", "nz"), "f4", axes.normals(mesh.normals)),
        **_columns(("red", "green", "blue"), "u1", mesh.colour),
        _MARK: ("u1", mesh.mark),
        "sigma_mm": ("f4", mesh.sigma_mm),
        "stripe": ("i4", mesh.stripe),
    }


def _further(
    sigma_calibration_mm: NDArray[Any] | None, views: NDArray[Any] | None = None
) -> dict[str, tuple[str, NDArray[Any]]]:
    """The properties that not every mesh has."""
    part: dict[str, tuple[str, NDArray[Any]]] = {}
    if sigma_calibration_mm is not None:
        part[_CALIBRATION_PART] = "f4", sigma_calibration_mm
    if views is not None:
        part[_VIEWS] = "i4", views
    return part


def _mesh_elements(vertex: np.dtype[np.void], vertex_count: int, face_count: int) -> list[str]:
    faces = [f"element face {face_count}", "property list uchar int vertex_indices"]
    return [*_vertex_element(vertex, vertex_count), *faces]


def encode_points_ply(
    curves: PointCurves,
    normals: NDArray[np.float32],
    *,
    sigma_calibration_mm: FloatArray | None = None,
    axes: FileAxes = UPRIGHT,
) -> bytearray:
    """Binary little-endian PLY in mm: position, normal, colour, `albedo_mark`, `sigma_mm`, `stripe`, `source`,
    `bridge_after` per point.

    normals : (n, 3), unit, of the mesh; NaN for a point that is not in it. `stripe` is the projector column rounded
    down, as in the mesh; `bridge_after` is 1 where the step to the next point of its curve joins two stripes.
    sigma_calibration_mm : (n,), and axes : as for `encode_mesh_ply`.
    """
    columns = np.floor(curves.column_px).astype(np.int32)
    properties = {
        **_columns(("x", "y", "z"), "f4", axes.points(curves.points_mm)),
        **_columns(("nx", "ny", "nz"), "f4", axes.normals(normals)),
        **_columns(("red", "green", "blue"), "u1", curves.colour),
        _MARK: ("u1", curves.mark),
        "sigma_mm": ("f4", curves.sigma_mm),
        "stripe": ("i4", np.repeat(columns, np.diff(curves.offsets))),
        "source": ("u1", curves.source),
        "bridge_after": ("u1", curves.bridge_after),
        **_further(sigma_calibration_mm),
    }
    kind, count = _record(properties), len(curves.points_mm)
    data, (points,) = _room(_ply_header(_vertex_element(kind, count), axes), (kind, count))
    _fill(points, properties)
    return data


def _columns(names: tuple[str, ...], kind: str, array: NDArray[Any]) -> dict[str, tuple[str, NDArray[Any]]]:
    return {name: (kind, array[:, index]) for index, name in enumerate(names)}


def _record(properties: Mapping[str, tuple[str, NDArray[Any]]]) -> np.dtype[np.void]:
    """Packed, little endian."""
    return np.dtype([(name, f"<{kind}") for name, (kind, _) in properties.items()])


def _room(header: bytes, *bodies: tuple[np.dtype[np.void], int]) -> tuple[bytearray, list[NDArray[np.void]]]:
    """A file that begins with the header, and its bodies of records in place, to be filled in: a file put together of
    finished parts would take their memory twice.
    """
    data = bytearray(len(header) + sum(kind.itemsize * count for kind, count in bodies))
    data[: len(header)] = header
    places, at = [], len(header)
    for kind, count in bodies:
        places.append(np.frombuffer(data, dtype=kind, count=count, offset=at))
        at += kind.itemsize * count
    return data, places


def _fill(records: NDArray[np.void], properties: Mapping[str, tuple[str, NDArray[Any]]]) -> None:
    for name, (_, values) in properties.items():
        records[name] = values


def _vertex_element(vertex: np.dtype[np.void], count: int) -> list[str]:
    names = vertex.names or ()
    kinds = [_PLY_TYPES[vertex[name].str[1:]] for name in names]
    properties = [f"property {kind} {name}" for kind, name in zip(kinds, names, strict=True)]
    return [f"element vertex {count}", *properties]


def _ply_header(elements: list[str], axes: FileAxes | None) -> bytes:
    """Return the header of a PLY. axes : None as an earlier version wrote it, which did not state them."""
    comments = ["comment unit mm", "comment sigma_mm standard deviation along the surface normal"]
    stated = [] if axes is None else [axes.words]
    lines = ["ply", "format binary_little_endian 1.0", *comments, *stated, *elements]
    return "\n".join(lines).encode("ascii") + _END_OF_HEADER


def _plain(value: object, where: str) -> object:
    """`value` in the types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, Enum):
        return value.value if isinstance(value, str) else value.name.lower()
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value), where)
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), where)
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Path):
        return value.as_posix()
    message = f"{where}: JSON has no form for a {type(value).__name__}; give a number, text, list or mapping"
    raise TypeError(message)


@contextmanager
def staged_folder(output: Path, replaces: str = REPORT_FORMAT) -> Iterator[Path]:
    """Yield a folder to write into; on success it becomes `output` by one rename, on error it is removed.

    replaces : the format of the report of what it may take the place of.

    Raises
    ------
    InvalidInputError
        `output` is a file, or a folder that holds something else than results of an earlier run.
    StorageError
        The disk refused.
    """
    output = output.absolute()
    _require_replaceable(output, replaces)
    staging = staging_name(output)
    with storage_errors(output):
        staging.mkdir(parents=True)
    try:
        yield staging
        with storage_errors(output):
            sync_tree(staging)
            _put_in_place(staging, output)
            sync_folder(output.parent)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _put_in_place(staging: Path, output: Path) -> None:
    if not output.exists():
        staging.rename(output)
        return
    old = staging_name(output)
    output.rename(old)
    try:
        staging.rename(output)
    except OSError:
        old.rename(output)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _require_replaceable(output: Path, replaces: str) -> None:
    if not output.exists():
        return
    if output.is_dir() and (not any(output.iterdir()) or _is_report(output / REPORT, replaces)):
        return
    what = "a folder with other files in it" if output.is_dir() else "a file"
    message = f"{output}: results go into a folder of their own, and this is {what}; name a new folder"
    raise InvalidInputError(message)


def _is_report(path: Path, of: str) -> bool:
    try:
        return bool(stored_json(path.read_bytes()).get("format") == of)
    except (OSError, ValueError, AttributeError):
        return False


_MAX_SHARE = 0.001
_FAULTS = {
    "nonmanifold_edges": "edges of more than two triangles",
    "misoriented_edges": "edges between a front and a back",
    "duplicate_faces": "triangles that are there twice",
}


def fault_notes(figures: Mapping[str, Any]) -> list[str]:
    """A note if a mesh has faults of its topology. figures : `slrig.meshing.mesh_figures`."""
    faults = [f"{figures[name]:,} {words}" for name, words in _FAULTS.items() if figures[name] > 0]
    return [f"the mesh has {' and '.join(faults)}: an error of the program, please report it"] if faults else []


def layer_notes(layered: Mapping[str, float]) -> list[str]:
    """A note for each camera, by its name, that sees the mesh twice on more than a thousandth of its image of it."""
    return [
        f"camera '{name}' sees two layers of the mesh, one behind the other, on {share:.1%} of it: one of the two is "
        "no surface. Look for mirror images, and for wrong codes beside depth edges"
        for name, share in layered.items()
        if share > _MAX_SHARE
    ]


def truth_notes(truth: Mapping[str, Any]) -> list[str]:
    """Notes on a mesh whose true surface is known. truth : of a report, numbers that are not finite as NaN or None."""
    beyond, facing = truth.get("gross_fraction"), truth.get("facing_camera_area")
    notes = []
    if beyond is not None and beyond > _MAX_SHARE:
        notes.append(f"{beyond:.1%} of the area is more than 1 mm from the known truth; the rms is of the rest")
    if facing is not None and facing < 1 - _MAX_SHARE:
        notes.append(f"{1 - facing:.1%} of the area shows every camera its back: it is inside out, or no surface")
    return notes


def report_summary(report: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a report that is worth a row in a list: its plain values, and the whole of "truth", "mesh",
    "notes", "turntable" (its angle), "computed", and the seconds of each stage of the work.

    >>> report_summary({"method": "Gray-only", "stages": {"decode": 0.1}, "truth": {"rms_mm": float("nan")}})
    {'method': 'Gray-only', 'truth': {'rms_mm': None}}
    """
    return {
        name: _finite(value)
        for name, value in report.items()
        if name in {"truth", "mesh", "notes", "turntable", "computed", STAGES_S}
        or value is None
        or isinstance(value, (bool, int, float, str))
    }


def _finite(value: Any) -> Any:
    """The value with null for every number that JSON has no form for."""
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

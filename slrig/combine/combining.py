"""The model itself: meshes of several views registered, fused, and written with a report. Run by the worker and by
`slrig model`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from slrig.bundle import Poses, encode_poses, write_file
from slrig.combine.markers import markers_of
from slrig.combine.offered import COARSE, MODEL, MODEL_GLB, PLACED, POSES, REPORT, REPORT_FORMAT, SIDES, VIEW
from slrig.combine.pictures import six_sides_png
from slrig.combine.plan import START_ERROR_MM, GivenPoses, MarkerPoses, StartingPoses, TurntablePoses
from slrig.disk import storage_errors
from slrig.errors import ConfigError, InvalidInputError, ScanCancelledError
from slrig.kernels import report_compilations
from slrig.meshing import open_borders
from slrig.model import AlbedoMark, Mesh, TurntablePlane
from slrig.multiview import (
    FusedModel,
    MarkerFit,
    MarkerObservations,
    PoseErrors,
    Registration,
    TurntableAxis,
    concatenate_views,
    cut_view,
    find_start_poses,
    fuse_views,
    marker_poses,
    register_on_turntable,
    register_views,
)
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply, encode_report
from slrig.scan.mesh_formats import encode_mesh_glb
from slrig.scan.plan import ProgressCallback
from slrig.scan.view_format import encode_coarse_glb, encode_view_glb

_SURFACE_POINTS = 500  # of a view, at which it is told how well markers put it
_START_SIGMAS = 3.0  # of starts by markers, that have to lie within the start's error
_TOLD_BORDERS = 10  # of the open borders, the longest ones, each by itself


def combine_into(
    meshes: Mapping[str, Path],
    folder: Path,
    poses: StartingPoses,
    *,
    start_error_mm: float = START_ERROR_MM,
    voxel_mm: float | None = None,
    planes: Sequence[TurntablePlane] = (),
    notes: Sequence[str] = (),
    progress: ProgressCallback,
    cancelled: Callable[[], bool] = lambda: False,
) -> None:
    """Make one model of the meshes of several views, in the frame of the first, and write its files into a folder that
    only its maker knows yet; see `slrig.combine.offered`.

    meshes : the mesh.ply of each view, by the view's name, in the order of `poses`. poses : near where they belong; of
    a turntable, with its axis and angles; of markers, which are looked for in the frames beside each mesh and hold what
    shape leaves free; or unknown. start_error_mm : how far a surface may be from there. voxel_mm :
    length of the model's edges; None is 1.25 times that of the views'. planes : in the views' frame, what lies behind
    them is cut away first. notes : for the report.

    Raises
    ------
    ConfigError
        The turntable's axis or angles are not told.
    RegistrationRefusedError
        A view overlaps no other, or does not agree with them; poses were to be found, and none or two were; or views
        share too few markers.
    BundleError, CalibrationError
        Markers were to be found, and a scan has no frames or no calibration, or there is no such dictionary.
    TurntableRefusedError
        All but nothing of a view would be left before the planes.
    InvalidInputError
        A mesh is not as slrig wrote it, is no manifold, or the voxels are too fine for it.
    NothingToReconstructError
        No view has a triangle, or the voxels are larger than what was seen.
    ScanCancelledError
        `cancelled()` became true.
    StorageError
        The disk refused.
    """
    at = ("", 0.0)

    def entered(stage: str, fraction: float, detail: str = "") -> None:
        nonlocal at
        if cancelled():
            message = f"the model was cancelled before '{stage}'"
            raise ScanCancelledError(message)
        at = (stage, fraction)
        progress(stage, fraction, detail)

    def compiling(kernel: str) -> None:
        progress(*at, f"preparing kernels, first time only: {kernel}")

    with report_compilations(compiling):
        names, views, removed, seen = list(meshes), [], [], list[MarkerObservations]()
        for number, (name, file) in enumerate(meshes.items()):
            entered("reading", 0.2 * number / len(meshes), name)
            mesh = read_mesh(file)
            if isinstance(poses, MarkerPoses):
                # Before the cut: they lie on the plate.
                seen.append(markers_of(file, mesh, poses.dictionary))
            view, taken = cut_view(mesh, planes, name=name)
            views.append(view)
            removed.append(taken)
        entered("registering", 0.2, f"{len(views)} views")
        marked = _marked(views, seen, names, start_error_mm) if isinstance(poses, MarkerPoses) else None

        def again(rounds: int) -> None:
            entered("registering", 0.2 + 0.02 * rounds, f"{len(views)} views, round {rounds + 1}")

        found, axis = _registered(views, poses, marked, names, start_error_mm, again)
        entered("fusing", 0.4)
        errors = PoseErrors.from_registration(found.covariance, found.middle_mm)
        whole = fuse_views(views, found.poses, voxel_mm=voxel_mm, pose_errors=errors)
        entered("writing", 0.9, f"{len(whole.mesh.faces)} triangles")
        known = Poses(
            dict(zip(names, found.poses, strict=True)), None if axis is None else (axis.point_mm, axis.direction)
        )
        report = _report(names, views, found, None if axis is None else _axis(axis, poses), whole)
        for view_told, taken in zip(report["views"], removed, strict=True):
            view_told["removed"] = [
                {"kind": plane.kind, "share": share} for plane, share in zip(planes, taken, strict=True)
            ]
        report["markers"] = None if marked is None else _of_markers(marked, seen, names)
        report["notes"] = list(notes)
        # One at a time: each is as large as all meshes.
        files: dict[str, Callable[[], bytes | bytearray]] = {
            MODEL: lambda: encode_mesh_ply(whole.mesh, views=whole.views),
            MODEL_GLB: lambda: encode_mesh_glb(whole.mesh),
            PLACED: lambda: encode_mesh_ply(concatenate_views(views, found.poses)),
            POSES: lambda: encode_poses(known),
            SIDES: lambda: six_sides_png(whole.mesh),
            VIEW: lambda: encode_view_glb(whole.mesh),
            COARSE: lambda: encode_coarse_glb(whole.mesh),
            REPORT: lambda: encode_report(report),
        }
        for name, encoded in files.items():
            write_file(folder / name, encoded(), durable=False)
    progress("done", 1.0, f"{len(whole.mesh.faces)} triangles")


def read_mesh(file: Path) -> Mesh:
    """A view. Raises InvalidInputError: the file is not as slrig wrote it; StorageError: it cannot be read."""
    with storage_errors(file):
        data = file.read_bytes()
    try:
        return decode_mesh_ply(data)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file}: {error}") from error


def _marked(
    views: Sequence[Mesh], seen: Sequence[MarkerObservations], names: Sequence[str], start_error_mm: float
) -> MarkerFit:
    """Where markers put the views. Raises RegistrationRefusedError."""
    surfaces = [
        view.vertices_mm[:: max(1, len(view.vertices_mm) // _SURFACE_POINTS)].astype(np.float64) for view in views
    ]
    return marker_poses(seen, surfaces, names=names, max_sigma_mm=start_error_mm / _START_SIGMAS)


def _registered(
    views: Sequence[Mesh],
    poses: StartingPoses,
    marked: MarkerFit | None,
    names: Sequence[str],
    start_error_mm: float,
    begun: Callable[[int], None],
) -> tuple[Registration, TurntableAxis | None]:
    """Where the views belong, and of a turntable the axis that they tell. Raises ConfigError; as `register_views`."""
    if marked is not None:
        found = register_views(
            views, marked.poses, names=names, start_error_mm=start_error_mm, start_covariance=marked.covariance
        )
        return found, None
    if not isinstance(poses, TurntablePoses):
        starts = np.array(poses.matrices) if isinstance(poses, GivenPoses) else find_start_poses(views, names=names)
        return register_views(views, starts, names=names, start_error_mm=start_error_mm), None
    if poses.axis is None or poses.angles_deg is None:
        raise ConfigError("poses: expected a turntable's axis and the angle of each view, found one of them at most")
    point, direction, angles = (
        np.array(poses.axis.point_mm),
        np.array(poses.axis.direction),
        np.deg2rad(poses.angles_deg),
    )
    return register_on_turntable(
        views, point, direction, angles, names=names, start_error_mm=start_error_mm, on_round=begun
    )


def _report(
    names: Sequence[str], views: Sequence[Mesh], found: Registration, axis: Mapping[str, Any] | None, whole: FusedModel
) -> dict[str, Any]:
    return {
        "format": REPORT_FORMAT,
        "version": 1,
        "views": [
            {"name": name, "vertices": len(view.vertices_mm), "sigma_mm": sigma}
            for name, view, sigma in zip(names, views, found.sigma_mm.tolist(), strict=True)
        ],
        "registration": {
            "steps": found.steps,
            "inflation": found.inflation,
            "middle_mm": found.middle_mm,
            "radius_mm": found.radius_mm,
            "covariance": found.covariance,
        },
        "pairs": [{**asdict(pair), "first": names[pair.first], "second": names[pair.second]} for pair in found.pairs],
        "free": [{**asdict(each), "view": names[each.view], "words": str(each)} for each in found.free],
        "axis": axis,
        "model": _of_model(whole),
    }


def _of_markers(found: MarkerFit, seen: Sequence[MarkerObservations], names: Sequence[str]) -> list[dict[str, Any]]:
    """What report.json says of each view's markers: those seen, those of them that another view shares, how well they
    put its surface, and what was left out.
    """
    return [
        {
            "view": name,
            "seen": sorted(seen[v]),
            "used": found.used[v],
            "sigma_mm": float(found.sigma_mm[v]),
            "rms_over_sigma": float(found.rms_over_sigma[v]),
            "left_out": [
                {"marker": each.marker, "off_mm": each.off_mm, "off_over_sigma": each.off_over_sigma}
                for each in found.rejected
                if each.view == v
            ],
        }
        for v, name in enumerate(names)
    ]


def _axis(found: TurntableAxis, told: StartingPoses) -> dict[str, Any]:
    """The axis as the views have it. turntable_error_deg : (N,), angles as found less those told, within half a
    turn.
    """
    stated_deg = np.array(told.angles_deg if isinstance(told, TurntablePoses) else ())
    off_deg = np.rad2deg(found.angles_rad) - (stated_deg - stated_deg[0])
    return {**asdict(found), "turntable_error_deg": (off_deg + 180) % 360 - 180}


def _of_model(whole: FusedModel) -> dict[str, Any]:
    """What report.json says of the fused mesh.

    sigma_ends_mm : 5 % and 95 % of its vertices are below. seen_by : share of them by how many views tell of each.
    open : its borders, of holes and of what no view has seen, see `slrig.meshing.topology`. marked : vertices whose
    colour is in doubt, by cause.
    """
    mesh = whole.mesh
    shares = np.bincount(whole.views) / len(whole.views)
    borders = open_borders(mesh.vertices_mm, mesh.faces)
    a, b, c = (mesh.vertices_mm[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    marked = np.bincount(mesh.mark, minlength=len(AlbedoMark))
    return {
        "vertices": len(whole.mesh.vertices_mm),
        "triangles": len(whole.mesh.faces),
        "voxel_mm": whole.voxel_mm,
        "correlated_mm": whole.correlated_mm,
        "sigma_mm": float(np.median(mesh.sigma_mm)),
        "sigma_ends_mm": dict(zip(("p5", "p95"), np.percentile(mesh.sigma_mm, (5, 95)).tolist(), strict=True)),
        "area_mm2": float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2),
        "seen_by": {int(count): float(shares[count]) for count in np.flatnonzero(shares)},
        "open": {
            "borders": len(borders.length_mm),
            "edges": borders.edges,
            "length_mm": float(borders.length_mm.sum()),
            "area_mm2": float(borders.area_mm2.sum()),
            "largest": [
                {"length_mm": length, "area_mm2": area}
                for length, area in zip(borders.length_mm.tolist(), borders.area_mm2.tolist(), strict=True)
            ][:_TOLD_BORDERS],
        },
        "marked_vertices": {mark.name.lower(): int(marked[mark]) for mark in AlbedoMark if mark is not AlbedoMark.NONE},
    }

"""Models: meshes of several views registered, fused, and written with a report and pictures. Run by the worker and by
`slrig model`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import DESCRIPTION, Poses, encode_poses, open_bundle, write_file
from slrig.calibration.detection import (
    MAX_SIGMA_PX,
    SIGMA_FLOOR_PX,
    GreyImage,
    PointFit,
    detect_markers,
    fit_corners,
    patch_offsets,
)
from slrig.calibration.printing import marker_dictionary
from slrig.disk import storage_errors
from slrig.errors import BundleError, ConfigError, InvalidInputError
from slrig.jobs.listener import SILENT, Listener
from slrig.kernels import report_compilations
from slrig.meshing import open_borders, used_vertices
from slrig.model import AlbedoMark, FloatArray, Mesh, Pinhole, Pixels, RotationAxis, Size, TurntablePlane, White
from slrig.model_jobs.plan import (
    COARSE,
    MODEL,
    MODEL_GLB,
    PLACED,
    POSES,
    REPORT,
    REPORT_FORMAT,
    SIDES,
    START_ERROR_MM,
    VIEW,
    GivenPoses,
    MarkerPoses,
    StartingPoses,
    TurntablePoses,
)
from slrig.multiview import (
    FusedModel,
    MarkerFit,
    MarkerObservation,
    MarkerObservations,
    PoseErrors,
    Registration,
    TurntableAxis,
    concatenate_views,
    cut_view,
    find_start_poses,
    find_turntable_planes,
    fit_plane,
    fuse_views,
    marker_poses,
    register_on_turntable,
    register_views,
)
from slrig.reconstruction import pixel_rays, project
from slrig.scan.artefacts import MESH, decode_mesh_ply, encode_mesh_ply, encode_report
from slrig.scan.formats import encode_coarse_glb, encode_mesh_glb, encode_view_glb
from slrig.scan.pictures import Picture, captioned, draw_scale, encode_png, shaded, side_by_side

_REACH = 0.7
"""Of a module, from a marker's corner: inside is its border, one wide, outside paper, by a ChArUco board's least."""
_LEAST_HALF_PX, _MOST_HALF_PX = 3, 12
_FEWEST_VERTICES = 30
"""Fewest vertices of the mesh on a marker: fewer determine no plane."""
_ALIKE = 30
"""So many neighbouring vertices err alike: rendered planes are as far off at their corners as that makes of them."""


def bundle_of(mesh_file: Path) -> Path:
    """The frames that a mesh was made of: next to it as the service and `slrig model --shoot` keep them, or its folder.
    Raises BundleError: there are none.
    """
    scan = mesh_file.absolute().parent
    places = [scan / "bundle", scan, scan.parent / scan.name.replace("view-", "bundle-")]
    of_one = mesh_file.name == MESH  # any other file may be of any scan
    found = next((place for place in places if of_one and (place / DESCRIPTION).is_file()), None)
    if found is None:
        message = (
            f"{mesh_file}: expected the frames that it was made of, to find markers in, found no "
            f"{DESCRIPTION} in {places[0]} or {scan} next to a {MESH}. Put the bundle "
            "there, or give the poses of scans in another way"
        )
        raise BundleError(message)
    return found


def markers_of(mesh_file: Path, mesh: Mesh, dictionary: str) -> dict[int, MarkerObservation]:
    """The markers of a scan, by number, in the frame of its mesh: where rays through their corners, in each white frame
    of each camera, meet the plane of the mesh there. dictionary : OpenCV's name.

    Of several frames the corners are the mean, and known no better than in the best: they share the surface. A marker
    that is twice in a frame, or on which the mesh is not a plane, is left out.

    Raises
    ------
    BundleError
        There are no frames, or none in white, or no calibration next to them.
    CalibrationError
        There is no such dictionary.
    """
    files = open_bundle(bundle_of(mesh_file))
    outline, known = files.outline, files.calibration
    white = [k for k, shot in enumerate(outline.shots) if isinstance(outline.patterns[shot.pattern], White)]
    if known is None or not white:
        what = "calibration.json" if known is None else "frame in white"
        message = f"{files.folder}: expected a {what}, without which no marker can be put on the surface, found none"
        raise BundleError(f"{message}; say in another way where the scan belongs")
    found: dict[int, list[MarkerObservation]] = {}
    for shot in files.shots(white, colour=False):
        camera = known.cameras.get(shot.camera)
        if camera is not None:
            for number, each in markers_in_view(
                shot.image, camera, outline.cameras[shot.camera].full_scale, mesh, dictionary
            ):
                found.setdefault(number, []).append(each)
    return {number: _mean(each) for number, each in found.items()}


def markers_in_view(
    image: Pixels, camera: Pinhole, full_scale: float, mesh: Mesh, dictionary: str
) -> Iterator[tuple[int, MarkerObservation]]:
    """The markers of one frame, (H, W), with pixels that clip at `full_scale`; see `markers_of`."""
    grey = GreyImage.from_pixels(image, full_scale)
    outlines, numbers = detect_markers(grey.image_8bit, dictionary)
    modules = int(marker_dictionary(dictionary).markerSize) + 2
    vertices = mesh.vertices_mm.astype(np.float64)
    places = project(camera, vertices)
    for number, rough in zip(numbers.tolist(), outlines, strict=True):
        mine = vertices[_inside(rough, places)]
        plane = fit_plane(mine) if len(mine) >= _FEWEST_VERTICES else None
        if plane is None or np.count_nonzero(numbers == number) > 1:
            continue
        middle, normal, off_mm = plane
        # Of a plane by n points, where these end: of its middle and two tilts, 1 / n each.
        off_mm *= np.sqrt(3 * _ALIKE / len(mine))
        fitted = _fit_corners(grey.level, rough, modules)
        sigma_px = np.hypot(fitted.sigma_px, SIGMA_FLOOR_PX)
        if not (sigma_px < MAX_SIGMA_PX).all():  # NaN where a fit failed
            continue
        ways = pixel_rays(camera, fitted.points_px)
        depth = (middle - camera.centre_mm) @ normal / (ways @ normal)
        cosine = np.abs(ways @ normal) / np.linalg.norm(ways, axis=1)
        # Of three coordinates the rms: pixels move a corner within the plane, farther at a slant, and
        # the plane's own error along the ray.
        across_mm = sigma_px * depth / camera.matrix[0, 0]
        sigma = np.sqrt((across_mm**2 * (1 + cosine**-2) + (off_mm / cosine) ** 2) / 3)
        yield number, MarkerObservation(camera.centre_mm + depth[:, None] * ways, sigma)


def _fit_corners(level: FloatArray, rough: FloatArray, modules: int) -> PointFit:
    """A marker's corners (4, 2), which OpenCV gives clockwise, by a fit to the pixels about each."""
    # Columns: one module along the side that follows a corner, and one along the side before it.
    slope = np.stack([np.roll(rough, -1, axis=0) - rough, np.roll(rough, 1, axis=0) - rough], axis=2) / modules
    half = int(np.clip(np.ceil(_REACH * np.abs(slope).sum(axis=2).max()), _LEAST_HALF_PX, _MOST_HALF_PX))
    offsets = patch_offsets(half) + (np.round(rough) - rough)[:, None]
    usable = np.abs(np.einsum("nij,nmj->nmi", np.linalg.inv(slope), offsets)).max(axis=2) < _REACH
    sides = slope.transpose(0, 2, 1) * np.array([[1.0], [-1.0]])
    return fit_corners(level, rough, sides, usable, half_px=half, outer=True)


def _inside(outline: FloatArray, places: FloatArray) -> NDArray[np.bool_]:
    """(n,): which places (n, 2) lie in a convex outline (4, 2), whichever way round it runs."""
    sides = np.roll(outline, -1, axis=0) - outline
    to = places[:, None] - outline
    left = sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0] > 0
    # NaN, behind the camera, is on no side.
    return np.asarray((left.all(axis=1) | ~left.any(axis=1)) & np.isfinite(places).all(axis=1))


def _mean(markers: list[MarkerObservation]) -> MarkerObservation:
    weight = np.array([each.sigma_mm for each in markers])[..., None] ** -2
    corners = (weight * [each.corners_mm for each in markers]).sum(axis=0) / weight.sum(axis=0)
    return MarkerObservation(corners, np.min([each.sigma_mm for each in markers], axis=0))


_PANEL = Size(400, 400)
_FILL = 0.9
_DISTANCE = 50.0  # half diagonals of the object: what is nearer is drawn at most 2 % larger

# From the model's frame, y down and z away from a viewer in front, into that of a camera: its axes as rows.
_SIDES: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "top": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "bottom": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


def six_sides_png(mesh: Mesh) -> bytes:
    """The mesh from six sides at one scale, which a bar gives, as PNG. The front is what the first view's camera saw.

    Backs of triangles are red: they are visible through open borders. The mesh has a triangle.
    """
    points = mesh.vertices_mm[used_vertices(mesh.faces, len(mesh.vertices_mm))].astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    distance_mm = _DISTANCE * max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    px_per_mm = _FILL * _PANEL.width_px / max(float((high - low).max()), 1e-6)
    panels = [_panel(mesh, name, (low + high) / 2, distance_mm, px_per_mm) for name in _SIDES]
    page = np.concatenate([side_by_side(panels[:3]), side_by_side(panels[3:])])
    return encode_png(page)


def _panel(mesh: Mesh, side: str, middle_mm: FloatArray, distance_mm: float, px_per_mm: float) -> Picture:
    turn = np.array(_SIDES[side], dtype=np.float64)
    centre = (np.array(_PANEL.shape[::-1]) - 1) / 2
    focal_px = px_per_mm * distance_mm
    camera = Pinhole(
        size=_PANEL,
        matrix=np.array(((focal_px, 0.0, centre[0]), (0.0, focal_px, centre[1]), (0.0, 0.0, 1.0))),
        distortion=np.zeros(5),
        rotation=turn,
        translation_mm=np.array((0.0, 0.0, distance_mm)) - turn @ middle_mm,
    )
    panel = shaded(mesh, camera)
    draw_scale(panel, _PANEL, px_per_mm)
    return captioned(panel, side, "backs are red" if side == "front" else "")


_SURFACE_POINTS = 500  # of a view, for the deviation of its pose by markers
_START_SIGMAS = 3.0  # of starts by markers, that have to lie within the start's error
_LISTED_BORDERS = 10  # of the open borders, the longest ones, each by itself


def combine_into(
    meshes: Mapping[str, Path],
    folder: Path,
    poses: StartingPoses,
    listener: Listener = SILENT,
    *,
    start_error_mm: float = START_ERROR_MM,
    voxel_mm: float | None = None,
    planes: Sequence[TurntablePlane] = (),
    notes: Sequence[str] = (),
) -> None:
    """Make one model of the meshes of several views, in the frame of the first, and write its files into a folder that
    only its maker knows yet; see `slrig.model_jobs.job`.

    meshes : the mesh.ply of each view, by the view's name, in the order of `poses`. poses : near their final ones; of a
    turntable, with its axis and angles; of markers, which are found in the frames next to each mesh and fix motions
    that shape leaves free; or unknown. start_error_mm : how far a surface may be from there. voxel_mm : length of the
    model's edges; None is 1.25 times that of the views'. planes : in the views' frame, what lies behind them is cut
    away first. notes : for the report.

    Raises
    ------
    ConfigError
        The turntable's axis or angles are not given.
    RegistrationRefusedError
        A view overlaps no other, or does not agree with them; poses were to be found, and none or two were; or views
        share too few markers.
    BundleError, CalibrationError
        Markers were to be found, and a scan has no frames or no calibration, or there is no such dictionary.
    TurntableRefusedError
        All but nothing of a view would be left before the planes.
    InvalidInputError
        A mesh is not as slrig wrote it, is not a manifold, or the voxels are too fine for it.
    NothingToReconstructError
        No view has a triangle, or the voxels are larger than the surface.
    ScanCancelledError
        The listener had it cancelled.
    StorageError
        The disk refused.
    """
    at = ("", 0.0)

    def entered(stage: str, fraction: float, detail: str = "") -> None:
        nonlocal at
        listener.check(f"the model was cancelled before '{stage}'")
        at = (stage, fraction)
        listener.report(stage, fraction, detail)

    def compiling(kernel: str) -> None:
        listener.report(*at, f"preparing kernels, first time only: {kernel}")

    with report_compilations(compiling):
        names, views, removed, markers = list(meshes), [], [], list[MarkerObservations]()
        for number, (name, file) in enumerate(meshes.items()):
            entered("reading", 0.2 * number / len(meshes), name)
            mesh = read_mesh(file)
            if isinstance(poses, MarkerPoses):
                # Before the cut: they lie on the plate.
                markers.append(markers_of(file, mesh, poses.dictionary))
            view, taken = cut_view(mesh, planes, name=name)
            views.append(view)
            removed.append(taken)
        entered("registering", 0.2, f"{len(views)} views")
        marked = _marked(views, markers, names, start_error_mm) if isinstance(poses, MarkerPoses) else None

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
        for shown, taken in zip(report["views"], removed, strict=True):
            shown["removed"] = [
                {"kind": plane.kind, "share": share} for plane, share in zip(planes, taken, strict=True)
            ]
        report["markers"] = None if marked is None else _of_markers(marked, markers, names)
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
    listener.report("done", 1.0, f"{len(whole.mesh.faces)} triangles")


def read_mesh(file: Path) -> Mesh:
    """A view. Raises InvalidInputError: the file is not as slrig wrote it; StorageError: it cannot be read."""
    with storage_errors(file):
        data = file.read_bytes()
    try:
        return decode_mesh_ply(data)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file}: {error}") from error


def _marked(
    views: Sequence[Mesh], markers: Sequence[MarkerObservations], names: Sequence[str], start_error_mm: float
) -> MarkerFit:
    """Poses of the views by markers. Raises RegistrationRefusedError."""
    surfaces = [
        view.vertices_mm[:: max(1, len(view.vertices_mm) // _SURFACE_POINTS)].astype(np.float64) for view in views
    ]
    return marker_poses(markers, surfaces, names=names, max_sigma_mm=start_error_mm / _START_SIGMAS)


def _registered(
    views: Sequence[Mesh],
    poses: StartingPoses,
    marked: MarkerFit | None,
    names: Sequence[str],
    start_error_mm: float,
    begun: Callable[[int], None],
) -> tuple[Registration, TurntableAxis | None]:
    """Poses of the views, and of a turntable the axis by them. Raises ConfigError; as `register_views`."""
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


def _of_markers(found: MarkerFit, markers: Sequence[MarkerObservations], names: Sequence[str]) -> list[dict[str, Any]]:
    """Each view's markers for report.json: all, those that another view shares, the deviation of the surface by them,
    and those left out.
    """
    return [
        {
            "view": name,
            "seen": sorted(markers[v]),
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


def _axis(found: TurntableAxis, stated: StartingPoses) -> dict[str, Any]:
    """The axis by the views. turntable_error_deg : (N,), angles found less those stated, within half a turn."""
    stated_deg = np.array(stated.angles_deg if isinstance(stated, TurntablePoses) else ())
    off_deg = np.rad2deg(found.angles_rad) - (stated_deg - stated_deg[0])
    return {**asdict(found), "turntable_error_deg": (off_deg + 180) % 360 - 180}


def _of_model(whole: FusedModel) -> dict[str, Any]:
    """The fused mesh for report.json.

    sigma_ends_mm : 5 % and 95 % of its vertices are below. seen_by : share of them by the number of their views. open :
    its borders, of holes and of parts that no view shows, see `slrig.meshing.topology`. marked : vertices with a
    colour in doubt, by cause.
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
            ][:_LISTED_BORDERS],
        },
        "marked_vertices": {mark.name.lower(): int(marked[mark]) for mark in AlbedoMark if mark is not AlbedoMark.NONE},
    }


def planes_in(mesh: Path, axis: RotationAxis | None) -> tuple[TurntablePlane, ...]:
    """The planes in a mesh.ply. Raises as `find_turntable_planes`, InvalidInputError, and StorageError."""
    return find_turntable_planes(read_mesh(mesh), axis)

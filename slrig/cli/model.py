"""`slrig model`: scans of one object from several sides, made one mesh. Loads nothing heavy before it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from slrig.errors import ConfigError, InvalidInputError

if TYPE_CHECKING:
    from slrig.model import FloatArray, Mesh
    from slrig.views.fusion import FusedModel
    from slrig.views.registration import Registration
    from slrig.views.turntable import FoundAxis

MODEL, POSES, PLACED = "model.ply", "poses.json", "placed.ply"
REPORT_FORMAT = "slrig-model"
"""Of its report, which is not that of a scan: a model never takes the place of one."""
Vector = tuple[float, float, float]


def model(
    scans: Annotated[
        list[Path], typer.Argument(metavar="SCAN", help="Folders with mesh.ply, or a folder of such; or PLY files.")
    ],
    output: Annotated[Path, typer.Option(help="Folder for the model, the poses and the report.")],
    angle: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="The stage turned the object by so much, right-handed, from scan to scan."),
    ] = None,
    axis: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --angle: the stage's axis, as in an earlier poses.json.")
    ] = None,
    axis_point: Annotated[
        Vector | None, typer.Option(metavar="X Y Z", help="With --angle: a point of the axis, mm, in the scans' frame.")
    ] = None,
    axis_direction: Annotated[
        Vector | None, typer.Option(metavar="X Y Z", help="With --axis-point: the direction of the axis.")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses to start from, by the scans' names, as in poses.json.")
    ] = None,
    start_error_mm: Annotated[
        float, typer.Option(min=0.01, max=100.0, help="How far a surface may be from where angle or poses put it.")
    ] = 3.0,
    voxel_mm: Annotated[
        float | None,
        typer.Option(min=0.001, help="Length of the model's edges; by default 1.25 times that of the scans'."),
    ] = None,
) -> None:
    """Make one mesh of scans of an object from several sides.

    Says how well they agree, and which motions their shape leaves open. The start is a stage's angle or poses. Where
    no scan has seen the object, the mesh is open.
    """
    from slrig.cli.display import progress_shown
    from slrig.cli.reconstruct import keep_kernels
    from slrig.logs import set_up_logs_for_a_person
    from slrig.scan.artefacts import staged_folder

    set_up_logs_for_a_person()
    keep_kernels()
    files = _named_meshes(scans)
    names = list(files)
    starts, start_axis = _starts(names, angle, _axis(axis, axis_point, axis_direction), poses)
    _require_apart(output, [*files.values(), *(each for each in (axis, poses) if each and each.name != POSES)])
    with staged_folder(output, REPORT_FORMAT) as folder, progress_shown() as display:
        from slrig.views.fusion import fused
        from slrig.views.registration import registered
        from slrig.views.turntable import found_axis

        display("reading", 0.0, f"{len(files)} meshes")
        views = [_mesh(file) for file in files.values()]
        display("registering", 0.2, "")
        found = registered(views, starts, names=names, start_error_mm=start_error_mm)
        turned = None if start_axis is None else found_axis(found, start_axis)
        display("fusing", 0.4, "")
        whole = fused(views, found.poses, voxel_mm=voxel_mm)
        display("writing", 0.9, "")
        told = _of_model(whole)
        report = {**_report(names, views, found, turned, angle), "model": told}
        made = _files(names, views, found, turned, whole.mesh, report)
        for name, data in made.items():
            (folder / name).write_bytes(data)
        display("done", 1.0, "")
    _tell(names, views, found, turned, angle)
    _tell_fused(told)
    for name in made:
        typer.echo(f"{Path(name).stem:<10}{output / name}")


def _files(
    names: Sequence[str],
    views: Sequence[Mesh],
    found: Registration,
    turned: FoundAxis | None,
    mesh: Mesh,
    report: Mapping[str, Any],
) -> dict[str, bytes]:
    """What the folder gets, by name."""
    from slrig.bundle.poses_file import Poses, encode_poses
    from slrig.scan.artefacts import REPORT, encode_mesh_ply, encode_report
    from slrig.views.placing import put_together

    poses = dict(zip(names, found.poses, strict=True))
    axis = None if turned is None else (turned.point_mm, turned.direction)
    return {
        MODEL: encode_mesh_ply(mesh),
        PLACED: encode_mesh_ply(put_together(views, found.poses)),
        POSES: encode_poses(Poses(poses, axis)),
        REPORT: encode_report(report),
    }


def _report(
    names: Sequence[str],
    views: Sequence[Mesh],
    found: Registration,
    turned: FoundAxis | None,
    angle_deg: float | None,
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
        "free": [{**asdict(each), "view": names[each.view]} for each in found.free],
        "axis": None if turned is None else {**asdict(turned), "stage_error_deg": _stage_errors_deg(turned, angle_deg)},
    }


def _of_model(whole: FusedModel) -> dict[str, Any]:
    """What report.json says of the fused mesh. seen_by : share of its vertices by how many views tell of each."""
    import numpy as np

    shares = np.bincount(whole.views) / len(whole.views)
    return {
        "vertices": len(whole.mesh.vertices_mm),
        "triangles": len(whole.mesh.faces),
        "voxel_mm": whole.voxel_mm,
        "correlated_mm": whole.correlated_mm,
        "sigma_mm": float(np.median(whole.mesh.sigma_mm)),
        "seen_by": {int(count): float(shares[count]) for count in np.flatnonzero(shares)},
    }


def _tell_fused(of: Mapping[str, Any]) -> None:
    once = of["seen_by"].get(1, 0.0)
    typer.echo(
        f"{'mesh':<10}{of['vertices']:,} vertices, {of['triangles']:,} triangles of {of['voxel_mm']:.2g} mm; σ "
        f"{of['sigma_mm']:.4f} mm; neighbours in one view err alike by {of['correlated_mm']:.4f} mm; {once:.0%} seen "
        "by one view only"
    )


def _tell(
    names: Sequence[str], views: Sequence[Mesh], found: Registration, turned: FoundAxis | None, angle: float | None
) -> None:
    import numpy as np
    from rich.table import Column

    from slrig.cli.display import counted, print_table

    rows = []
    for view, name in enumerate(names):
        pairs = [pair for pair in found.pairs if view in (pair.first, pair.second)]
        weights = [pair.overlap for pair in pairs]
        rms, over, closure = (
            np.sqrt(np.average(np.square([getattr(pair, what) for pair in pairs]), weights=weights))
            for what in ("rms_mm", "rms_over_sigma", "closure_mm")
        )
        rows.append(
            (name, f"{len(views[view].vertices_mm):,}", str(len(pairs)), f"{max(weights):.0%}", f"{rms:.4f} mm",
             f"{over:.2f}", f"{closure:.4f} mm", f"{found.sigma_mm[view]:.4f} mm" if view else "the frame")
        )  # fmt: skip
    figures = ("vertices", "overlaps", "most", "residual", "over σ", "closure", "σ of pose")
    print_table((Column("view", overflow="fold"), *(Column(each, justify="right") for each in figures)), rows)
    for kind in dict.fromkeys(each.motion for each in found.free):
        mine = [each for each in found.free if each.motion is kind]
        who = counted(len({each.view for each in mine}), "view")
        least = min(each.free_mm for each in mine)
        far = f"by {least:.2g} mm and more" if np.isfinite(least) else "without a limit"
        typer.echo(f"{'free':<10}{who} may {mine[0]} {far}: no surface tells, held as the start has it")
    if turned is not None:
        x, y, z = turned.point_mm
        a, b, c = turned.direction
        sigma_deg = np.rad2deg(turned.direction_sigma_rad)
        worst = np.abs(_stage_errors_deg(turned, angle)).max()
        typer.echo(
            f"{'axis':<10}through ({x:.3f}, {y:.3f}, {z:.3f}) mm ± {turned.point_sigma_mm:.4f} mm, along "
            f"({a:.5f}, {b:.5f}, {c:.5f}) ± {sigma_deg:.4f}°; the stage's angles are up to {worst:.3f}° off"
        )


def _stage_errors_deg(turned: FoundAxis, angle_deg: float | None) -> FloatArray:
    """(N,): angles as found less those that were told, within half a turn of 0."""
    import numpy as np

    told = np.arange(len(turned.angles_rad)) * (angle_deg or 0.0)
    return np.asarray((np.rad2deg(turned.angles_rad) - told + 180) % 360 - 180)


def _starts(
    names: Sequence[str], angle: float | None, axis: tuple[FloatArray, FloatArray] | None, file: Path | None
) -> tuple[FloatArray, FloatArray | None]:
    """(N, 4, 4), and the direction of the axis they turn about, where a stage is told of.

    Raises ConfigError: they are not told in one way alone, or not of all scans.
    """
    import numpy as np

    from slrig.bundle.poses_file import read_poses
    from slrig.views.turntable import turntable

    if (angle is None) == (file is None) or (angle is None) != (axis is None):
        told = {"--angle": angle, "--axis or --axis-point": axis, "--poses": file}
        found = ", ".join(way for way, value in told.items() if value is not None) or "none of them"
        message = (
            "expected a stage's --angle with its axis (--axis FILE, or --axis-point and --axis-direction), or --poses "
            f"FILE, found {found}. Poses that nobody knows cannot be found yet: place the scans by hand in another "
            "program, and write what it says into a file as slrig/views/README.md describes"
        )
        raise ConfigError(message)
    if file is None:
        point, direction = cast("tuple[FloatArray, FloatArray]", axis)
        return turntable(point, direction, np.deg2rad(cast("float", angle) * np.arange(len(names)))), direction
    known = read_poses(file).poses
    missing = [name for name in names if name not in known]
    if missing:
        message = f"{file}: expected a pose of every scan, found none of {', '.join(missing)}; there are: "
        raise ConfigError(message + (", ".join(known) or "none"))
    return np.stack([known[name] for name in names]), None


def _axis(file: Path | None, point: Vector | None, direction: Vector | None) -> tuple[FloatArray, FloatArray] | None:
    """A point and the direction of the axis that was told. Raises ConfigError: twice, by half, or `file` has none."""
    import numpy as np

    from slrig.bundle.poses_file import read_poses

    if (point is None) != (direction is None) or (file is not None and point is not None):
        raise ConfigError("expected --axis FILE, or --axis-point X Y Z and --axis-direction X Y Z together")
    if file is not None:
        axis = read_poses(file).axis
        if axis is None:
            raise ConfigError(f"{file}: expected the key axis, with point_mm and direction, found none; write it there")
        return axis
    if point is None or direction is None:
        return None
    if not np.linalg.norm(direction) > 0:
        raise ConfigError("--axis-direction: expected a vector with a length, found 0 0 0")
    return np.array(point), np.array(direction)


def _require_apart(output: Path, read: Sequence[Path]) -> None:
    """Raises ConfigError: the folder to write, which replaces an earlier one, holds what is read."""
    inside = next((file for file in read if file.resolve().is_relative_to(output.resolve())), None)
    if inside is not None:
        raise ConfigError(f"--output {output}: {inside} lies in it and would be replaced; name another folder")


def _named_meshes(asked: Sequence[Path]) -> dict[str, Path]:
    """The mesh.ply that is meant by each argument, by the scan's name, in the order told; of a folder's, natural.

    Raises ConfigError: there is none, fewer than two, or two of one name.
    """
    from slrig.cli.bundles import matching, natural
    from slrig.scan.artefacts import MESH

    found: list[tuple[str, Path]] = []
    for path in (each for one in asked for each in matching(one)):
        inside = [path / MESH] if (path / MESH).is_file() else sorted(path.glob(f"*/{MESH}"), key=natural)
        if path.is_file():
            inside = [path]
        if not inside:
            message = f"{path}: expected a scan's folder with {MESH}, a folder of such, or a PLY file, found none"
            raise ConfigError(message)
        found += [(file.absolute().parent.name if file.name == MESH else file.stem, file) for file in inside]
    names = [name for name, _ in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if len(found) < 2 or twice:
        what = f"two called {', '.join(twice)}: rename a folder" if twice else f"{len(found)}: name all scans"
        raise ConfigError(f"expected two scans or more, each with a name of its own, found {what}")
    return dict(found)


def _mesh(file: Path) -> Mesh:
    """Raises InvalidInputError: the file is not as slrig wrote it; StorageError: it cannot be read."""
    from slrig.disk import refusals_of
    from slrig.scan.artefacts import decode_mesh_ply

    with refusals_of(file):
        data = file.read_bytes()
    try:
        return decode_mesh_ply(data)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file}: {error}") from error

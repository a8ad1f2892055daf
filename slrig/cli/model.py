"""`slrig model`, scans of one object from several sides combined into one mesh, and `slrig turntable`. Loads nothing
heavy before a command runs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slrig.cli.options import BoardArguments, ServiceOptions, SubjectsCommand, given, grouped
from slrig.errors import ConfigError
from slrig.examples import rig_path
from slrig.jobs.listener import Listener

if TYPE_CHECKING:
    from slrig.bundle import TurntableRecord
    from slrig.model_jobs.plan import StartingPoses, StatedAxis

Vector = tuple[float, float, float]
_OFF_DEG = 5.0
"""Largest difference between the stated angle of a turntable and that of a scan's report: more than the errors of
turntables, less than the distance of views.
"""


@partial(
    grouped,
    subjects={
        "Where the views belong": "angle axis axis_point axis_direction turntable poses unknown markers dictionary",
        "Shooting": "shoot rig manual",
        "Surface": "no_cut start_error_mm voxel_mm",
    },
)
def model(
    *,
    scans: Annotated[
        list[Path] | None,
        typer.Argument(metavar="SCAN", help="Folders with mesh.ply, or a folder of such; or PLY files."),
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for the model, the poses and the report.")],
    shoot: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Shoot so many views around the object, with a service or with --rig."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="RIG",
            callback=rig_path,
            help="With --shoot: the rig file to shoot with; what the folder has of an earlier call stays.",
        ),
    ] = None,
    manual: Annotated[bool, typer.Option("--manual", help="With --shoot: turn it yourself, on request.")] = False,
    service: ServiceOptions,
    angle: Annotated[
        float | None,
        typer.Option(
            metavar="DEG", help="The turntable turned the object by so much, right-handed, from scan to scan."
        ),
    ] = None,
    axis: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --angle or --shoot: the turntable's axis, as in poses.json."),
    ] = None,
    axis_point: Annotated[
        Vector | None, typer.Option(metavar="X Y Z", help="With --angle: a point of the axis, mm, in the scans' frame.")
    ] = None,
    axis_direction: Annotated[
        Vector | None, typer.Option(metavar="X Y Z", help="With --axis-point: the direction of the axis.")
    ] = None,
    turntable: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="What slrig turntable wrote: the axis for --angle, and planes to cut views by."
        ),
    ] = None,
    no_cut: Annotated[
        bool, typer.Option("--no-cut", help="With --turntable: leave plate and backdrops in the views.")
    ] = (False),
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses to start from, by the scans' names, as in poses.json.")
    ] = None,
    unknown: Annotated[
        bool, typer.Option("--unknown", help="The poses of the scans are unknown: find them from the surfaces.")
    ] = False,
    markers: Annotated[
        bool, typer.Option("--markers", help="Find the poses of the scans by ArUco markers that turn with the object.")
    ] = False,
    dictionary: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --markers: OpenCV's name for theirs; else DICT_5X5_250.")
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

    Says how well they agree, and which motions their shape leaves open. The start is a turntable's angle, poses,
    markers, or unknown. Where no scan shows the object, the mesh is open.
    """
    from slrig.bundle import TurntableRecord, read_turntable
    from slrig.cli.display import progress_shown
    from slrig.cli.reconstruct import keep_kernels
    from slrig.logs import set_up_console_logs
    from slrig.model_jobs.plan import (
        MARKER_DICTIONARY,
        POSES,
        REPORT,
        REPORT_FORMAT,
        MarkerPoses,
        StatedAxis,
        UnknownPoses,
    )
    from slrig.scan.artefacts import staged_folder

    set_up_console_logs()
    keep_kernels()
    known, notes = TurntableRecord() if turntable is None else read_turntable(turntable), list[str]()
    stated = _axis(axis, axis_point, axis_direction)
    if stated is None and known.axis is not None and poses is None and not (unknown or markers):
        stated = StatedAxis.of(known.axis.point_mm, known.axis.direction)
    if (shoot is None) == (not scans) or (shoot is None and (rig or manual)):
        raise ConfigError("expected scans, or --shoot N (with --rig or a service, and --manual), and not both")
    if dictionary is not None and not markers:
        raise ConfigError("--dictionary: expected --markers with it, for their dictionary; leave it out")
    found = MarkerPoses(dictionary or MARKER_DICTIONARY) if markers else UnknownPoses() if unknown else None
    if found is not None and ((unknown and markers) or (shoot is not None and stated is not None)):
        raise ConfigError(
            "--markers and --unknown each find the poses of scans by themselves: leave out the other one, and an axis"
        )
    if shoot is None:
        files = _named_meshes(scans or ())
        start = _starts(list(files), angle, stated, poses, found)
        if angle is not None:
            _require_order(files, angle)
    elif angle is not None or poses is not None:
        raise ConfigError("--shoot: it sets the angles of the views itself; leave --angle and --poses out")
    elif rig is not None:
        from slrig.cli.model_shoot import views_here

        files, start, notes = views_here(rig, shoot, output, manual=manual, axis=stated, found=found)
        output /= "model"
    else:
        from slrig.cli.model_shoot import views_there

        request = given(
            views=shoot, manual=manual, poses=None if found is None else found.kind, dictionary=dictionary,
            axis=None if stated is None else asdict(stated), start_error_mm=start_error_mm, voxel_mm=voxel_mm,
            cut=not no_cut,
        )  # fmt: skip
        with service.client() as client:
            views_there(client, request, output)
        _print_all(json.loads((output / REPORT).read_bytes()), output)
        return
    read = [each for each in (axis, poses, turntable) if each and each.name != POSES]
    _require_apart(output, [*files.values(), *read])
    with staged_folder(output, REPORT_FORMAT) as folder, progress_shown() as display:
        from slrig.model_jobs.combining import combine_into

        planes = () if no_cut else known.planes
        combine_into(
            files, folder, start, Listener(report=display), start_error_mm=start_error_mm, voxel_mm=voxel_mm,
            planes=planes, notes=notes,
        )  # fmt: skip
        report = json.loads((folder / REPORT).read_bytes())
    _print_all(report, output)


def _print_all(report: Mapping[str, Any], output: Path) -> None:
    from slrig.model_jobs.plan import MEDIA_TYPES

    _print_alignment(report)
    _print_fused(report["model"])
    for note in report["notes"]:
        typer.echo(f"{'note':<10}{note}")
    for name in MEDIA_TYPES:
        typer.echo(f"{name:<12}{output / name}")


def _print_fused(of: Mapping[str, Any]) -> None:
    once = of["seen_by"].get(1, 0.0)
    typer.echo(
        f"{'mesh':<10}{of['vertices']:,} vertices, {of['triangles']:,} triangles of {of['voxel_mm']:.2g} mm; σ "
        f"{of['sigma_mm']:.4f} mm; neighbours in one view err alike by {of['correlated_mm']:.4f} mm; {once:.0%} seen "
        "by one view only"
    )


def _print_alignment(report: Mapping[str, Any]) -> None:
    from rich.table import Column

    from slrig.cli.display import counted, print_table

    rows = []
    for number, view in enumerate(report["views"]):
        pairs = [pair for pair in report["pairs"] if view["name"] in (pair["first"], pair["second"])]
        weight = sum(pair["overlap"] for pair in pairs)
        rms, over, closure = (
            math.sqrt(sum(pair["overlap"] * pair[what] ** 2 for pair in pairs) / weight)
            for what in ("rms_mm", "rms_over_sigma", "closure_mm")
        )
        rows.append(
            (view["name"], f"{view['vertices']:,}", str(len(pairs)), f"{max(each['overlap'] for each in pairs):.0%}",
             f"{rms:.4f} mm", f"{over:.2f}", f"{closure:.4f} mm",
             f"{view['sigma_mm']:.4f} mm" if number else "the frame")
        )  # fmt: skip
    figures = ("vertices", "overlaps", "most", "residual", "over σ", "closure", "σ of pose")
    print_table((Column("view", overflow="fold"), *(Column(each, justify="right") for each in figures)), rows)
    removed = [sum(each["share"] for each in view["removed"]) for view in report["views"] if view["removed"]]
    if removed:
        typer.echo(
            f"{'cut':<10}{min(removed):.0%} to {max(removed):.0%} of the views lay behind the turntable's planes"
        )
    holds = "held as the start has it" if report["markers"] is None else "held by the markers"
    for kind in dict.fromkeys(each["motion"] for each in report["free"]):
        mine = [each for each in report["free"] if each["motion"] == kind]
        who = counted(len({each["view"] for each in mine}), "view")
        limits_mm = [each["free_mm"] for each in mine if each["free_mm"] is not None]
        far = f"by {min(limits_mm):.2g} mm and more" if limits_mm else "without a limit"
        typer.echo(f"{'free':<10}{who} may {mine[0]['words']} {far}: no surface prevents it, {holds}")
    if (marked := report["markers"]) is not None:
        counts = [len(each["used"]) for each in marked]
        sigma_mm = max(each["sigma_mm"] for each in marked)
        typer.echo(f"{'markers':<10}{min(counts)} to {max(counts)} of a view put it to {sigma_mm:.4f} mm or better")
        for each in marked:
            for off in each["left_out"]:
                typer.echo(
                    f"{'left out':<10}marker {off['marker']} in {each['view']}, {off['off_mm']:.2g} mm off: it moved "
                    "or was misread"
                )
    if (turned := report["axis"]) is not None:
        x, y, z = turned["point_mm"]
        a, b, c = turned["direction"]
        sigma_deg = math.degrees(turned["direction_sigma_rad"])
        worst = max(map(abs, turned["turntable_error_deg"]))
        typer.echo(
            f"{'axis':<10}through ({x:.3f}, {y:.3f}, {z:.3f}) mm ± {turned['point_sigma_mm']:.4f} mm, along "
            f"({a:.5f}, {b:.5f}, {c:.5f}) ± {sigma_deg:.4f}°; the turntable's angles are up to {worst:.3f}° off"
        )


def _starts(
    names: Sequence[str],
    angle: float | None,
    axis: StatedAxis | None,
    file: Path | None,
    found: StartingPoses | None,
) -> StartingPoses:
    """Start of the alignment. found : unknown, or by markers. Raises ConfigError: it is not given in exactly one way,
    or not for all scans.
    """
    from slrig.bundle import read_poses
    from slrig.model_jobs.plan import GivenPoses, TurntablePoses

    ways = [angle is not None, file is not None, found is not None]
    if sum(ways) != 1 or (angle is None) != (axis is None):
        ways_given = {
            "--angle": angle, "--axis, --axis-point or --turntable": axis, "--poses": file,
            "--unknown or --markers": found,
        }  # fmt: skip
        said = ", ".join(way for way, value in ways_given.items() if value is not None) or "none of them"
        message = (
            "expected a turntable's --angle with its axis (--turntable FILE, --axis FILE, or --axis-point and "
            f"--axis-direction), --poses FILE, --markers, or --unknown, found {said}. Where --unknown is refused, "
            "place the scans manually in another program, and write its poses into a file as "
            "slrig/multiview/README.md describes"
        )
        raise ConfigError(message)
    if found is not None:
        return found
    if file is None:
        return TurntablePoses(axis, tuple((angle or 0.0) * number for number in range(len(names))))
    known = read_poses(file).poses
    missing = [name for name in names if name not in known]
    if missing:
        message = f"{file}: expected a pose of every scan, found none of {', '.join(missing)}; there are: "
        raise ConfigError(message + (", ".join(known) or "none"))
    return GivenPoses.of(known[name] for name in names)


def _require_order(files: Mapping[str, Path], angle: float) -> None:
    """Raises ConfigError: the scans' own reports say that the turntable stood elsewhere, as where a shell has put
    view-10 before view-2.
    """
    from slrig.model_jobs.plan import turntable_angle
    from slrig.scan.artefacts import REPORT

    reports = [mesh.with_name(REPORT) for mesh in files.values()]
    recorded = [turntable_angle(report.read_bytes()) if report.is_file() else None for report in reports]
    stood = [turntable[0] for turntable in recorded if turntable is not None]
    off = [math.remainder(each - stood[0] - angle * number, 360.0) for number, each in enumerate(stood)]
    if len(stood) == len(files) and max(map(abs, off)) > _OFF_DEG:
        where = ", ".join(f"{name} at {each:g}°" for name, each in zip(files, stood, strict=True))
        message = (
            f"--angle {angle:g}: expected scans in the order in which the turntable turned, so far from one to the "
            f"next, "
            f"found by their own reports {where}. Name them in that order, or the folder that they lie in"
        )
        raise ConfigError(message)


def _axis(file: Path | None, point: Vector | None, direction: Vector | None) -> StatedAxis | None:
    """The stated axis. Raises ConfigError: it is given twice, by half, without a length, or `file` has none."""
    from slrig.bundle import read_poses
    from slrig.model_jobs.plan import StatedAxis

    if (point is None) != (direction is None) or (file is not None and point is not None):
        raise ConfigError("expected --axis FILE, or --axis-point X Y Z and --axis-direction X Y Z together")
    if file is not None:
        axis = read_poses(file).axis
        if axis is None:
            raise ConfigError(f"{file}: expected the key axis, with point_mm and direction, found none; write it there")
        return StatedAxis.of(*axis)
    return None if point is None or direction is None else StatedAxis(point, direction)


def _require_apart(output: Path, read: Sequence[Path]) -> None:
    """Raises ConfigError: the folder to write, which replaces an earlier one, holds what is read."""
    inside = next((file for file in read if file.resolve().is_relative_to(output.resolve())), None)
    if inside is not None:
        raise ConfigError(f"--output {output}: {inside} lies in it and would be replaced; name another folder")


def _named_meshes(paths: Sequence[Path]) -> dict[str, Path]:
    """The mesh.ply of each argument, by the scan's name, in the given order; those of a folder in natural order.

    Raises ConfigError: there is none, fewer than two, or two of one name.
    """
    from slrig.bundle import natural_sort_key
    from slrig.cli.reconstruct import matching
    from slrig.scan.artefacts import MESH

    found: list[tuple[str, Path]] = []
    for path in (each for one in paths for each in matching(one)):
        inside = [path / MESH] if (path / MESH).is_file() else sorted(path.glob(f"*/{MESH}"), key=natural_sort_key)
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


turntable_app = typer.Typer(no_args_is_help=True, help="A turntable's axis, its plate and the background.")


@turntable_app.command(cls=SubjectsCommand)
@grouped
def shoot(
    *,
    board_options: BoardArguments,
    first_deg: Annotated[float, typer.Option(help="Angle of the first shot.")] = -50.0,
    step_deg: Annotated[float, typer.Option(min=1.0, max=180.0, help="Turned by so much from shot to shot.")] = 20.0,
    count: Annotated[int, typer.Option(min=3, max=72, help="Shots. The cameras must see the board in them.")] = 6,
    exposure_s: Annotated[float | None, typer.Option(help="Exposure of every camera, seconds.")] = None,
    service: ServiceOptions,
) -> None:
    """Turn a board by a running service, and measure the axis.

    The board is on the turntable; scans and models use the axis from then on.
    """
    from slrig.cli.calibrate_local import chosen_board
    from slrig.cli.calibrate_walk import board_request
    from slrig.cli.display import progress_shown
    from slrig.errors import ServiceError

    with service.client() as client:
        job = client.turntable.shoot(
            board=board_request(chosen_board(board_options)), first_deg=first_deg, step_deg=step_deg, count=count,
            exposure_s=exposure_s,
        )  # fmt: skip
        with progress_shown() as display:
            try:
                job = client.examinations.wait(job["id"], display)
            except KeyboardInterrupt:
                client.examinations.cancel(job["id"])
                raise
    if job["error"] is not None:
        raise ServiceError(job["error"]["detail"])
    found = job["summary"]
    _print_poses(
        [(each["name"], each["angle_deg"], each["error_deg"], each["residual_mm"]) for each in found["poses"]],
        found["refused"],
    )
    axis = found["axis"]
    _print_axis(axis["point_mm"], axis["direction"], axis["point_sigma_mm"], axis["direction_sigma_deg"])


def _print_poses(poses: Sequence[tuple[str, float, float | None, float]], refused: Mapping[str, str]) -> None:
    """Print name, angle, error of the angle and residual of each pose, and why others were left out."""
    from rich.table import Column

    from slrig.cli.display import print_table

    rows = [
        (name, f"{angle_deg:.3f}°", "" if error_deg is None else f"{error_deg:.3f}°", f"{left_mm:.4f} mm")
        for name, angle_deg, error_deg, left_mm in poses
    ]
    heads = (Column(each, justify="right") for each in ("angle", "off", "residual"))
    print_table((Column("pose", overflow="fold"), *heads), rows)
    for name, cause in refused.items():
        typer.echo(f"{'left out':<10}{name}: {cause}")


def _print_axis(
    point_mm: Sequence[float], direction: Sequence[float], point_sigma_mm: float, direction_sigma_deg: float
) -> None:
    (x, y, z), (a, b, c) = point_mm, direction
    typer.echo(
        f"{'axis':<10}through ({x:.3f}, {y:.3f}, {z:.3f}) mm ± {point_sigma_mm:.4f} mm, along "
        f"({a:.5f}, {b:.5f}, {c:.5f}) ± {direction_sigma_deg:.4f}°"
    )


@turntable_app.command()
@grouped
def axis(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Bundles of a board on the turntable, one per angle.")
    ],
    board_options: BoardArguments,
    calibration: Annotated[Path, typer.Option(metavar="FILE", help="The calibration of the rig.")],
    output: Annotated[
        Path, typer.Option(metavar="FILE", help="The turntable's file. One that is there keeps its planes.")
    ],
    angle: Annotated[
        float | None, typer.Option(metavar="DEG", help="The turntable turned by so much from bundle to bundle.")
    ] = None,
) -> None:
    """Find the axis from a board that was turned.

    Three poses or more, best six all around, at least 20° in all. Without --angle the axis points up in the first
    camera's picture.
    """
    import math

    from slrig.bundle import AxisSource, read_calibration, write_file
    from slrig.cli.calibrate_local import chosen_board, pose_bundles
    from slrig.cli.display import progress_shown
    from slrig.cli.reconstruct import keep_kernels
    from slrig.errors import PatternError, PoseRefusedError
    from slrig.logs import set_up_console_logs

    set_up_console_logs()
    bundles, board, rig, before = (
        pose_bundles(folder),
        chosen_board(board_options),
        read_calibration(calibration),
        _known(output),
    )
    keep_kernels()
    with progress_shown() as display:
        from slrig.bundle import encode_turntable
        from slrig.calibrate.pose_reading import axis_of_poses, read_pose
        from slrig.model_jobs.turntable import with_axis

        read, angles, refused = [], [], {}
        for number, (name, bundle) in enumerate(bundles.items()):
            display(f"reading {name}", number / len(bundles), f"{number + 1} of {len(bundles)}")
            try:
                read.append(read_pose(bundle, board, name).observation)
                angles.append((angle or 0.0) * number)
            except (PoseRefusedError, PatternError) as error:
                refused[name] = str(error)
        found = axis_of_poses(read, board, rig, None if angle is None else angles, refused=refused)
        record = with_axis(before, found.axis.measured_axis, source=AxisSource.BOARD, of=folder.absolute().name)
        write_file(output, encode_turntable(record))
        display("done", 1.0, "")
    poses = [
        (name, found.angles_deg[name], found.errors_deg.get(name), left) for name, left in found.residual_mm.items()
    ]
    _print_poses(poses, refused)
    sigma_deg = math.degrees(found.axis.direction_sigma_rad)
    _print_axis(found.axis.point_mm.tolist(), found.axis.direction.tolist(), found.axis.point_sigma_mm, sigma_deg)
    last = record.history[-1]
    if last.moved_mm is not None:
        typer.echo(
            f"{'moved':<10}by {last.moved_mm:.3f} mm and {last.moved_deg:.3f}°, {last.sigmas:.1f} σ, since before"
        )
    typer.echo(f"{'turntable':<11}{output}")


@turntable_app.command()
def planes(
    scan: Annotated[
        Path, typer.Argument(metavar="SCAN", help="A scan of the empty turntable: its folder, or its mesh.ply.")
    ],
    turntable: Annotated[
        Path, typer.Option(metavar="FILE", help="The turntable's file, to which the planes are added.")
    ],
) -> None:
    """Find plate and backdrops in a scan of the empty turntable.

    The plate is what is square to the axis. Planes of an earlier scan are replaced.
    """
    from dataclasses import replace

    from slrig.bundle import encode_turntable, write_file
    from slrig.cli.display import print_table
    from slrig.cli.reconstruct import keep_kernels
    from slrig.scan.artefacts import MESH

    before = _known(turntable)
    keep_kernels()
    from slrig.model_jobs.combining import planes_in

    found = planes_in(scan / MESH if scan.is_dir() else scan, before.axis)
    write_file(turntable, encode_turntable(replace(before, planes=found)))
    rows = [
        (str(each.kind), "({:.1f}, {:.1f}, {:.1f}) mm".format(*each.point_mm),
         "({:.4f}, {:.4f}, {:.4f})".format(*each.normal), f"{each.radius_mm:.0f} mm", f"{each.sigma_mm:.3f} mm",
         f"{each.margin_mm:.2f} mm")
        for each in found
    ]  # fmt: skip
    print_table(("plane", "middle", "normal", "radius", "σ", "margin"), rows)
    typer.echo(f"{'turntable':<11}{turntable}")


def _known(file: Path) -> TurntableRecord:
    """The present content of the file. Raises ConfigError: it is damaged, and is left as it is."""
    from slrig.bundle import TurntableRecord, read_turntable

    return read_turntable(file) if file.exists() else TurntableRecord()

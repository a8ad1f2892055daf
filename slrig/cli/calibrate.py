"""`slrig calibrate`: print a board, walk through its poses, solve them, and manage the calibrations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlencode

import typer

from slrig.cli.options import (
    AsJson,
    BoardArguments,
    Keys,
    RigOption,
    RobotOptions,
    ServiceOptions,
    SubjectsCommand,
    Unit,
    by_beginning,
    given,
    grouped,
)
from slrig.errors import CalibrationNotFoundError, ConfigError, ServiceError

if TYPE_CHECKING:
    from slrig.client import Client

app = typer.Typer(
    no_args_is_help=True,
    help="Calibrate a rig, and say in millimetres how good it is.",
    epilog="Start with: slrig calibrate board, then slrig calibrate run.",
)

FILES = {
    ".json": "calibration.json",
    ".yml": "calibration.yml",
    ".yaml": "calibration.yml",
    ".xml": "calibration.xml",
    ".html": "report.html",
}
"""Content of an exported file, by its ending."""

_ID_HELP = "Id of the calibration, or its beginning, unless others share it."
CalibrationId = Annotated[str, typer.Argument(metavar="ID", help=_ID_HELP)]
Shape = Annotated[
    Literal["auto", "flat", "bowed"],
    typer.Option(
        "--board-shape",
        help="flat: it is, for certain, as on glass; bowed: solve for its bend; auto: bowed if held-out poses say so.",
    ),
]


@app.command()
@grouped
def board(
    output: Annotated[Path, typer.Option(help="File for the page: .pdf or .svg.")],
    board_options: BoardArguments,
    page: Annotated[
        str, typer.Option(help="A4, A3, letter; fit, as large as the board needs; or WIDTHxHEIGHT in mm.")
    ] = "A4",
) -> None:
    """Write a board to print, in true size, with scales.

    The scales show whether the printer kept the size.
    """
    from slrig.cli.calibrate_local import chosen_board, write_board

    write_board(chosen_board(board_options), output, page=page)


@app.command(cls=SubjectsCommand)
@grouped
def solve(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder with one bundle per pose, each a folder with bundle.json."),
    ],
    output: Annotated[Path, typer.Option(help="File for the calibration: .json, or OpenCV's .yml or .xml.")],
    board_options: BoardArguments,
    board_shape: Shape = "auto",
    report: Annotated[Path | None, typer.Option(help="Write the report, one HTML page with pictures, as well.")] = None,
    earlier: Annotated[
        Path | None, typer.Option(help="Calibration of the same rig: is the board's size what it was then?")
    ] = None,
    tolerance_mm: Annotated[
        float | None,
        typer.Option(
            min=1e-4, max=1000.0, help="What a point may be wrong by, mm. Default: 1/2000 of the volume's diagonal."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate from recorded poses. Needs no service and no rig."""
    from slrig.calibration import BoardShape
    from slrig.cli.calibrate_local import chosen_board, solve_folder

    shape = BoardShape(board_shape)
    solve_folder(
        folder,
        chosen_board(board_options),
        output,
        report=report,
        earlier=earlier,
        board_shape=shape,
        tolerance_mm=tolerance_mm,
        as_json=as_json,
    )


@app.command(cls=SubjectsCommand)
@partial(
    grouped,
    subjects={
        "Board": "board_shape", "Session": "resume label cameras_alone exposure_s",
        "By the rig's positioner": "scripted position activate", "Service": "rig data",
    },
)  # fmt: skip
def run(
    *,
    board_options: BoardArguments,
    board_shape: Shape = "auto",
    cameras_alone: Annotated[
        bool, typer.Option("--cameras-alone", help="Calibrate cameras, or one, without the projector: light is white.")
    ] = False,
    resume: Annotated[str | None, typer.Option("--id", help="Take up a session again that was left.")] = None,
    scripted: Annotated[
        bool,
        typer.Option("--scripted", help="Have the rig's positioner take its poses one after the other, and solve."),
    ] = False,
    position: Annotated[
        list[str] | None, typer.Option(help="With --scripted: a pose of the positioner, by name; may be repeated.")
    ] = None,
    activate: Annotated[bool, typer.Option("--activate", help="With --scripted: have scans use the result.")] = False,
    label: Annotated[str | None, typer.Option(help="Free text, to find the calibration again.")] = None,
    exposure_s: Annotated[
        float | None, typer.Option(help="Exposure of every camera, seconds. Default: as the rig file says.")
    ] = None,
    service: ServiceOptions,
    rig: RigOption = None,
    data: Annotated[
        Path | None, typer.Option(help="With --rig: folder of calibrations and scans. Default: that of slrig serve.")
    ] = None,
) -> None:
    """Walk through a calibration with a running service.

    Shoot, read what to move and why, and solve.
    """
    from slrig.cli.calibrate_local import chosen_board
    from slrig.cli.calibrate_walk import opened, walk
    from slrig.cli.scan import client_of
    from slrig.config import read_settings

    chosen = chosen_board(board_options) if resume is None else None
    kept = None if rig is None else read_settings(None, **given(data_dir=data)).data_dir
    with client_of(rig, service, kept) as client:
        walk(
            client,
            client.get(_path(client, str(resume)))
            if chosen is None
            else opened(client, chosen, label=label, projector=not cameras_alone),
            scripted=scripted,
            positions=position or (),
            activate=activate,
            exposure_s=exposure_s,
            board_shape=board_shape,
        )


@app.command(cls=SubjectsCommand)
@grouped
def hand_eye(
    poses: Annotated[
        Path,
        typer.Argument(
            metavar="POSES", help="Poses of the flange in the base: CSV or JSON with names for its numbers, ROS's YAML."
        ),
    ],
    seen: Annotated[
        Path,
        typer.Argument(
            metavar="SEEN",
            help="A folder with a bundle (with --sphere: a scan) per pose; or poses of a body in the rig.",
        ),
    ],
    board_options: BoardArguments,
    robot: RobotOptions,
    mounting: Annotated[
        Literal["in-hand", "fixed"] | None,
        typer.Option(
            "--kind", help="in-hand: the rig is on the flange; fixed: it does not move, the robot holds the target."
        ),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of the rig. Default: that of the first bundle.")
    ] = None,
    sphere: Annotated[float | None, typer.Option(help="The target is a sphere of this diameter, mm.")] = None,
    output: Annotated[Path | None, typer.Option(help="File for the result, hand_eye.json.")] = None,
    check: Annotated[
        Path | None, typer.Option(help="A hand_eye.json to check by the poses, instead of solving: did it drift?")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Store the result in a running service for its scans.")] = False,
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Find where the rig is on a robot, or in front of it.

    The robot shows the rig a board or a sphere, or shows a fixed one to the rig, in 12 poses that turn about two axes.
    """
    from slrig.cli.hand_eye import check_poses, observed_by_rig, solve_poses

    if (check is None) == (mounting is None) or (output is None) == (check is None):
        raise ConfigError("expected --kind and --output to solve, or --check FILE alone to check; give one of the two")
    given, identifier = observed_by_rig(poses, seen, robot.rotation, board_options, calibration, sphere)
    if check is not None:
        if not check_poses(given, identifier, check, as_json=as_json):
            raise typer.Exit(1)
        return
    document = solve_poses(given, identifier, str(mounting), robot, Path(str(output)), as_json=as_json)
    if keep:
        with service.client() as client:
            client.hand_eye.put(document)


@app.command(name="list")
@grouped
def list_stored(service: ServiceOptions, as_json: AsJson = False) -> None:
    """List the calibrations that a service keeps, from new to old."""
    from rich.table import Column
    from rich.text import Text

    from slrig.cli.display import print_json, print_table

    with service.client() as client:
        found = client.get("/calibration")
    if as_json:
        print_json(found)
        return
    if not found["calibrations"]:
        typer.echo("no calibrations; shoot one with: slrig calibrate run")
        return
    heads = [*(Column(head, no_wrap=True) for head in ("id", "", "when", "poses", "label")), Column("verdict")]
    rows = [
        (
            each["id"][:8],
            Text("in use" if each["active"] else "", style="green"),
            f"{datetime.fromisoformat(each['solved_at'] or each['created_at']).astimezone():%Y-%m-%d %H:%M}",
            "" if each["imported"] else str(each["poses"]),
            each["label"] or "",
            each["verdict"] or ("imported" if each["imported"] else each["state"]),
        )
        for each in found["calibrations"]
    ]
    print_table(heads, rows)
    if found["active"] is None:
        typer.secho("Scans use the rig's own calibration.", dim=True)


@app.command()
@grouped
def show(calibration: CalibrationId, service: ServiceOptions, as_json: AsJson = False) -> None:
    """Show the quality of a calibration, or what its poses still lack."""
    from slrig.cli.calibrate_walk import print_session
    from slrig.cli.display import print_json

    with service.client() as client:
        session = client.get(_path(client, calibration))
    (print_json if as_json else print_session)(session)


@app.command()
@grouped
def check(
    poses: Annotated[
        str, typer.Argument(metavar="FOLDER_OR_ID", help="Folder with one bundle per pose, or a calibration's id.")
    ],
    board_options: BoardArguments,
    board_shape: Shape = "auto",
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Check the stated error by odd against even poses.

    They are solved apart and compared, in mm: a folder's here and now, by a service with every solve.
    """
    if Path(poses).is_dir():
        from slrig.calibration import BoardShape
        from slrig.cli.calibrate_local import check_folder, chosen_board

        check_folder(Path(poses), chosen_board(board_options), board_shape=BoardShape(board_shape), as_json=as_json)
        return
    from slrig.cli.calibrate_walk import checked, print_check
    from slrig.cli.display import print_json

    with service.client() as client:
        session = client.get(_path(client, poses))
    if session["result"] is None:
        message = f"Calibration {session['id'][:8]} has no solve to check: it is {_unsolved(session)}."
        raise ServiceError(message)
    (print_json if as_json else print_check)(checked(session["result"]))


@app.command()
@grouped
def compare(
    first: Annotated[str, typer.Argument(metavar="FIRST", help=_ID_HELP)],
    second: Annotated[str, typer.Argument(metavar="SECOND", help="Id of the one to compare it with.")],
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Compare two calibrations, and say by how much points move.

    Shows the differences of the second one from the first.
    """
    from slrig.cli.calibrate_walk import print_comparison
    from slrig.cli.display import print_json

    with service.client() as client:
        ids = f"first={_whole_id(client, first)}&second={_whole_id(client, second)}"
        found = client.get(f"/calibration/compare?{ids}")
    (print_json if as_json else print_comparison)(found)


@app.command()
@grouped
def light(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="Scan of a plain white board: its bundle.")],
    output: Annotated[Path, typer.Option(help="File for the calibration with the light: .json.")],
) -> None:
    """Measure the projector's light over its image, for colours.

    The board is flat, white and dull, fills the image, and is scanned alone. Import the result, and activate it.
    """
    from slrig.bundle import write_calibration
    from slrig.cli.display import progress_shown
    from slrig.cli.reconstruct import prepare_kernels
    from slrig.scan.reconstruct import with_light_map

    with progress_shown() as display:
        prepare_kernels(display)
        found = with_light_map(bundle, display)
    write_calibration(output, found)
    typer.echo(f"{'written':<10}{output}")


@app.command()
@grouped
def refine(
    calibration: Annotated[Path, typer.Argument(metavar="CALIBRATION", help="File of a calibration with its errors.")],
    bundles: Annotated[
        list[Path], typer.Argument(metavar="BUNDLE", help="Scans by columns and rows: bundles, or folders of such.")
    ],
    output: Annotated[Path, typer.Option(help="File for the improved calibration: .json.")],
) -> None:
    """Improve a calibration by ordinary scans.

    Refused where they contradict it, as after a device was moved. Scans that the calibration was made of must not be
    among them. Import the result, and activate it.
    """
    from slrig.bundle import read_calibration, write_calibration
    from slrig.cli.display import progress_shown
    from slrig.cli.reconstruct import named_bundles, prepare_kernels
    from slrig.scan.measured import refine_by_scans

    prior, (found, _) = read_calibration(calibration), named_bundles(bundles)
    with progress_shown() as display:
        prepare_kernels(display)
        refined, lines = refine_by_scans(prior, found, display)
    for line in lines:
        typer.echo(line)
    write_calibration(output, refined)
    typer.echo(f"{'written':<10}{output}")


@app.command()
@grouped
def activate(calibration: CalibrationId, service: ServiceOptions) -> None:
    """Use a calibration for scans from now on."""
    with service.client() as client:
        found = client.post(f"{_path(client, calibration)}/activate", None)
    typer.echo(f"Scans use calibration {found['id'][:8]} from now on.")


@app.command()
@grouped
def deactivate(calibration: CalibrationId, service: ServiceOptions) -> None:
    """Use the rig's own calibration for scans again."""
    with service.client() as client:
        client.post(f"{_path(client, calibration)}/deactivate", None)
    typer.echo("Scans use the rig's own calibration again.")


@app.command()
@grouped
def export(
    calibration: Annotated[
        str | None, typer.Argument(metavar="ID_OR_FILE", help=f"{_ID_HELP} Or a file, or a folder as ROS has it.")
    ] = None,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="File to write: .json, OpenCV's .yml or .xml, or the report as .html."),
    ] = None,
    to: Annotated[
        Literal["slrig", "opencv", "ros", "kalibr"] | None,
        typer.Option(help="Format. ros: a new folder of camera_info and transforms. Default: by the ending."),
    ] = None,
    unit: Unit = None,
    keys: Keys = None,
    template: Annotated[
        Path | None,
        typer.Option(help="Write an empty calibration with explanations instead, to fill in: .json or .yml."),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(help="With --template: name of a camera; may be repeated. Default: cam0.")
    ] = None,
    *,
    service: ServiceOptions,
) -> None:
    """Write a calibration of a service, or a file, into a file.

    Reads files of any program; writes the forms of slrig, OpenCV, ROS and Kalibr.
    """
    if template is not None and calibration is None:
        from slrig.importers import write_template

        write_template(template, camera or ["cam0"])
        typer.echo(f"{'written':<10}{template}")
        typer.echo(f"Fill it in, then: slrig calibrate import {template}, or slrig import --calibration {template}")
        return
    if template is not None or calibration is None or file is None:
        raise ConfigError("expected ID_OR_FILE and FILE, or --template FILE alone; give one of the two")
    name = FILES.get(file.suffix.lower())
    if Path(calibration).exists() or to or unit or keys or name in ("calibration.yml", "calibration.xml"):
        import tempfile

        from slrig.importers import import_calibration, lost_in_format, write_any_calibration

        with tempfile.TemporaryDirectory() as folder:
            source = Path(calibration)
            if not source.exists():
                source = Path(folder) / "calibration.json"
                with service.client() as client:
                    _fetch(client, calibration, source.name, source)
            read = import_calibration(source, unit=unit, keys=keys or ())
        write_any_calibration(file, read.calibration, to)
        for note in read.notes:
            typer.echo(f"{'read':<10}{note}")
        for each in lost_in_format(read.calibration, file, to):
            typer.echo(f"{'left out':<10}{each}")
    else:
        if name is None:
            message = (
                f"{file}: expected a name that ends in .json (slrig's own), .yml or .xml (OpenCV's) or .html (the "
                f"report), found '{file.suffix}'"
            )
            raise ConfigError(message)
        with service.client() as client:
            _fetch(client, calibration, name, file)
    typer.echo(f"{'written':<10}{file}")


def _fetch(client: Client, calibration: str, name: str, file: Path) -> None:
    """Write a file of a calibration that a service keeps. Raises CalibrationNotFoundError, ServiceError."""
    session = client.get(_path(client, calibration))
    offered = session["links"]["files"]
    if name not in offered:
        has = f"It has: {', '.join(offered)}." if offered else f"It is {session['state']}; solve it first."
        message = f"Calibration {session['id'][:8]} has no {name}. {has}"
        raise ServiceError(message)
    client.fetch(offered[name], file)


@app.command(name="import")
@grouped
def submit(
    *,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="Calibration of any program: .json, .yml, .xml, .npz, .mat, or a folder, as ROS's."
        ),
    ],
    label: Annotated[str | None, typer.Option(help="Free text, to find the calibration again.")] = None,
    unit: Unit = None,
    keys: Keys = None,
    service: ServiceOptions,
) -> None:
    """Give a service a calibration that was found elsewhere."""
    import tempfile

    from slrig.bundle import write_calibration
    from slrig.importers import import_calibration

    with service.client() as client:
        # Read here first, so that faults name the file; it is sent in one format.
        read = import_calibration(file, unit=unit, keys=keys or ())
        for note in read.notes:
            typer.echo(f"{'read':<10}{note}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "calibration.json"
            write_calibration(path, read.calibration)
            document: Mapping[str, Any] = json.loads(path.read_bytes())
        query = "" if label is None else f"?{urlencode({'label': label})}"
        found = client.post(f"/calibration/import{query}", document)
    typer.echo(f"{'imported':<10}{found['id']}")
    typer.echo(f"To have scans use it: slrig calibrate activate {found['id'][:8]}")


def _unsolved(session: Mapping[str, Any]) -> str:
    return "imported, without its poses" if session["imported"] else f"{session['state']}; solve it first"


def _path(client: Client, beginning: str) -> str:
    return f"/calibration/{_whole_id(client, beginning)}"


def _whole_id(client: Client, beginning: str) -> str:
    """The id of the one calibration with this beginning. Raises CalibrationNotFoundError."""
    known = client.get("/calibration?limit=200")["calibrations"]
    none = "none; open one with: slrig calibrate run"
    return str(by_beginning(known, beginning, "calibration", CalibrationNotFoundError, none=none)["id"])

"""`slrig calibrate`: print a board, walk through its poses, solve them, and look after what came of it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from slrig.cli.options import USUAL_URL, AsJson, KeyFile, Url, client_of

app = typer.Typer(
    no_args_is_help=True,
    help="Calibrate a rig, and say in millimetres how good it is.",
    epilog="Start with: slrig calibrate board, then slrig calibrate run.",
)


class BoardName(StrEnum):
    """What is printed on the board."""

    CHARUCO = "charuco"
    CHESSBOARD = "chessboard"
    CIRCLES = "circles"


class ShapeName(StrEnum):
    """What a solve takes the board for."""

    AUTO = "auto"
    FLAT = "flat"
    BOWED = "bowed"


_ID_HELP = "Id of the calibration, or the beginning of it that no other has."
CalibrationId = Annotated[str, typer.Argument(metavar="ID", help=_ID_HELP)]
Kind = Annotated[BoardName | None, typer.Option("--board", help="What is printed on the board. Default: charuco.")]
Corners = Annotated[
    str | None,
    typer.Option(help="Inner corners across x down, as 11x8 (default); of circles, those of one row x rows."),
]
SquareMm = Annotated[
    float | None,
    typer.Option(
        help="Side of a square, mm, measured on the print (default 12); of circles, the distance of two rows."
    ),
]
MarkerMm = Annotated[
    float | None, typer.Option(help="Side of a marker of a ChArUco board, mm. Default: 0.75 of the square.")
]
Dictionary = Annotated[
    str | None, typer.Option(help="Markers of a ChArUco board, by OpenCV's name. Default DICT_5X5_250.")
]

Shape = Annotated[
    ShapeName,
    typer.Option(
        "--board-shape",
        help="flat: it is, for certain, as on glass; bowed: solve for its bend; auto: bowed if held-out poses say so.",
    ),
]


@app.command()
def board(
    output: Annotated[Path, typer.Option(help="File for the page: .pdf or .svg.")],
    kind: Kind = None,
    corners: Corners = None,
    square_mm: SquareMm = None,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = None,
    page: Annotated[
        str, typer.Option(help="A4, A3, letter; fit, as large as the board needs; or WIDTHxHEIGHT in mm.")
    ] = "A4",
) -> None:
    """Write a board to print, in true size, with scales.

    The scales show whether the printer kept the size.
    """
    from slrig.cli.calibrate_board import write_board

    write_board(chosen_board(kind, corners, square_mm, marker_mm, dictionary), output, page=page)


@app.command()
def solve(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder with one bundle per pose, each a folder with bundle.json."),
    ],
    output: Annotated[Path, typer.Option(help="File for the calibration: .json, or OpenCV's .yml or .xml.")],
    kind: Kind = None,
    corners: Corners = None,
    square_mm: SquareMm = None,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = None,
    board_shape: Shape = ShapeName.AUTO,
    report: Annotated[Path | None, typer.Option(help="Write the report, one HTML page with pictures, as well.")] = None,
    earlier: Annotated[
        Path | None, typer.Option(help="Calibration of the same rig: is the board's size what it was then?")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate from recorded poses. Needs no service and no rig."""
    from slrig.calibration.board import BoardShape
    from slrig.cli.calibrate_solve import solve_folder

    chosen = chosen_board(kind, corners, square_mm, marker_mm, dictionary)
    shape = BoardShape(board_shape.value)
    solve_folder(folder, chosen, output, report=report, earlier=earlier, board_shape=shape, as_json=as_json)


@app.command()
def run(
    kind: Kind = None,
    corners: Corners = None,
    square_mm: SquareMm = None,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = None,
    board_shape: Shape = ShapeName.AUTO,
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
    url: Url = USUAL_URL,
    key_file: KeyFile = None,
) -> None:
    """Walk through a calibration with a running service.

    Shoot, be told what to move and why, and solve.
    """
    from slrig.cli.calibrate_stored import whole_id
    from slrig.cli.calibrate_walk import opened, walk

    chosen = None if resume is not None else chosen_board(kind, corners, square_mm, marker_mm, dictionary)
    with client_of(url, key_file) as client:
        session = (
            opened(client, chosen, label=label, projector=not cameras_alone)
            if chosen is not None
            else client.get(f"/calibration/{whole_id(client, str(resume))}")
        )
        walk(
            client,
            session,
            scripted=scripted,
            positions=position or (),
            activate=activate,
            exposure_s=exposure_s,
            board_shape=board_shape.value,
        )


@app.command(name="list")
def list_stored(url: Url = USUAL_URL, key_file: KeyFile = None, as_json: AsJson = False) -> None:
    """List the calibrations that a service keeps, from new to old."""
    from slrig.cli.calibrate_stored import list_calibrations

    with client_of(url, key_file) as client:
        list_calibrations(client, as_json=as_json)


@app.command()
def show(calibration: CalibrationId, url: Url = USUAL_URL, key_file: KeyFile = None, as_json: AsJson = False) -> None:
    """Show how good a calibration is, or what its poses still lack."""
    from slrig.cli.calibrate_stored import show_calibration

    with client_of(url, key_file) as client:
        show_calibration(client, calibration, as_json=as_json)


@app.command()
def compare(
    first: Annotated[str, typer.Argument(metavar="FIRST", help=_ID_HELP)],
    second: Annotated[str, typer.Argument(metavar="SECOND", help="Id of the one to compare it with.")],
    url: Url = USUAL_URL,
    key_file: KeyFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare two calibrations, and say by how much points move.

    Tells what the second one says otherwise than the first.
    """
    from slrig.cli.calibrate_stored import compare_calibrations

    with client_of(url, key_file) as client:
        compare_calibrations(client, first, second, as_json=as_json)


@app.command()
def activate(calibration: CalibrationId, url: Url = USUAL_URL, key_file: KeyFile = None) -> None:
    """Have scans use a calibration from now on."""
    from slrig.cli.calibrate_stored import whole_id

    with client_of(url, key_file) as client:
        found = client.post(f"/calibration/{whole_id(client, calibration)}/activate", None)
    typer.echo(f"Scans use calibration {found['id'][:8]} from now on.")


@app.command()
def deactivate(calibration: CalibrationId, url: Url = USUAL_URL, key_file: KeyFile = None) -> None:
    """Have scans use the rig's own calibration again."""
    from slrig.cli.calibrate_stored import whole_id

    with client_of(url, key_file) as client:
        client.post(f"/calibration/{whole_id(client, calibration)}/deactivate", None)
    typer.echo("Scans use the rig's own calibration again.")


@app.command()
def export(
    calibration: CalibrationId,
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="File to write: .json, OpenCV's .yml or .xml, or the report as .html."),
    ],
    url: Url = USUAL_URL,
    key_file: KeyFile = None,
) -> None:
    """Write a calibration that a service keeps into a file."""
    from slrig.cli.calibrate_stored import export_calibration

    with client_of(url, key_file) as client:
        export_calibration(client, calibration, file)


@app.command(name="import")
def submit(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Calibration: slrig's .json, or OpenCV's .yml or .xml.")],
    label: Annotated[str | None, typer.Option(help="Free text, to find the calibration again.")] = None,
    url: Url = USUAL_URL,
    key_file: KeyFile = None,
) -> None:
    """Give a service a calibration that was found elsewhere."""
    from slrig.cli.calibrate_stored import import_calibration

    with client_of(url, key_file) as client:
        import_calibration(client, file, label=label)


def chosen_board(
    kind: BoardName | None,
    corners: str | None,
    square_mm: float | None,
    marker_mm: float | None,
    dictionary: str | None,
) -> Any:
    """See `slrig.cli.board_options.chosen_board`, which loads numpy."""
    from slrig.cli import board_options

    return board_options.chosen_board(None if kind is None else kind.value, corners, square_mm, marker_mm, dictionary)

"""`slrig import`: captures of other programs become bundles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from slrig.cli.options import Keys, Unit
from slrig.errors import ConfigError


def import_images(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="Folder of images, of one camera or with a subfolder for each; or a TIFF, .npy, .npz or video of all.",
        ),
    ],
    output: Annotated[Path, typer.Option(help="The bundle to write: a new folder.")],
    projector: Annotated[str, typer.Option(help="Columns x rows of the projector, as 1024x768.")],
    program: Annotated[
        Literal["opencv", "scan3d", "slstudio"] | None,
        typer.Option("--format", help="The program whose order numbered images have. Default: opencv."),
    ] = None,
    pattern: Annotated[
        str | None,
        typer.Option(
            metavar="WORDS",
            help="Order of numbered images: white, black, columns, rows (each bit with its inverse, the most "
            "significant first), columns-plain, rows-plain (without inverses).",
        ),
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of images, as '{axis}_{bit:02}_{inverted}.png': fields axis, bit (0 the most significant) or "
            "power (0 the least), inverted, camera.",
        ),
    ] = None,
    white: Annotated[
        str | None, typer.Option(metavar="TEMPLATE", help="With --names: name of the white image.")
    ] = None,
    black: Annotated[
        str | None, typer.Option(metavar="TEMPLATE", help="With --names: name of the black image.")
    ] = None,
    listed: Annotated[
        Path | None,
        typer.Option(
            "--list",
            metavar="FILE",
            help="CSV of file, pattern, camera: white, 'column 3', 'row 0 inverted', 'column line 2 of 8 width 1'.",
        ),
    ] = None,
    cell_px: Annotated[int, typer.Option(min=1, help="Width of the finest Gray cell, projector pixels.")] = 1,
    offset_px: Annotated[int, typer.Option(min=0, help="Added to a position before it is cut into cells.")] = 0,
    camera: Annotated[
        list[str] | None, typer.Option(help="Name of a camera, in the order of their folders; may be repeated.")
    ] = None,
    bit_depth: Annotated[
        int | None, typer.Option(min=1, max=16, help="Bits of a sample, right-aligned. Default: found in the images.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration to put into the bundle, a file of any program or a folder of them. Default: "
            "FOLDER/calibration.yml, .xml, .json, .npz, .mat."
        ),
    ] = None,
    unit: Unit = None,
    keys: Keys = None,
) -> None:
    """Make a bundle of another program's images.

    Gray codes of OpenCV, scan3d-capture and SLStudio, or of named images. Then: slrig reconstruct.
    """
    from slrig.importers import ImageNaming, ProjectorCode, import_capture, parse_size

    ways = {"--format": program, "--pattern": pattern, "--names": names, "--list": listed}
    asked = [way for way, value in ways.items() if value is not None]
    if len(asked) > 1 or ((white or black) and names is None):
        message = f"expected one of {', '.join(ways)}, and --white and --black with --names, found {', '.join(asked)}"
        raise ConfigError(message)
    if program in ("scan3d", "slstudio") and (cell_px, offset_px) != (1, 0):
        message = (
            f"--format {program}: expected no --cell-px and --offset-px, which its order says itself; say --pattern"
        )
        raise ConfigError(message)
    naming = ImageNaming(program or (None if asked else "opencv"), pattern, names, white, black, listed)
    code = ProjectorCode(parse_size(projector), cell_px=cell_px, offset_px=offset_px)
    found, used = import_capture(
        folder,
        output,
        code,
        naming,
        names=camera or (),
        bit_depth=bit_depth,
        calibration_file=calibration,
        unit=unit,
        keys=keys or (),
    )
    for name, files in found.cameras.items():
        typer.echo(f"{'camera':<11}{name}: {len(files)} images, {files[0][0].name} to {files[-1][0].name}")
    for note in found.notes:
        typer.echo(f"{'taken':<11}{note}")
    for fault in found.faults:
        typer.echo(f"{'doubtful':<11}{fault}")
    if found.unassigned:
        some = ", ".join(found.unassigned[:5]) + (" …" if len(found.unassigned) > 5 else "")
        typer.echo(f"{'left out':<11}{len(found.unassigned)} images that no pattern is known of: {some}")
    typer.echo(f"{'bundle':<11}{output}")
    how = "" if used is not None else " --decode-only"
    typer.echo(f"{'calibrated':<11}{used or 'no: it can only be decoded'}")
    for note in found.calibration_notes:
        typer.echo(f"{'':<11}{note}")
    typer.echo(f"To go on: slrig reconstruct {output} --output {output.name}-mesh{how}")

"""`slrig import`: captures of other programs become bundles."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from slrig.cli.options import Keys, Unit
from slrig.errors import ConfigError

if TYPE_CHECKING:
    from slrig.importers import UnderstoodFolder


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
        Literal["opencv", "scan3d", "slstudio", "slstudio-micro"] | None,
        typer.Option("--format", help="The program whose order numbered images have. Default: opencv."),
    ] = None,
    pattern: Annotated[
        str | None,
        typer.Option(
            metavar="WORDS",
            help="Order of numbered images: white, black, columns, rows (each bit with its inverse, the most "
            "significant first), columns-plain, rows-plain (without inverses), columns-sine:PERIOD/STEPS.",
        ),
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of images, as '{axis}_{bit:02}_{inverted}.png': fields axis, bit (0 the most significant) or "
            "power (0 the least), inverted, camera; or '*_{number}_{camera}.png': * is anything, {number} the order, "
            "and the images tell their patterns.",
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
    cell_px: Annotated[
        int | None, typer.Option(min=1, help="Width of the finest Gray cell, projector pixels. Default: found, or 1.")
    ] = None,
    offset_px: Annotated[
        int | None, typer.Option(min=0, help="Added to a position before it is cut into cells. Default: found, or 0.")
    ] = None,
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
    yes: Annotated[bool, typer.Option("--yes", help="Take what was found in the images without a question.")] = False,
    save_list: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write what was found as a CSV file for --list.")
    ] = None,
) -> None:
    """Make a bundle of another program's images.

    The images themselves tell which Gray codes, lines and sinusoids they show; a picture beside the bundle shows what
    each was taken for. Or state the order of a program, or names. Then: slrig reconstruct.
    """
    from slrig.importers import ImageNaming, ProjectorCode, assign_images, import_capture, parse_size, write_list

    ways = {"--format": program, "--pattern": pattern, "--names": names, "--list": listed}
    asked = [way for way, value in ways.items() if value is not None]
    if len(asked) > 1 or ((white or black) and names is None):
        message = f"expected one of {', '.join(ways)}, and --white and --black with --names, found {', '.join(asked)}"
        raise ConfigError(message)
    if program is not None and program != "opencv" and (cell_px, offset_px) != (None, None):
        message = (
            f"--format {program}: expected no --cell-px and --offset-px, which its order says itself; say --pattern"
        )
        raise ConfigError(message)
    naming = ImageNaming(program, pattern, names, white, black, listed)
    code = ProjectorCode(parse_size(projector), cell_px=cell_px, offset_px=offset_px)
    found = assign_images(folder, code, naming)
    if save_list is not None:
        write_list(save_list, folder, found)
    if found.understood is not None:
        _propose(found.understood, output.with_name(f"{output.name}-sheet.png"), yes=yes)
    used = import_capture(
        folder, output, code, found, names=camera or (), bit_depth=bit_depth, calibration_file=calibration, unit=unit,
        keys=keys or (),
    )  # fmt: skip
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
    words = ["slrig", "reconstruct", str(output), "--output", f"{output.name}-mesh"]
    words += [] if used is not None else ["--decode-only"]
    typer.echo(f"{'calibrated':<11}{used or 'no: it can only be decoded'}")
    for note in found.calibration_notes:
        typer.echo(f"{'':<11}{note}")
    typer.echo(f"To go on: {shlex.join(words)}")


def _propose(found: UnderstoodFolder, sheet: Path, *, yes: bool) -> None:
    """Print and draw which pattern each image was found to show, and ask whether to go on.

    Raises ConfigError: there are doubts, and no terminal to ask at.
    """
    from slrig.cli.init import terminal
    from slrig.importers import write_contact_sheet

    write_contact_sheet(sheet, found)
    for fact in found.facts:
        typer.echo(f"{'found':<11}{fact}")
    for doubt in found.doubts:
        typer.echo(f"{'unsure':<11}{doubt}")
    typer.echo(f"{'look at':<11}{sheet}")
    if yes:
        return
    if terminal():
        if not typer.confirm("Take the images for this?", default=not found.doubts):
            raise typer.Exit(1)
    elif found.doubts:
        message = (
            f"it is unsure what the images show: {'; '.join(found.doubts)}. Look at {sheet}; if it is right, add "
            "--yes; otherwise describe the images by --format, --pattern, --names or --list"
        )
        raise ConfigError(message)

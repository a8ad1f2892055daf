"""slrig's commands and their exit codes: 0 well, 1 a defect of slrig, 2 something to be put right, 130 Ctrl-C.

`slrig conform` exits with 1 for a defect of a driver, `slrig doctor` for one of the rig, `slrig verify` for a stale
calibration, `slrig accept` for a test that is not passed, too.
"""

from __future__ import annotations

import atexit
import os
import shlex
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
import typer.core

from slrig.cli import calibrate, scans, schedule
from slrig.cli.live import live
from slrig.cli.loading import loading
from slrig.cli.model import model, turntable_app
from slrig.cli.options import (
    AcceptanceOptions,
    AsJson,
    BoardArguments,
    GuessOptions,
    Keys,
    MeshOptions,
    RigFile,
    RigHere,
    RigOption,
    ScanOptions,
    ServiceOptions,
    SubjectsCommand,
    Unit,
    given,
    grouped,
    period_option,
)
from slrig.cli.service import Data, backup, check, fleet, key_app, pool_app, restore, serve, worker
from slrig.errors import ConfigError, SlrigError
from slrig.examples import rig_path

if TYPE_CHECKING:
    from slrig.importers import UnderstoodFolder


def patterns(
    rig: RigFile,
    sequence: Annotated[
        Literal["fast", "standard", "robust", "phase"] | None,
        typer.Option(help="If scans use another one than the rig file."),
    ] = None,
    period_px: Annotated[
        int | None, typer.Option(help="Distance of two lines, or period of phase, if scans use another one.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Frames of a sinusoid, if scans use another number.")] = None,
    line_width_px: Annotated[int | None, typer.Option(help="Width of a line, if scans use another one.")] = None,
    gray_cell_px: Annotated[
        int | None, typer.Option(help="Width of the finest Gray cell, if scans use another one.")
    ] = None,
) -> None:
    """Write the patterns that a projector must hold.

    For trigger boxes and light engines: all that scans, calibration, verification and the doctor show, each once.
    """
    changed = given(
        sequence=sequence, line_width_px=line_width_px, gray_cell_px=gray_cell_px, sine_steps=steps,
        **period_option(sequence, period_px),
    )  # fmt: skip
    typer.echo(written_patterns(rig, changed))


def written_patterns(rig_file: Path, changed: Mapping[str, object]) -> str:
    """Make the rig's projector write all of its patterns, and return what to do with the files.

    changed : patterns of scans, as far as they differ from the rig file's. Scans of either axis can be played, before
    and after a calibration. Raises UnsupportedByDeviceError where the projector shows any pattern; as opening the rig
    and writing.
    """
    from dataclasses import replace

    from slrig.api.schemas import PatternRequest, ScanRequest, scan_plan
    from slrig.calibrate.store import USUAL_PATTERNS
    from slrig.config import read_rig
    from slrig.devices import StoredPatternProjector
    from slrig.discovery import open_rig
    from slrig.doctor import doctor_sequence
    from slrig.errors import UnsupportedByDeviceError
    from slrig.logs import set_up_console_logs
    from slrig.patterns import merge_sequences
    from slrig.scan.plan import pattern_sequence

    set_up_console_logs()
    config = read_rig(rig_file)
    request = ScanRequest(patterns=PatternRequest.model_validate(changed))
    with open_rig(config) as rig:
        projector = rig.projector
        if not isinstance(projector, StoredPatternProjector):
            message = f"the projector of rig '{rig.name}' ({projector.info.model}) shows any pattern: nothing to flash"
            raise UnsupportedByDeviceError(message)
        size = projector.info.size
        scans = replace(scan_plan(request, config.scan).patterns, rows=True)
        sequences = (pattern_sequence(scans, size), pattern_sequence(USUAL_PATTERNS, size), doctor_sequence(size))
        return projector.write_patterns(merge_sequences(sequences))


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
        typer.Option("--format", help="The program that set the order of numbered images. Default: opencv."),
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
            "and the images show their patterns.",
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

    The Gray codes, lines and sinusoids are recognised in the images; a picture next to the bundle shows the result for
    each. Or state the order of a program, or names. Then: slrig reconstruct.
    """
    from slrig.importers import ImageNaming, ProjectorCode, assign_images, import_capture, parse_size, write_list

    ways = {"--format": program, "--pattern": pattern, "--names": names, "--list": listed}
    named = [way for way, value in ways.items() if value is not None]
    if len(named) > 1 or ((white or black) and names is None):
        message = f"expected one of {', '.join(ways)}, and --white and --black with --names, found {', '.join(named)}"
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
    command = ["slrig", "reconstruct", str(output), "--output", f"{output.name}-mesh"]
    command += [] if used is not None else ["--decode-only"]
    typer.echo(f"{'calibrated':<11}{used or 'no: it can only be decoded'}")
    for note in found.calibration_notes:
        typer.echo(f"{'':<11}{note}")
    typer.echo(f"To go on: {shlex.join(command)}")


def _propose(found: UnderstoodFolder, sheet: Path, *, yes: bool) -> None:
    """Print and draw the pattern recognised in each image, and ask whether to go on.

    Raises ConfigError: there are doubts, and no terminal for the question.
    """
    from slrig.cli.rig_file import terminal
    from slrig.importers import write_contact_sheet

    write_contact_sheet(sheet, found)
    for fact in found.facts:
        typer.echo(f"{'found':<11}{fact}")
    for doubt in found.doubts:
        typer.echo(f"{'unsure':<11}{doubt}")
    typer.echo(f"{'check':<11}{sheet}")
    if yes:
        return
    if terminal():
        if not typer.confirm("Take the images for this?", default=not found.doubts):
            raise typer.Exit(1)
    elif found.doubts:
        message = (
            f"it is unsure what the images show: {'; '.join(found.doubts)}. Check {sheet}; if it is right, add "
            "--yes; otherwise describe the images by --format, --pattern, --names or --list"
        )
        raise ConfigError(message)


INTERRUPTED = 130


class _Commands(typer.core.TyperGroup):
    """Ends every command that raises a SlrigError with its message on stderr and exit code 2."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except SlrigError as error:
            typer.secho("error: ", fg="red", bold=True, err=True, nl=False)
            typer.echo(str(error), err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"max_content_width": 120},
    help="Structured-light scanning: from a projector and cameras to a triangle mesh in millimetres.",
    epilog="Start with: slrig demo",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"slrig {version('slrig')}")
        raise typer.Exit


@app.callback()
def slrig(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options before any command; the text of `slrig --help` is `app`'s."""


@app.command()
def demo(
    rig: RigFile = Path("demo"),
    output: Annotated[Path, typer.Option(help="Folder for mesh, preview and report.")] = Path("scans/demo"),
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder for what the service keeps. Default: demo within ~/.local/share/slrig.", show_default=False
        ),
    ] = None,
    show: Annotated[bool, typer.Option("--open", help="Show the page at the result, until Ctrl-C.")] = False,
) -> None:
    """Scan once on a rendered rig, and compare with the truth.

    Goes through the real service, in a process of its own. Exit code 1 if a thousandth of the mesh's area or more is
    beyond 1 mm of the truth, or shows the cameras its back.
    """
    from slrig.cli.scan import run_demo

    run_demo(rig, output, data, show=show)


@app.command(cls=SubjectsCommand)
@partial(
    grouped,
    subjects={
        "Object and files": "label turn_deg manual output file force",
        "Light and colour": "exposure_s",
        "Patterns": "sequence period_px steps line_width_px gray_cell_px gray_only rows cross_lines",
        "When": "queue repeat every_s",
        "Service": "rig",
    },
)
def scan(
    *,
    label: Annotated[str | None, typer.Option(help="Free text, to find the scan again.")] = None,
    output: Annotated[
        Path | None, typer.Option(help="Folder for the files of the scan. Default: of its time, within scans.")
    ] = None,
    file: Annotated[
        list[str] | None,
        typer.Option(
            help="File to fetch, as mesh.obj or points-CAMERA.npz; may be repeated. "
            "Default: mesh.ply, preview.png, report.json."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files of an earlier scan in --output.")] = False,
    scan_options: ScanOptions,
    exposure_s: Annotated[
        list[float] | None,
        typer.Option(help="Exposure of every camera, seconds; repeated, a bracket for what is dark here, shiny there."),
    ] = None,
    sequence: Annotated[
        Literal["fast", "standard", "robust", "phase"] | None,
        typer.Option(
            help="Patterns: fewest frames; the usual ones; each bit with its inverse, for what reflects or is hollow; "
            "sinusoids in few frames. Default: the rig file's, or standard."
        ),
    ] = None,
    period_px: Annotated[
        int | None, typer.Option(help="Distance of two lines, or with --sequence phase the period, projector pixels.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="With --sequence phase: frames of each sinusoid.")] = None,
    line_width_px: Annotated[int | None, typer.Option(help="Width of a line, projector pixels.")] = None,
    gray_cell_px: Annotated[int | None, typer.Option(help="Width of the finest Gray cell, projector pixels.")] = None,
    gray_only: Annotated[bool, typer.Option("--gray-only", help="Play the Gray code without shifted lines.")] = False,
    rows: Annotated[
        bool, typer.Option("--rows", help="Play columns and rows. Default: the axis that the calibration needs.")
    ] = False,
    cross_lines: Annotated[
        bool,
        typer.Option("--cross-lines", help="Play one frame of lines along the other axis: it tests the calibration."),
    ] = False,
    mesh: MeshOptions,
    guesses: GuessOptions,
    queue: Annotated[bool, typer.Option("--queue", help="Wait in line if the rig is held.")] = False,
    repeat: Annotated[int, typer.Option(min=1, help="So many scans in a row, each into a folder of its number.")] = 1,
    every_s: Annotated[float | None, typer.Option(help="From the start of one to that of the next, seconds.")] = None,
    service: ServiceOptions,
    rig: RigOption = None,
) -> None:
    """Scan with a running service, and fetch the mesh."""
    from slrig.cli.scan import FILES, assisted, client_of, print_result, refuse_earlier, scan_with, series_with

    request = given(
        label=label,
        # One exposure time is one, several are a bracket.
        exposure_s=exposure_s[0] if exposure_s and len(exposure_s) == 1 else None,
        exposures_s=exposure_s if exposure_s and len(exposure_s) > 1 else None,
        if_busy="queue" if queue else "reject",
        **scan_options.request(),
        repeat=repeat if repeat > 1 else None,
        every_s=every_s,
        patterns=given(
            sequence=sequence, line_width_px=line_width_px, gray_cell_px=gray_cell_px, sine_steps=steps,
            **period_option(sequence, period_px), line_shift=False if gray_only else None, rows=rows or None,
            cross_lines=cross_lines or None,
        ),
        reconstruction={**mesh.request(), **given(uncalibrated=guesses.request())},
        robot_pose=mesh.flange(),
    )  # fmt: skip
    files = tuple(file or FILES)
    if scan_options.budget_s is not None and not scan_options.assist:
        raise ConfigError("--budget-s: it is for --assist, which finds exposures within it. Give both, or neither.")
    if output is None:
        output = Path("scans") / f"{datetime.now().astimezone():%Y-%m-%d-%H%M%S}"
    refuse_earlier(output, files, force=force)
    with client_of(rig, service) as client:
        if scan_options.assist:
            request = assisted(client, request, budget_s=scan_options.budget_s)
        if repeat > 1:
            series_with(client, request, output, files=files)
            return
        result = scan_with(client, request, output, files=files)
    print_result(result, output, files=files)


@app.command(cls=SubjectsCommand)
@grouped
def reconstruct(
    *,
    bundles: Annotated[
        list[Path], typer.Argument(metavar="BUNDLE", help="Folders with bundle.json, or a folder of such.")
    ],
    output: Annotated[
        Path, typer.Option(help="Folder for mesh, report and pictures; of several bundles, for folders.")
    ],
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration to use in place of the bundle's calibration.json.")
    ] = None,
    file: Annotated[
        list[str] | None,
        typer.Option(help="Write this, too, as mesh.stl or points-CAMERA.npz; repeatable. slrig scan has the same."),
    ] = None,
    mesh: MeshOptions,
    guesses: GuessOptions,
    hand_eye: Annotated[
        Path | None, typer.Option(help="With --mesh-axes robot: hand_eye.json, by slrig calibrate hand-eye.")
    ] = None,
    decode_only: Annotated[
        bool,
        typer.Option("--decode-only", help="Only decode: positions, causes, what to change. Needs no calibration."),
    ] = False,
) -> None:
    """Make meshes from recorded scans. Needs no service and no rig."""
    with loading():
        from slrig.cli.reconstruct import decode_and_print, reconstruct_and_print

    if decode_only:
        decode_and_print(bundles, output)
        return
    options = mesh.chosen()
    if hand_eye is not None:
        from slrig.calibrate.hand_eye import read_hand_eye

        options["rig_in_base"] = read_hand_eye(hand_eye).rig_in_base(mesh.flange()).tolist()
    reconstruct_and_print(
        bundles, output, calibration=calibration, further=file or (), options=options, guess=guesses.request()
    )


@app.command()
def devices(
    options: Annotated[
        str | None,
        typer.Option(metavar="DRIVER", help="Show every option of this driver, for a rig file."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON; of options, JSON Schema.")] = False,
) -> None:
    """List installed drivers and the devices that are plugged in."""
    if options is not None:
        from slrig.cli.rig_file import print_options

        print_options(options, as_json=as_json)
        return
    from slrig.cli.rig_file import list_devices

    list_devices(as_json=as_json)


@app.command()
def init(
    output: Annotated[Path, typer.Option(help="The rig file to write.")] = Path("rig.toml"),
    name: Annotated[str, typer.Option(help="What the rig is called.")] = "bench",
    camera: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]DRIVER[:DEVICE]", help="A camera, as slrig devices lists it; may be repeated."),
    ] = None,
    projector: Annotated[str | None, typer.Option(metavar="DRIVER[:DEVICE]", help="The projector.")] = None,
    exposure_s: Annotated[
        float | None, typer.Option(help="Exposure of every camera. Default 0.0167, a period of 60 Hz.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="TABLE.KEY=VALUE", help="An option of a camera or projector; may be repeated."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask no questions; take all cameras that are plugged in.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file of --output.")] = False,
    example: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Write this example instead, as demo or webcams-and-hdmi, with its scene."),
    ] = None,
) -> None:
    """Write a rig file for the devices that are plugged in.

    Asks for what it cannot know. Checks the file by the drivers before it is written; opens no device.
    """
    if example is not None:
        from slrig.cli.rig_file import write_example

        write_example(example, output, force=force)
        return
    from slrig.cli.rig_file import init as write_rig_file

    write_rig_file(
        output,
        name=name,
        cameras=camera or (),
        projector=projector,
        settings=settings or (),
        exposure_s=exposure_s,
        yes=yes,
        force=force,
    )


@app.command()
def warm() -> None:
    """Compile ahead what the first scan would wait for.

    For images and installers: it takes about a minute once, and a few seconds after that.
    """
    from slrig.cli.reconstruct import warm as prepare

    prepare()


@app.command()
@grouped
def conform(*, rig: RigHere = None, service: ServiceOptions, data: Data = None, as_json: AsJson = False) -> None:
    """Examine a rig by the driver contract, and score it.

    Exit code 1 unless every check that applies passes.
    """
    from slrig.cli.examine import conform as examine

    if not examine(rig, service.client(), data=data, as_json=as_json):
        raise typer.Exit(1)


@app.command()
@grouped
def latency(
    *,
    rig: RigHere = None,
    service: ServiceOptions,
    flashes: Annotated[int, typer.Option(min=8, max=1000, help="Flashes that each camera must see happen.")] = 40,
    search_s: Annotated[float, typer.Option(min=0.01, max=10, help="How late light may be, seconds.")] = 0.5,
    exposure_s: Annotated[
        float | None, typer.Option(help="Exposure of every camera for this test. Default: the rig file's.")
    ] = None,
    trigger: Annotated[
        Literal["free", "software"] | None,
        typer.Option(help="How exposures are started. Default: free where a camera can."),
    ] = None,
    data: Data = None,
    as_json: AsJson = False,
) -> None:
    """Flash the projector: how late is its light?

    Shows whether the cameras have rolling shutters, too, and what to write into the rig file.
    """
    from slrig.cli.examine import latency as measure

    measure(
        rig, service.client(), flashes=flashes, search_s=search_s, exposure_s=exposure_s, trigger=trigger, data=data,
        as_json=as_json,
    )  # fmt: skip


@app.command()
@grouped
def doctor(
    *,
    rig: RigHere = None,
    service: ServiceOptions,
    output: Annotated[Path | None, typer.Option(help="Write a rig file with the values that were found.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file of --output.")] = False,
    search_s: Annotated[float, typer.Option(min=0.01, max=10, help="How late light may be, seconds.")] = 0.5,
    data: Data = None,
    as_json: AsJson = False,
) -> None:
    """Examine a rig before a still object: what is wrong?

    Light, timing, picture, focus, response and flicker, and what to do about them. Exit code 1 if there is a fault.
    """
    from slrig.cli.examine import doctor as examine

    client = service.client()
    if not examine(rig, client, output=output, force=force, search_s=search_s, data=data, as_json=as_json):
        raise typer.Exit(1)


@app.command()
@grouped
def report(
    *,
    output: Annotated[Path, typer.Argument(metavar="BENCH.zip", help="The file to write.")],
    rig: RigOption = None,
    service: ServiceOptions,
    pictures: Annotated[bool, typer.Option("--pictures", help="Add previews and frames of the two scans.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> None:
    """Gather in one file what helps others to help you.

    Versions, devices, controls, doctor, conform, latency, two scans, the kernel's log: text, without pictures and keys.
    """
    from slrig.cli.report import write_report

    write_report(rig, service, output, pictures=pictures, force=force)


@app.command()
@grouped
def verify(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            callback=rig_path,
            help="A recorded pose of the board, a bundle; or a rig file to shoot one.",
        ),
    ],
    board: BoardArguments,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration to verify. Default: the bundle's, or the rig file's.")
    ] = None,
    position: Annotated[int | None, typer.Option(min=0, help="Pose of the rig's positioner, by number.")] = None,
    as_json: AsJson = False,
) -> None:
    """Shoot the board once: does the calibration still hold?

    Exit code 1 if it is stale.
    """
    from slrig.cli.calibrate_local import chosen_board
    from slrig.cli.calibrate_local import verify as check

    if not check(source, chosen_board(board), calibration, position=position, as_json=as_json):
        raise typer.Exit(1)


@app.command(cls=SubjectsCommand)
@partial(
    grouped,
    subjects={
        "Limits": "tolerance_mm spacing_limit_mm form_limit_mm size_limit_mm flatness_limit_mm",
        "Captures": "scripted volume_mm repeats exposure_s",
        "Report": "output as_json certificate notes",
    },
)
def accept(
    *,
    rig: RigFile,
    output: Annotated[Path, typer.Option(help="New folder for report.html, report.json and the points.")],
    scripted: Annotated[
        bool, typer.Option("--scripted", help="The rig's positioner places the artefacts; a rendered rig always can.")
    ] = False,
    options: AcceptanceOptions,
    as_json: AsJson = False,
) -> None:
    """Test a rig with a sphere, a ball bar and a plane.

    In the manner of VDI/VDE 2634-2. Exit code 1 unless it passes.
    """
    from slrig.cli.accept import accept as test

    if not test(rig, options, output=output, scripted=scripted, as_json=as_json):
        raise typer.Exit(1)


preset_app = typer.Typer(no_args_is_help=True, help="Options of scans by name: for dark objects, for shiny ones.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the preset.")]
MOST_BYTES = 2**20


@preset_app.command(name="list")
@grouped
def list_presets(service: ServiceOptions, as_json: AsJson = False) -> None:
    """List presets, and where they come from."""
    from slrig.cli.display import print_json, print_table

    with service.client() as client:
        found = client.presets.list()
    if as_json:
        print_json(found)
        return
    rows = [(each["name"], each["source"], each["fault"] or each["description"] or "") for each in found["presets"]]
    print_table(("preset", "from", "for"), rows)


@preset_app.command()
@grouped
def export(name: Name, service: ServiceOptions) -> None:
    """Print a preset as JSON, for a file that another rig imports."""
    from slrig.cli.display import print_json

    with service.client() as client:
        print_json(client.presets.get(name))


@preset_app.command(name="import")
@grouped
def import_preset(
    name: Name,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file that export wrote; - is standard input.")],
    service: ServiceOptions,
) -> None:
    """Store a preset in the service by this name."""
    from slrig.bundle import read_text

    document = sys.stdin.read(MOST_BYTES) if str(file) == "-" else read_text(file, MOST_BYTES, ConfigError)
    with service.client() as client:
        client.presets.put(name, document)


@preset_app.command()
@grouped
def delete(name: Name, service: ServiceOptions) -> None:
    """Delete a preset that was imported."""
    with service.client() as client:
        client.presets.delete(name)


app.command()(serve)
app.command()(live)
app.command(cls=SubjectsCommand)(model)
app.command()(patterns)
app.command(name="import", cls=SubjectsCommand)(
    grouped(
        import_images,
        subjects={
            "What the images show": "projector program pattern names white black listed cell_px offset_px",
            "Cameras and calibration": "camera bit_depth calibration unit keys",
        },
    )
)
app.command()(backup)
app.command()(check)
app.command()(restore)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(schedule.app, name="schedule")
app.add_typer(preset_app, name="preset")
app.add_typer(scans.app, name="scans")
app.add_typer(turntable_app, name="turntable")
app.add_typer(key_app, name="key")
app.add_typer(pool_app, name="pool")
app.command()(worker)
app.command()(fleet)


def _with_only(name: str) -> typer.Typer:
    """`app` with the one command or group of this name, because typer builds all that there are, which takes 50 ms;
    all of them for another name, as of an option.
    """
    one = copy(app)
    one.registered_groups = [each for each in app.registered_groups if each.name == name]
    one.registered_commands = [
        each
        for each in app.registered_commands
        if name == (each.name or getattr(each.callback, "__name__", "").replace("_", "-"))
    ]
    return one if one.registered_groups or one.registered_commands else app


def main() -> None:
    """Run the command that the arguments name."""
    # Before numpy is loaded, here and in what commands start. OpenBLAS's threads wait for work by spinning, for 2**26
    # ticks after each product (its THREAD_TIMEOUT), next to kernels, captures and other programs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Before pydantic is loaded, which else reads the metadata of all packages: slrig uses no plug-in of pydantic's.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    code = [1]
    atexit.register(_end_beside_threads, code)
    # A reader that has enough (slrig devices | head) closes the pipe: that is not an error.
    try:
        _with_only(sys.argv[1] if len(sys.argv) > 1 else "")(prog_name="slrig")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code[0] = 0
        sys.exit(0)
    except SystemExit as ended:
        code[0] = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        raise


def _end_beside_threads(code: list[int]) -> None:
    """End the process after all other exit functions where daemon threads still run: a driver that opens its device, a
    picture in OpenCV. Python would end such a thread within C++, which aborts the process.
    """
    if any(each.daemon for each in threading.enumerate()):
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code[0])

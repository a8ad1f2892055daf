"""slrig's commands and their exit codes: 0 well, 1 a defect of slrig, 2 something to be put right, 130 Ctrl-C.
`slrig conform` exits with 1 for a defect of a driver, `slrig doctor` for one of the rig, `slrig verify` for a stale
calibration, `slrig accept` for a test that is not passed, too.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import typer.core

from slrig.cli import calibrate, key, pool, preset, schedule, turntable
from slrig.cli.backup import backup, restore
from slrig.cli.fleet import fleet
from slrig.cli.foreign import import_images
from slrig.cli.model import model
from slrig.cli.options import (
    AcceptanceOptions,
    AsJson,
    BoardArguments,
    MeshOptions,
    RigFile,
    RigHere,
    ServiceOptions,
    given,
    grouped,
    period_option,
)
from slrig.cli.patterns import patterns
from slrig.cli.scan_options import ScanOptions
from slrig.cli.serve import serve
from slrig.errors import ConfigError, SlrigError

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
    help="Structured-light scanning: from a projector and cameras to a triangle mesh in millimetres.",
    epilog="Start with: slrig demo",
)


def _tell_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"slrig {version('slrig')}")
        raise typer.Exit


@app.callback()
def slrig(
    _version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options that stand before any command; what `slrig --help` says is `app`'s."""


@app.command()
def demo(
    rig: Annotated[
        Path | None,
        typer.Argument(metavar="RIG", help="Rig file. Default: config/rigs/demo.toml, a rendered rig."),
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for mesh, preview and report.")] = Path("scans/demo"),
) -> None:
    """Scan once on a rendered rig, and compare with the truth.

    Goes through the real service, in a process of its own. Exit code 1 if a thousandth of the mesh's area or more is
    beyond 1 mm of the truth, or shows the cameras its back.
    """
    from slrig.cli.demo import run_demo

    run_demo(rig, output)


@app.command()
@grouped
def scan(
    *,
    service: ServiceOptions,
    output: Annotated[Path, typer.Option(help="Folder for the files of the scan.")] = Path("scans/latest"),
    file: Annotated[
        list[str] | None,
        typer.Option(
            help="File to fetch, as mesh.obj or points-CAMERA.npz; may be repeated. "
            "Default: mesh.ply, preview.png, report.json."
        ),
    ] = None,
    label: Annotated[str | None, typer.Option(help="Free text, to find the scan again.")] = None,
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
        bool, typer.Option("--rows", help="Play columns and rows. Default: the axis the calibration asks for.")
    ] = False,
    cross_lines: Annotated[
        bool,
        typer.Option("--cross-lines", help="Play one frame of lines along the other axis: it tests the calibration."),
    ] = False,
    asked: ScanOptions,
    mesh: MeshOptions,
    queue: Annotated[bool, typer.Option("--queue", help="Wait in line if the rig is held.")] = False,
    repeat: Annotated[int, typer.Option(min=1, help="So many scans in a row, each into a folder of its number.")] = 1,
    every_s: Annotated[float | None, typer.Option(help="From the start of one to that of the next, seconds.")] = None,
) -> None:
    """Scan with a running service, and fetch the mesh."""
    from slrig.cli.scan import FILES, assisted, scan_with, series_with, tell_result

    request = given(
        label=label,
        # One exposure time is one, several are a bracket.
        exposure_s=exposure_s[0] if exposure_s and len(exposure_s) == 1 else None,
        exposures_s=exposure_s if exposure_s and len(exposure_s) > 1 else None,
        if_busy="queue" if queue else "reject",
        **asked.asked(),
        repeat=repeat if repeat > 1 else None,
        every_s=every_s,
        patterns=given(
            sequence=sequence, line_width_px=line_width_px, gray_cell_px=gray_cell_px, sine_steps=steps,
            **period_option(sequence, period_px), line_shift=False if gray_only else None, rows=rows or None,
            cross_lines=cross_lines or None,
        ),
        reconstruction=mesh.asked(),
    )  # fmt: skip
    files = tuple(file or FILES)
    if asked.budget_s is not None and not asked.assist:
        raise ConfigError("--budget-s: it is for --assist, which finds exposures within it. Give both, or neither.")
    with service.client() as client:
        if asked.assist:
            request = assisted(client, request, budget_s=asked.budget_s)
        if repeat > 1:
            series_with(client, request, output, files=files)
            return
        result = scan_with(client, request, output, files=files)
    tell_result(result, output, files=files)


@app.command()
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
    decode_only: Annotated[
        bool,
        typer.Option("--decode-only", help="Only decode: positions, causes, what to change. Needs no calibration."),
    ] = False,
) -> None:
    """Make meshes from recorded scans. Needs no service and no rig."""
    from slrig.cli.reconstruct import decode_and_tell, reconstruct_and_tell

    if decode_only:
        decode_and_tell(bundles, output)
        return
    reconstruct_and_tell(bundles, output, calibration=calibration, further=file or (), options=mesh.chosen())


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
        from slrig.cli.driver_options import tell_options

        tell_options(options, as_json=as_json)
        return
    from slrig.cli.devices import list_devices

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
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing; take all cameras that are plugged in.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file of --output.")] = False,
) -> None:
    """Write a rig file for what is plugged in.

    Asks what it cannot know. Checks the file by the drivers before it is written; opens no device.
    """
    from slrig.cli.init import init as write_rig_file

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
def conform(*, rig: RigHere = None, service: ServiceOptions, data: key.Data = None, as_json: AsJson = False) -> None:
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
    data: key.Data = None,
    as_json: AsJson = False,
) -> None:
    """Flash the projector: how late is its light?

    Tells whether the cameras have rolling shutters, too, and what to write into the rig file.
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
    data: key.Data = None,
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
def verify(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="A recorded pose of the board, a bundle; or a rig file to shoot one."),
    ],
    board: BoardArguments,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration to verify. Default: the bundle's, or the rig file's.")
    ] = None,
    position: Annotated[int | None, typer.Option(min=0, help="Pose of the rig's positioner, by number.")] = None,
    as_json: AsJson = False,
) -> None:
    """Look at the board once: does the calibration still hold?

    Exit code 1 if it is stale.
    """
    from slrig.cli.boards import chosen_board
    from slrig.cli.verify import verify as look

    if not look(source, chosen_board(board), calibration, position=position, as_json=as_json):
        raise typer.Exit(1)


@app.command()
@grouped
def accept(
    *,
    rig: RigFile,
    output: Annotated[Path, typer.Option(help="New folder for report.html, report.json and the points.")],
    scripted: Annotated[
        bool, typer.Option("--scripted", help="The rig's positioner places the artefacts; a rendered rig always can.")
    ] = False,
    asked: AcceptanceOptions,
    as_json: AsJson = False,
) -> None:
    """Test a rig with a sphere, a ball bar and a plane.

    In the manner of VDI/VDE 2634-2. Exit code 1 unless it passes.
    """
    from slrig.cli.accept import accept as test

    if not test(rig, asked, output=output, scripted=scripted, as_json=as_json):
        raise typer.Exit(1)


app.command()(serve)
app.command()(model)
app.command()(patterns)
app.command(name="import")(import_images)
app.command()(backup)
app.command()(restore)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(schedule.app, name="schedule")
app.add_typer(preset.app, name="preset")
app.add_typer(turntable.app, name="turntable")
app.add_typer(key.app, name="key")
app.add_typer(pool.app, name="pool")
app.command()(pool.worker)
app.command()(fleet)


def main() -> None:
    """Run the command that the arguments name."""
    # Before numpy is loaded, here and in what commands start. OpenBLAS's threads wait for work by spinning, for 2**26
    # ticks after each product (its THREAD_TIMEOUT), beside kernels, captures and other programs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A reader that has seen enough (slrig devices | head) closes the pipe: that is no error.
    try:
        app(prog_name="slrig")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)

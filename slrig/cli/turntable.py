"""`slrig turntable`: the axis of a turntable and the planes behind it, in a file that `slrig model` takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slrig.cli.options import BoardArguments, grouped

if TYPE_CHECKING:
    from slrig.bundle import TurntableRecord

app = typer.Typer(no_args_is_help=True, help="A turntable's axis, its plate and what is behind.")


@app.command()
@grouped
def axis(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Bundles of a board that stood on the turntable, one per angle.")
    ],
    asked: BoardArguments,
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

    from rich.table import Column

    from slrig.bundle import AxisSource, read_calibration, write_file
    from slrig.cli.boards import chosen_board
    from slrig.cli.calibrate_solve import pose_bundles
    from slrig.cli.display import print_table, progress_shown
    from slrig.cli.reconstruct import keep_kernels
    from slrig.errors import PatternError, PoseRefusedError
    from slrig.logs import set_up_console_logs

    set_up_console_logs()
    bundles, board, rig, before = (
        pose_bundles(folder),
        chosen_board(asked),
        read_calibration(calibration),
        _known(output),
    )
    keep_kernels()
    with progress_shown() as display:
        from slrig.bundle import encode_turntable
        from slrig.calibrate.pose_reading import read_pose
        from slrig.calibrate.turntable_axis import axis_of_poses
        from slrig.combine.turntable import with_axis

        read, angles, refused = [], [], {}
        for number, (name, bundle) in enumerate(bundles.items()):
            display(f"reading {name}", number / len(bundles), f"{number + 1} of {len(bundles)}")
            try:
                read.append(read_pose(bundle, board, name).observation)
                angles.append((angle or 0.0) * number)
            except (PoseRefusedError, PatternError) as error:
                refused[name] = str(error)
        found = axis_of_poses(read, board, rig, None if angle is None else angles)
        record = with_axis(before, found.axis.measured_axis, source=AxisSource.BOARD, of=folder.absolute().name)
        write_file(output, encode_turntable(record))
        display("done", 1.0, "")
    rows = [
        (name, f"{found.angles_deg[name]:.3f}°", f"{found.errors_deg[name]:.3f}°" if found.errors_deg else "",
         f"{left:.4f} mm")
        for name, left in found.residual_mm.items()
    ]  # fmt: skip
    print_table((Column("pose", overflow="fold"), *(Column(each, justify="right") for each in
                 ("angle", "off", "residual"))), rows)  # fmt: skip
    for name, cause in refused.items():
        typer.echo(f"{'left out':<10}{name}: {cause}")
    (x, y, z), (a, b, c) = found.axis.point_mm, found.axis.direction
    typer.echo(
        f"{'axis':<10}through ({x:.3f}, {y:.3f}, {z:.3f}) mm ± {found.axis.point_sigma_mm:.4f} mm, along "
        f"({a:.5f}, {b:.5f}, {c:.5f}) ± {math.degrees(found.axis.direction_sigma_rad):.4f}°"
    )
    last = record.history[-1]
    if last.moved_mm is not None:
        typer.echo(
            f"{'moved':<10}by {last.moved_mm:.3f} mm and {last.moved_deg:.3f}°, {last.sigmas:.1f} σ, since before"
        )
    typer.echo(f"{'turntable':<11}{output}")


@app.command()
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
    from slrig.combine.turntable_planes import planes_in

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
    """What the file says already. Raises ConfigError: it is damaged, and is left as it is."""
    from slrig.bundle import TurntableRecord, read_turntable

    return read_turntable(file) if file.exists() else TurntableRecord()

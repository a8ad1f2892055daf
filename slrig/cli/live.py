"""`slrig live`: watch live depth in the terminal, record it, and export recorded depth images."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slrig.cli.options import ServiceOptions, grouped
from slrig.disk import storage_errors
from slrig.errors import ConfigError

if TYPE_CHECKING:
    from slrig.client import LiveFrame


@grouped
def live(
    *,
    recording: Annotated[
        Path | None, typer.Argument(metavar="RECORDING", help="A file that --record wrote, in place of a service.")
    ] = None,
    service: ServiceOptions,
    camera: Annotated[str | None, typer.Option(help="Camera of the rig. Default: the first.")] = None,
    step: Annotated[int | None, typer.Option(min=1, max=64, help="Pixels from point to point. Default: 3.")] = None,
    exposure_s: Annotated[float | None, typer.Option(help="Exposure, seconds. Default: the rig file's.")] = None,
    region: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="TOML file of what is shown, as a scan's. Default: the rig's."),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after so long. Default: at Ctrl-C.")] = None,
    record: Annotated[Path | None, typer.Option(metavar="FILE", help="New file for the depth images.")] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="New folder for an organised cloud (PCD) of each depth image.")
    ] = None,
) -> None:
    """Show depth many times a second, while you aim.

    The projector repeats a short sequence, and each new frame gives a new depth image. Prints what it says of the aim;
    the page shows it as pictures. A scan goes first, and live depth goes on after it.
    """
    from slrig.bundle import read_region
    from slrig.client import read_recording

    if record is not None and (recording is not None or export is not None):
        message = "--record writes what a service sends; export a recording afterwards: slrig live FILE --export FOLDER"
        raise ConfigError(message)
    if export is not None:
        with storage_errors(export):
            export.mkdir(parents=True)
    if recording is not None:
        _show(read_recording(recording), export, None)
        return
    with service.client() as client:
        limits = None if region is None else read_region(region).model_dump(mode="json", exclude_unset=True)
        client.live.start(camera, exposure_s=exposure_s, region=limits)
        try:
            if record is not None:
                count = client.live.record(record, step=step, seconds=10.0 if seconds is None else seconds)
                typer.echo(f"{count} depth images, {record.stat().st_size / 1e6:.1f} MB: {record}")
            else:
                _show(client.live.watch(step), export, seconds)
        except KeyboardInterrupt:
            # Others may watch; where nobody does, it ends by itself.
            pass


def _show(frames: Iterable[LiveFrame], export: Path | None, seconds: float | None) -> None:
    """Print a line a second; write each frame where a folder is given."""
    began_s, number, said_s = time.monotonic(), 0, 0.0
    for number, frame in enumerate(frames, 1):
        if export is not None:
            with storage_errors(export):
                (export / f"depth-{number:05d}.pcd").write_bytes(encode_organised(frame))
        now_s = time.monotonic()
        if now_s - said_s >= 1.0:
            said_s = now_s
            typer.echo(aim_line(frame.facts, number / max(now_s - began_s, 1e-6)))
        if seconds is not None and now_s - began_s >= seconds:
            break
    typer.echo(f"{number} depth images" + ("" if export is None else f" in {export}"))


def aim_line(facts: Mapping[str, Any], per_s: float) -> str:
    """The aim by a depth image, on one line."""
    shares = facts["shares"]
    parts = [f"{per_s:4.1f}/s", f"measured {shares['measured']:.0%}"]
    shown = ("moved", "saturated", "dark", "unclear")
    parts += [f"{name} {shares[name]:.0%}" for name in shown if shares[name] >= 0.005]
    if facts["distance_mm"] is not None:
        parts.append(f"{facts['distance_mm']:.1f} mm away (axes meet at {facts['meeting_mm']:.0f})")
        parts.append(f"σ {facts['sigma_mm']:.3f} mm")
    if facts["tilt_deg"] is not None:
        parts.append(f"tilted {facts['tilt_deg']:.1f}°")
    if shares["moved"] >= 0.005 and facts["moved_mm"] is not None:
        parts.append(f"moves by about {facts['moved_mm']:.2g} mm within {facts['window_s']:.2f} s: depth there is off")
    return ", ".join(parts)


def encode_organised(frame: LiveFrame) -> bytes:
    """PCD 0.7, binary, organised: x y z and σ in mm, in the camera's frame, and grey; NaN unless measured."""
    import numpy as np

    from slrig.ros_messages import LIVE_FIELDS
    from slrig.scan.clouds import pcd_of

    points = frame.points_mm
    sigma = np.where(frame.state == 0, frame.sigma_mm, np.float32(np.nan))
    table = np.concatenate([points, sigma[..., None], frame.grey[..., None].astype(np.float32)], axis=2)
    return pcd_of(table.astype("<f4"), LIVE_FIELDS, (0, 0, 0, 1, 0, 0, 0))

"""`slrig latency`: flash the projector, and say how late its light is and how the cameras' shutters work."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import typer

from slrig.api.logs import set_up_logs_for_a_person
from slrig.capture.latency import LatencyMeasurement, measure_latency
from slrig.capture.latency_fit import CameraLatency
from slrig.cli.display import print_json, progress_shown
from slrig.config import read_rig
from slrig.devices import Synchronisation, Trigger
from slrig.discovery import open_rig


def tell_latency(
    rig_file: Path, *, trials: int, search_s: float, exposure_s: float | None, trigger: str | None, as_json: bool
) -> None:
    """Measure a rig's latency, and print it in words with the table for its rig file, or as JSON."""
    set_up_logs_for_a_person()
    with open_rig(read_rig(rig_file)) as rig, progress_shown() as display:
        measured = measure_latency(
            rig,
            trials=trials,
            search_s=search_s,
            exposure_s=exposure_s,
            trigger=None if trigger is None else Trigger(trigger),
            told=display,
        )
    if as_json:
        document = {
            "synchronisation": asdict(measured.synchronisation),
            "cameras": {name: _document(found) for name, found in measured.cameras.items()},
        }
        print_json(document)
        return
    typer.echo(in_words(measured))
    table = rig_table(measured.synchronisation)
    typer.echo(f"\nPut this into {rig_file}, in place of a table of that name:\n\n{table}", nl=False)


def in_words(measured: LatencyMeasurement) -> str:
    """What was measured, for a person to read."""
    return "\n\n".join(f"camera {name}\n{_about(found)}" for name, found in measured.cameras.items())


def rig_table(synchronisation: Synchronisation) -> str:
    """The `[synchronisation]` table of a rig file."""
    lines = [
        "[synchronisation]",
        f"latency_s = {_number(synchronisation.latency_s)}",
        f"latency_error_s = {_number(synchronisation.latency_error_s)}",
    ]
    if synchronisation.line_time_s:
        lines += ["", "[synchronisation.line_time_s]"]
        lines += [f"{name} = {_number(line_s, digits=9)}" for name, line_s in synchronisation.line_time_s.items()]
    return "\n".join(lines) + "\n"


def _document(found: CameraLatency) -> dict[str, object]:
    """JSON knows no NaN."""
    values = asdict(found).items()
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values}


def _about(found: CameraLatency) -> str:
    within = f"95 % come within {_ms(found.latency_p95_s)}"
    changes = f"to white {_ms(found.rise_s)}, to black {_ms(found.fall_s)}"
    said = [
        f"light comes {_ms(found.latency_s)} ± {_ms(found.standard_error_s)} after the instant the projector states",
        f"it varies by {_ms(found.jitter_s)} (standard deviation), {within}; {changes}",
        f"it is stable {_ms(found.latest_s)} after that instant at the latest, {_ms(found.settle_s)} of it to settle",
        _shutter(found),
        f"from {found.flashes_used} of {found.flashes} flashes, {found.rows_used} rows that fit to "
        f"{_ms(found.residual_s)}",
    ]
    if found.flicker > 0.02:
        said.append(f"steady white flickers by {found.flicker:.0%}: make the exposure a multiple of the refresh period")
    return "\n".join(f"  {line}" for line in said)


def _shutter(found: CameraLatency) -> str:
    line = f"{found.line_time_s * 1e6:.2f} ± {found.line_time_error_s * 1e6:.2f} µs from row to row"
    if found.rolling:
        return f"rolling shutter: {line}, {_ms(found.skew_s)} from the first row to the last"
    if found.scanned:
        return f"the projector builds up its picture row by row: {line}, as the camera sees it"
    return f"global shutter: {line}, not told from 0"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.2f} ms"


def _number(value: float, *, digits: int = 6) -> str:
    """A TOML float, as many digits after the point as matter."""
    text = f"{value:.{digits}f}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text

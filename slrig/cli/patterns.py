"""`slrig patterns`: the one set of patterns with which a projector's memory is filled."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from slrig.cli.options import RigFile, given, period_option


def patterns(
    rig: RigFile,
    sequence: Annotated[
        Literal["fast", "standard", "robust", "phase"] | None,
        typer.Option(help="If scans ask for another than the rig file."),
    ] = None,
    period_px: Annotated[
        int | None, typer.Option(help="Distance of two lines, or period of phase, if scans ask for another one.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Frames of a sinusoid, if scans ask for other ones.")] = None,
    line_width_px: Annotated[int | None, typer.Option(help="Width of a line, if scans ask for another one.")] = None,
    gray_cell_px: Annotated[
        int | None, typer.Option(help="Width of the finest Gray cell, if scans ask for another one.")
    ] = None,
) -> None:
    """Write the patterns that a projector must hold.

    For trigger boxes and light engines: all that scans, calibration, verification and the doctor show, each once.
    """
    asked = given(
        sequence=sequence, line_width_px=line_width_px, gray_cell_px=gray_cell_px, sine_steps=steps,
        **period_option(sequence, period_px),
    )  # fmt: skip
    typer.echo(written_patterns(rig, asked))


def written_patterns(rig_file: Path, asked: Mapping[str, object]) -> str:
    """Have the rig's projector write all that is shown on it, and return what to do with the files.

    asked : patterns of scans, as far as they differ from the rig file's. Scans of either axis can be played, before and
    after a calibration. Raises UnsupportedByDeviceError where the projector shows any pattern, what opening the rig and
    what writing raises.
    """
    from dataclasses import replace

    from slrig.api.schemas import PatternRequest, ScanRequest, scan_plan
    from slrig.calibrate.records import USUAL_PATTERNS
    from slrig.config import read_rig
    from slrig.devices import StoredPatternProjector
    from slrig.discovery import open_rig
    from slrig.doctor import doctor_sequence
    from slrig.errors import UnsupportedByDeviceError
    from slrig.logs import set_up_console_logs
    from slrig.patterns import merge_sequences
    from slrig.scan.plan_check import pattern_sequence

    set_up_console_logs()
    config = read_rig(rig_file)
    request = ScanRequest(patterns=PatternRequest.model_validate(asked))
    with open_rig(config) as rig:
        projector = rig.projector
        if not isinstance(projector, StoredPatternProjector):
            message = f"the projector of rig '{rig.name}' ({projector.info.model}) shows any pattern: nothing to flash"
            raise UnsupportedByDeviceError(message)
        size = projector.info.size
        scans = replace(scan_plan(request, config.scan).patterns, rows=True)
        sequences = (pattern_sequence(scans, size), pattern_sequence(USUAL_PATTERNS, size), doctor_sequence(size))
        return projector.write_patterns(merge_sequences(sequences))

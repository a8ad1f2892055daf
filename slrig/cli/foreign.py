"""Calibrations written in other programs' forms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from slrig.errors import ConfigError

if TYPE_CHECKING:
    from slrig.foreign.calibrations import Form
    from slrig.model import Calibration


def write_form(calibration: Calibration, file: Path, to: Form | None) -> None:
    """Write a calibration in one of the forms; by the ending of `file` where none is named.
    Raises ConfigError: the ending says none; CalibrationError, StorageError.
    """
    from slrig.foreign.calibrations import write_any_calibration

    endings: dict[str, Form] = {".json": "slrig", ".yml": "opencv", ".xml": "opencv"}
    form = to or endings.get(file.suffix.lower())
    if form is None:
        raise ConfigError(f"{file}: expected a name that ends in .json, .yml or .xml, or --to; found '{file.suffix}'")
    write_any_calibration(file, calibration, form)
    typer.echo(f"{'written':<10}{file}")

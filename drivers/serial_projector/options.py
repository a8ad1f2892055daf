"""Options of a trigger box in the rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from slrig.bundle.validation import Strict


class SerialProjectorOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "serial_projector"`."""

    port: Annotated[str, Field(min_length=1, json_schema_extra={"takes": "device"})]
    """Serial port: a path, a persistent name in /dev/serial/by-id, COM3, or a pyserial URL."""

    baud: Annotated[int, Field(ge=1200, le=12_000_000, json_schema_extra={"unit": "bit/s"})] = 115_200
    """Baud rate of a real serial line; ignored by USB."""

    watchdog_s: Annotated[float, Field(ge=0.05, le=10)] = 2.0
    """The box goes dark when it receives nothing from the host for this time: after a crash or a cable fault."""

    max_on_s: Annotated[float, Field(ge=0.001, le=3600)] = 60.0
    """The box puts out a pattern that has been lit for this time without another request."""

    max_duty: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """Largest fraction of light in any 10 s."""

    brightness: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """Fraction of full power; below 1 the box must be able to dim."""

    open_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Longest time for the first answer after the port was opened; many boards restart then."""

    reply_s: Annotated[float, Field(ge=0.005, le=5)] = 0.15
    """Time after which an unanswered command is repeated; longer for a slow line."""

    deadline_s: Annotated[float, Field(ge=0.1, le=60)] = 2.5
    """Time after which an unanswered command has failed."""

    export_folder: Annotated[str, Field(min_length=1)] = "patterns"
    """Folder, relative to the rig file's, into which `slrig patterns` writes the pattern sets to flash, each into a
    subfolder named by its checksum."""

"""What a rig file says of a trigger box."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from slrig.bundle.validation import Strict


class SerialProjectorOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "serial_projector"`."""

    port: Annotated[str, Field(min_length=1, json_schema_extra={"takes": "device"})]
    """The serial port: a path, a name in /dev/serial/by-id (it stays the same), COM3, or a pyserial URL."""

    baud: Annotated[int, Field(ge=1200, le=12_000_000, json_schema_extra={"unit": "bit/s"})] = 115_200
    """Of a port behind a real serial line; USB ignores it."""

    watchdog_s: Annotated[float, Field(ge=0.05, le=10)] = 2.0
    """The box goes dark when it hears nothing from the host for so long: a crash, a kill, a cable."""

    max_on_s: Annotated[float, Field(ge=0.001, le=3600)] = 60.0
    """The box puts a pattern out that was lit for so long without another one being asked for."""

    max_duty: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """The largest share of any 10 s in which there may be light."""

    brightness: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """Share of the light's full power; below 1 the box must be able to dim."""

    open_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """How long a box may take to answer after its port was opened; many boards restart then."""

    reply_s: Annotated[float, Field(ge=0.005, le=5)] = 0.15
    """How long an answer may take before the command is sent again; longer for a slow line."""

    deadline_s: Annotated[float, Field(ge=0.1, le=60)] = 2.5
    """How long a command may be sent again before it has failed."""

    export_folder: Annotated[str, Field(min_length=1)] = "patterns"
    """Where `slrig patterns` writes what is to be flashed, each set into a folder of its own, named by its checksum;
    from the rig file's folder."""

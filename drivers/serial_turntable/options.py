"""What a rig file says of a turntable on a serial line."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.validation import Strict

AXES = "XYZABC"


class LineOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[positioner]` table with `driver = "serial_turntable"`."""

    port: Annotated[str, Field(min_length=1, json_schema_extra={"takes": "device"})]
    """The serial port: a path, a name in /dev/serial/by-id (it stays the same), COM3, or a pyserial URL."""

    baud: Annotated[int, Field(ge=1200, le=12_000_000, json_schema_extra={"unit": "bit/s"})] = 115_200
    """Of a port behind a real serial line; USB ignores it."""

    units_per_deg: Annotated[float, Field(gt=0, le=1e6, json_schema_extra={"unit": "1/°"})] = 1.0
    """The controller's units for 1° of the table: the gear's ratio, if it counts degrees of the motor."""

    reversed: bool = False
    """Whether the controller counts left-handed about the axis: the table, seen from above, then turns clockwise."""

    approach_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0
    """Against backlash: every angle is approached from that much below it (above it, if negative); 0 takes the
    straight way."""

    tolerance_deg: Annotated[float, Field(gt=0, le=5)] = 0.1
    """How far from the angle that was asked for it may stand."""

    settle_s: Annotated[float, Field(ge=0, le=15)] = 0.5
    """How long what stands on it takes to come to rest, once the motor stands."""

    poses: Annotated[int, Field(ge=1, le=360)] = 8
    """How many even poses it offers."""

    open_s: Annotated[float, Field(gt=0, le=30)] = 6.0
    """How long the controller may take to answer after its port was opened; many boards restart then."""

    turn_s: Annotated[float, Field(gt=0, le=100)] = 60.0
    """How long a turn may take, the way round for `approach_deg` included."""


class GrblOptions(LineOptions):
    """The keys of a `[positioner]` table with `driver = "grbl_turntable"`."""

    axis: Literal["X", "Y", "Z", "A", "B", "C"] = "A"
    """Which axis of the controller turns the table. GRBL itself has X, Y and Z only, in mm: see `units_per_deg`."""

    speed_deg_s: Annotated[float, Field(gt=0, le=360)] | None = None
    """How fast it turns; else as fast as the controller is set to ($110 and the like)."""

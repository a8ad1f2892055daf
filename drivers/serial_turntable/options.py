"""Options of a turntable on a serial line in the rig file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle import Strict

AXES = "XYZABC"


class LineOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[positioner]` table with `driver = "serial_turntable"`."""

    port: Annotated[str, Field(min_length=1, json_schema_extra={"takes": "device"})]
    """Serial port: a path, a persistent name in /dev/serial/by-id, COM3, or a pyserial URL."""

    baud: Annotated[int, Field(ge=1200, le=12_000_000, json_schema_extra={"unit": "bit/s"})] = 115_200
    """Baud rate of a real serial line; ignored by USB."""

    units_per_deg: Annotated[float, Field(gt=0, le=1e6, json_schema_extra={"unit": "1/°"})] = 1.0
    """Controller units per 1° of the table: the gear ratio, if it counts degrees of the motor."""

    reversed: bool = False
    """The controller counts left-handed about the axis: seen from above, the table turns clockwise."""

    approach_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0
    """Compensates backlash: every angle is approached from this far below it (above it, if negative); 0 moves
    directly."""

    tolerance_deg: Annotated[float, Field(gt=0, le=5)] = 0.1
    """Largest deviation from the requested angle."""

    settle_s: Annotated[float, Field(ge=0, le=15)] = 0.5
    """Time for the object to come to rest after the motor has stopped."""

    poses: Annotated[int, Field(ge=1, le=360)] = 8
    """Number of equally spaced poses."""

    open_s: Annotated[float, Field(gt=0, le=30)] = 6.0
    """Longest time for the first answer after the port was opened; many boards restart then."""

    turn_s: Annotated[float, Field(gt=0, le=100)] = 60.0
    """Longest time of a turn, including the detour for `approach_deg`."""


class GrblOptions(LineOptions):
    """The keys of a `[positioner]` table with `driver = "grbl_turntable"`."""

    axis: Literal["X", "Y", "Z", "A", "B", "C"] = "A"
    """Axis of the controller that turns the table. GRBL itself has X, Y and Z only, in mm: see `units_per_deg`."""

    speed_deg_s: Annotated[float, Field(gt=0, le=360)] | None = None
    """Speed of rotation; default: the controller's setting ($110 and the like)."""

"""Light engines with TI's controller DLPC900 over USB: the LightCrafter 6500 and 9000, and boards with the same one.

Linux only: the engine is a HID device (0451:c900), and is spoken to through /dev/hidraw*. Needs no library. Nothing is
flashed: `load` sends the patterns into the engine's memory ("pattern on-the-fly"), some 10 kB for 24 of them.

What is established, and from what. The guide itself (DLPU018, revisions F and J), the data sheet (DLPS037), TI's own
sources (API.c, splash.c, compress.c, pattern.c of its program, in github.com/RhojAnn/DLPC900_CLI under lib) and a
program of others for the LightCrafter 6500 (github.com/csi-dcsc/Pycrafter6500): each command is in two of them at
least, as each module's docstring cites. Only facts were taken.

`play` shows the loaded sequence once. TRIG_OUT_1 is on while a pattern is lit, and needs dark between two patterns to
change; so each period is its exposure and at least 105 µs (DLP500YX 62 µs) more. `show` shows one pattern and then one
without any LED, within 2 s, and while this program lives begins that anew, for `hold_s` at the most. Dark means: every
LED off, and the sequence stopped.

The evaluation modules bring no LEDs: a driver board of somebody's is at the connector, and the guide itself warns that
the polarity may come out the other way round there (table 2-67). So it is as with the DLPC350: until the rig file
tells, the registers stand at half, which is the same in both senses, light is on for a twelfth of the time, 4.2 % on
average, and nothing is played; `slrig doctor` finds it out. A light source that does not follow the LED enables is not
switched by this driver, and never dark by it.

Untested on metal. All of it was tested against a peer that speaks the protocol; pictures, also by TI's unpacking
routine (compress.c, compiled for this once), which gave them back whole. To be watched on the first day: whether LEDs
come on at a start after LED enables were off (a user of a DLP9000 reported that they did not, at firmware 5), what is
lit after the end of a played sequence, light between a stop and a start (a held pattern may blink once a second), the
order of the bytes of a pixel (frames show it), and how long light takes to begin (`start_s`).

Not used. Standby: waking before two minutes are over is forbidden (table 2-35). The mirrors' idle mode: LEDs were
reported on in it. Video input, patterns from flash, more than one bit per pattern, TRIG_IN, blocks of mirrors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle.validation import checked
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:  # noqa: ARG001 - no path is in them
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc900.options.Dlpc900EngineOptions`.
    folder
        The rig file's own.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        The engine is not plugged in.
    DeviceBusyError
        Another program holds it.
    UnsupportedByDeviceError
        Its firmware is too old, its mirrors are not known, or it does not take a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        It may not be opened, or failed.
    """
    from drivers.dlpc900.options import Dlpc900EngineOptions
    from drivers.dlpc900.projector import DLPC900, Dlpc900Projector
    from drivers.pattern_engine.usb import choose_engine, find_engines, open_link, require_hidraw

    require_hidraw(DLPC900)
    table = checked(Dlpc900EngineOptions, options, "the [projector] table of a light engine")
    node = choose_engine(table.device, find_engines(DLPC900))
    return Dlpc900Projector(open_link(node.path, DLPC900), table, serial=node.name)


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the light engines that are plugged in. None of them is opened.

    Raises
    ------
    WrongSystemError
        This is not Linux.
    """
    from drivers.dlpc900.projector import DLPC900
    from drivers.pattern_engine.usb import list_devices

    return list_devices(DLPC900)

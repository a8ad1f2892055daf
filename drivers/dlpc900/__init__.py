"""Light engines with TI's controller DLPC900 over USB (experimental): the LightCrafter 6500 and 9000, and boards with
it.

Experimental: untested on hardware. It was tested against a simulated device that speaks the protocol; encoded pictures
also with TI's decoder (compress.c, compiled for this test), which returned them unchanged.

Linux only: the engine is a HID device (0451:c900), reached through /dev/hidraw*. Needs no library. Nothing is flashed:
`load` sends the patterns into the engine's memory ("pattern on-the-fly"), some 10 kB for 24 of them.

Sources. The guide (DLPU018, revisions F and J), the data sheet (DLPS037), TI's own sources (API.c, splash.c,
compress.c, pattern.c of its program, in github.com/RhojAnn/DLPC900_CLI under lib) and a third-party program for the
LightCrafter 6500 (github.com/csi-dcsc/Pycrafter6500): each command is in at least two of them, as each module's
docstring cites.

Sequences. `play` shows the loaded sequence once. TRIG_OUT_1 is on while a pattern is lit, and needs a dark time between
two patterns to change; so each period is at least 105 µs (DLP500YX 62 µs) longer than its exposure. `show` shows one
pattern and then one without any LED, within 2 s, and restarts that once a second while this program lives, with the
LEDs off meanwhile, for at most `hold_s`. Dark means: every LED off, and the sequence stopped.

LED current. The evaluation modules have no LEDs: a third-party driver board is at the connector, and the guide warns
that the polarity may be inverted there (table 2-67). As for the DLPC350: until the rig file gives the polarity, the
registers are set to half, which is the same for both, light is on for a twelfth of the time, 4.2 % on average, and
nothing is played; `slrig doctor` determines it. This driver cannot switch, or darken, a light source that does not
follow the LED enables.

To be checked on hardware: whether LEDs come on at a start after LED enables were off (a user of a DLP9000 reported that
they did not, at firmware 5), what is lit after the end of a played sequence, how long a held pattern is dark once a
second, whether the status says that a sequence has ended, the byte order of a pixel (frames show it), and the delay of
the light (`start_s`).

Not used. Standby: waking within two minutes is forbidden (table 2-35). The mirrors' idle mode: LEDs were reported on in
it. Video input, patterns from flash, more than one bit per pattern, TRIG_IN, blocks of mirrors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:  # noqa: ARG001 - the options have no path
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc900.engine.Dlpc900EngineOptions`.
    folder
        Folder of the rig file, not used.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        The engine is not plugged in.
    DeviceBusyError
        Another program holds it.
    UnsupportedByDeviceError
        Its firmware is too old, its mirrors are unknown, or it does not accept a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        This user may not open it, or it failed.
    """
    from drivers.dlpc900.engine import Dlpc900EngineOptions
    from drivers.dlpc900.projector import DLPC900, Dlpc900Projector
    from drivers.pattern_engine.usb import choose_engine, find_engines, open_link, require_hidraw

    require_hidraw(DLPC900)
    table = validate(Dlpc900EngineOptions, options, "the [projector] table of a light engine")
    node = choose_engine(table.device, find_engines(DLPC900))
    return Dlpc900Projector(open_link(node.path, DLPC900), table, serial=node.name)


def find_devices() -> tuple[FoundDevice, ...]:
    """List the light engines that are plugged in. Opens none. Raises WrongSystemError unless this is Linux."""
    from drivers.dlpc900.projector import DLPC900
    from drivers.pattern_engine.usb import list_devices

    return list_devices(DLPC900)

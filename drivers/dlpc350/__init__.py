"""Light engines with TI's controller DLPC350 over USB: the LightCrafter 4500, and boards with the same controller.

Linux only: the engine is a HID device (0451:6401), and is spoken to through /dev/hidraw*. Needs no library.

What it shows. The engine's mirrors are an array of 912 columns and 1140 rows, each on or off: that is the size that is
declared, and no picture is ever scaled to it. Patterns come from the engine's own flash, where 24 of them lie as the
bit planes of one picture (`drivers.dlpc350.flash`): TI's program puts the pictures there, this driver writes them and
keeps the list. It knows what the flash holds from that list alone: the engine does not give its pictures back. It does
give their number, and the name (tag) of what was flashed; both are compared. That each frame shows its pattern is
proven by the frames, as in every scan. The video input (HDMI) is not used: which picture of it is in the engine's
buffer when cannot be known from here.

The mirrors stand on their corners. Column c of row r lies at x = c + ½·(r mod 2), y = r/2, in units of a mirror's
diagonal (10.8 µm). So a column's edge zigzags by half a column from row to row, and its centre lies at c + ¼: the same
for every column. A calibration for 912 x 1140 pixels takes all this in: its fy is twice its fx, and its cx moves by ¼.

The engine is told things in the order stop, set, validate, start. `play` shows the loaded sequence once, with a pulse
on TRIG_OUT_1 per pattern. `show` plays a sequence of one pattern, which the engine ends by itself within 2 s; while
this program lives, it begins that anew, for `hold_s` at the most. Dark means: sequence stopped and every LED off.

How fast it shows. A dozen commands of some 3 ms, and the time that a picture takes from the flash: 200 ms at the worst,
less for simple pictures; TI's program tells it. The engine's buffer holds two pictures, and a sequence that runs
repeats from there without loading (DLPU011, "Pattern Sequence Background"). Whether a start after a stop does so, too,
no document says; so it is taken to load, unless the rig file says otherwise (`image_kept_s`).

Which way the current goes. TI's own sources for the LightCrafter 4500 (lcr4500.cpp in the DLP SDK) send 255 less the
current; the manual has it the other way. 5 % taken for the wrong sense is 95 %. So until the rig file tells, the
registers stand at half, which is the same in both, and the light is on for a twelfth of the time: 4.2 % on average.

Untested on metal. All of it was tested against a peer that speaks the protocol below a kernel's hidraw node; what the
peer knows is what TI's documents and TI's own sources say, as each module's docstring cites. To be watched on the first
day: light between a stop and a start (a held pattern may blink once a second), the polarity of the trigger output, and
how long a picture takes from the flash to the mirrors (`image_load_s`; `slrig latency` measures).

The DLPC900 (LightCrafter 6500, 9000) frames its commands alike, but has other pattern tables: `drivers.dlpc900`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle.validation import checked
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc350.options.Dlpc350EngineOptions`.
    folder
        The rig file's own: the path of the flashed pictures' list counts from there.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message, or the list of the flashed pictures has.
    DeviceGoneError
        The engine is not plugged in.
    DeviceBusyError
        Another program holds it.
    UnsupportedByDeviceError
        Its flash does not hold what the list says, or it does not take a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        It may not be opened, or failed.
    """
    from drivers.dlpc350.flash import read_flash_list
    from drivers.dlpc350.options import Dlpc350EngineOptions
    from drivers.dlpc350.projector import DLPC350, Dlpc350Projector
    from drivers.pattern_engine.usb import choose_engine, find_engines, open_link, require_hidraw

    require_hidraw(DLPC350)
    table = checked(Dlpc350EngineOptions, options, "the [projector] table of a light engine")
    flash = read_flash_list(folder / table.patterns)
    node = choose_engine(table.device, find_engines(DLPC350))
    return Dlpc350Projector(open_link(node.path, DLPC350), table, flash, serial=node.name)


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the light engines that are plugged in. None of them is opened.

    Raises
    ------
    WrongSystemError
        This is not Linux.
    """
    from drivers.dlpc350.projector import DLPC350
    from drivers.pattern_engine.usb import list_devices

    return list_devices(DLPC350)

"""Light engines with TI's controller DLPC350 over USB: the LightCrafter 4500, and boards with the same controller.

Linux only: the engine is a HID device (0451:6401), reached through /dev/hidraw*. Needs no library.

Patterns. The engine's mirrors are an array of 912 columns and 1140 rows, each on or off: this is the declared size, and
pictures are never scaled. Patterns come from the engine's own flash, where 24 of them are the bit planes of one picture
(`drivers.dlpc350.flash`): this driver writes the pictures and keeps a list of them, TI's program flashes them. The
engine cannot return its pictures, but it reports their number and a name (tag); both are compared with the list. That
each frame shows its pattern is verified from the frames, as in every scan. The video input (HDMI) is not used, because
the picture in the engine's buffer is unknown.

Geometry. The mirrors are rotated by 45°. Column c of row r is at x = c + ½·(r mod 2), y = r/2, in units of a mirror's
diagonal (10.8 µm). A column's edge zigzags by half a column from row to row, and its centre is at c + ¼ for every
column. A calibration for 912 x 1140 pixels accounts for this: its fy is twice its fx, and its cx is shifted by ¼.

Sequences. Commands are sent in the order stop, set, validate, start, with the waits of TI's programs
(`drivers.pattern_engine.patience`). `play` shows the loaded sequence once, with a pulse on TRIG_OUT_1 per pattern.
`show` plays a sequence of one pattern, which ends on its own within 2 s; while this program runs, it restarts it once a
second, with the LEDs off meanwhile, for at most `hold_s`. Dark means: sequence stopped and every LED off.

Tables. All patterns of a sequence have the same times, so the table without times of their own is used (trigger mode
1), as in TI's demonstration of the controller (main.c, `Demo_PatternSequenceLegacy`). TI's DLP SDK uses the other one
(mode 3, commands 0x1A3E to 0x1A40), which holds more patterns, and serves no purpose here. Public programs use either.

Speed. A show takes a dozen commands of some 3 ms, 20 ms of waits if the table changes, and the loading time of a
picture from the flash: 200 ms at worst, less for simple pictures; TI's program shows it. The engine's buffer holds two
pictures, and a running sequence repeats from there without loading (DLPU011, "Pattern Sequence Background"). It is not
documented whether this holds for a start after a stop; it is assumed to load, unless the rig file states otherwise
(`image_kept_s`).

LED current. TI's own sources for the LightCrafter 4500 (lcr4500.cpp in the DLP SDK) send 255 minus the current; the
manual has it the other way round. 5 % with the wrong polarity is 95 %. Until the rig file gives the polarity, the
registers are set to half, which is the same for both, and the light is on for a twelfth of the time: 4.2 % on average.

Untested on hardware; tested against a simulated device that implements TI's documents and sources below a kernel's
hidraw node. To be checked on hardware: how long a held pattern is dark once a second, the polarity of the trigger
output, and the loading time of a picture (`image_load_s`; `slrig latency` measures it).

The DLPC900 (LightCrafter 6500, 9000) frames its commands alike, but has other pattern tables: `drivers.dlpc900`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc350.engine.Dlpc350EngineOptions`.
    folder
        Folder of the rig file: the path of the list of flashed pictures is relative to it.

    Raises
    ------
    ConfigError
        The options or the list of the flashed pictures have faults, all of them in one message.
    DeviceGoneError
        The engine is not plugged in.
    DeviceBusyError
        Another program holds it.
    UnsupportedByDeviceError
        Its flash does not match the list, or it does not accept a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        This user may not open it, or it failed.
    """
    from drivers.dlpc350.engine import Dlpc350EngineOptions
    from drivers.dlpc350.flash import read_flash_list
    from drivers.dlpc350.projector import DLPC350, Dlpc350Projector
    from drivers.pattern_engine.usb import choose_engine, find_engines, open_link, require_hidraw

    require_hidraw(DLPC350)
    table = validate(Dlpc350EngineOptions, options, "the [projector] table of a light engine")
    flash = read_flash_list(folder / table.patterns)
    node = choose_engine(table.device, find_engines(DLPC350))
    return Dlpc350Projector(open_link(node.path, DLPC350), table, flash, serial=node.name)


def find_devices() -> tuple[FoundDevice, ...]:
    """List the light engines that are plugged in. Opens none. Raises WrongSystemError unless this is Linux."""
    from drivers.dlpc350.projector import DLPC350
    from drivers.pattern_engine.usb import list_devices

    return list_devices(DLPC350)

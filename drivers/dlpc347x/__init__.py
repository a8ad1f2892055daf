"""Light engines with TI's controllers DLPC3470 and DLPC3478 over I²C: the light-control modules of DLP2010 and DLP3010.

Linux only: the engine is at an address of a bus that the kernel has (/dev/i2c-*, e.g. a Raspberry Pi's). Needs no
library. TI's evaluation modules have a USB port beside it, through a bridge and its vendor's library: not used here.

What is established, and from what. Commands, lengths and bits: TI's programmer's guides and TI's own sources, in two of
them each but what `drivers.dlpc347x.engine` names. The block of patterns in the flash: two editions of TI's source. How
it is written: the guide (DLPU075B §3, "update internal pattern data"). Light of 0.2 to 7.6 ms and the dark around it
(171 and 31 µs): the release notes of TI's firmware, and the engine is asked (9Dh) before anything is lit. TRIG_OUT_2 is
on while a pattern is lit: the data sheets of both. Only facts were taken.

Patterns come from the engine's flash ("internal pattern streaming"). `slrig patterns RIG` writes them there, over what
was there before, and reads them back; when the engine is opened its flash is read, so that what it holds is known from
itself and no list is kept. External pattern streaming is not used: which picture of the video is on the mirrors when
cannot be known from here.

`play` shows the loaded sequence with a pulse on TRIG_OUT_2 per pattern, and this program stops the engine at its end.
It takes sequences of one axis: how long an engine takes from one set of its flash to the next is not documented. `show`
lights one pattern again and again, 7.6 ms of 7.8, since no longer light is known: short exposures see it unsteadily, by
0.2 ms of each. A sequence is repeated a counted number of times, so it ends by itself: what is shown 2 s after its host
has died, what is played after twice its length at the latest. Dark means: every LED off, read back, and the sequence
stopped.

Current. It goes to the LED driver as a number that "directly controls the LED current" (TI's header), as a share of the
most that the engine's flash states; no polarity can be set, so there is none to be found out, and no dim first light.
A board with another LED driver than TI's is not known to this driver.

Untested on metal: all of it was tested against a peer that keeps the guides' rules. To be watched on the first day:
that the firmware takes an entry of 25 bytes (older ones, of 2019, do not, and are refused with that); whether LEDs come
on after LED enables were off, and are off by them in this mode; whether all is dark after the end of a sequence;
whether a repeat counts the first time (programs of others disagree; either is allowed for); whether 1 s of dark is
allowed at the end; which side column 0 is on (`mirror_columns`); how often a flash may be written; and how long light
takes to begin (`start_s`).

The DLPC3479 (DLP4710) has two controllers, whose halves two editions of TI's source fill in two ways: it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle.validation import checked
from slrig.devices import Projector

__all__ = ["open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:  # noqa: ARG001 - no path is in them
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc347x.options.Dlpc347xEngineOptions`.
    folder
        The rig file's own.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        There is no such bus, or nobody answers at the address.
    DeviceBusyError
        Another program, or a driver of the kernel, has it.
    UnsupportedByDeviceError
        It is another controller, or does not take a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        It may not be opened, or failed.
    """
    from drivers.dlpc347x.bus import open_bus
    from drivers.dlpc347x.options import Dlpc347xEngineOptions
    from drivers.dlpc347x.projector import Dlpc347xProjector
    from drivers.linux import require_linux

    require_linux("dlpc347x", through="the kernel's /dev/i2c-*", instead="run slrig on Linux for it")
    table = checked(Dlpc347xEngineOptions, options, "the [projector] table of a light engine")
    return Dlpc347xProjector(open_bus(Path(table.device), table.address), table)

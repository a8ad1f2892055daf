"""Light engines with TI's controllers DLPC3470 and DLPC3478 over I²C (experimental): modules of DLP2010 and DLP3010.

Experimental: untested on hardware; tested against a simulated device that keeps the rules of the guides.

Linux only: the engine is at an address of a kernel's bus (/dev/i2c-*, e.g. of a Raspberry Pi). Needs no library. The
USB port of TI's evaluation modules needs its vendor's library and is not used.

Sources. Commands, lengths and bits: TI's programmer's guides and TI's own sources, in both of them except as noted in
`drivers.dlpc347x.engine`. The block of patterns in the flash: two editions of TI's source. Writing it: the guide
(DLPU075B §3, "update internal pattern data"). Light of 0.2 to 7.6 ms and the dark around it (171 and 31 µs): the
release notes of TI's firmware, and the engine is queried (9Dh) before anything is lit. TRIG_OUT_2 is on while a pattern
is lit: the data sheets of both.

Patterns come from the engine's flash ("internal pattern streaming"). `slrig patterns RIG` overwrites its patterns and
verifies them; when the engine is opened its flash is read, so no list is kept. External pattern streaming is not used:
the time at which a video picture is on the mirrors cannot be known.

`play` shows the loaded sequence with a pulse on TRIG_OUT_2 per pattern, and this program stops the engine at its end.
It takes sequences of one axis: the time from one set of its flash to the next is not documented. `show` lights one
pattern repeatedly, 7.6 ms of 7.8, the longest documented light: short exposures may lose 0.2 ms of it. A sequence has a
counted number of repeats, so it ends on its own: 2 s after the end of its host for `show`, after twice its length at
most for `play`. Dark means: every LED off, read back, and the sequence stopped.

LED current. The number that "directly controls the LED current" (TI's header) is set as a fraction of the maximum in
the engine's flash; its polarity cannot be inverted, so there is no dim first light. Boards with another LED driver than
TI's are not supported.

To be checked on hardware: that the firmware takes an entry of 25 bytes (older ones, of 2019, do not, and are refused
with that reason); whether LEDs come on after LED enables were off, and are off by them in this mode; whether all is
dark after the end of a sequence; whether a repeat counts the first time (third-party programs differ; either is allowed
for); whether 1 s of dark is allowed at the end; the side of column 0 (`mirror_columns`); how often a flash may be
written; and the delay of the light (`start_s`).

The DLPC3479 (DLP4710) has two controllers, whose halves two editions of TI's source fill differently: it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import Projector

__all__ = ["open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:  # noqa: ARG001 - the options have no path
    """Open a light engine from a rig file's `[projector]` table (without its `driver`). It is dark afterwards.

    Parameters
    ----------
    options
        `drivers.dlpc347x.engine.Dlpc347xEngineOptions`.
    folder
        Folder of the rig file, not used.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        The bus does not exist, or no device answers at the address.
    DeviceBusyError
        Another program, or a driver of the kernel, has it.
    UnsupportedByDeviceError
        It is another controller, or does not accept a setting.
    WrongSystemError
        This is not Linux.
    DeviceError
        This user may not open it, or it failed.
    """
    from drivers.dlpc347x.bus import open_bus
    from drivers.dlpc347x.engine import Dlpc347xEngineOptions
    from drivers.dlpc347x.projector import Dlpc347xProjector
    from drivers.linux import require_linux

    require_linux("dlpc347x", through="the kernel's /dev/i2c-*", instead="run slrig on Linux for it")
    table = validate(Dlpc347xEngineOptions, options, "the [projector] table of a light engine")
    return Dlpc347xProjector(open_bus(Path(table.device), table.address), table)

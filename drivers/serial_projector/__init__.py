"""Trigger boxes on a serial port: a light engine that steps through patterns in its flash, cameras by wire, SLTP/1.

    [projector]
    driver = "serial_projector"
    port = "usb-MicroPython_Board_in_FS_mode_e66-if00"     # as slrig devices lists it; other options: options.py

The protocol below is sufficient to write firmware for another box. `device/` has a reference in MicroPython, and
`device/arduino/` the same in C.

The line
--------
8 bits, no parity, one stop bit, 115200 baud unless agreed otherwise; USB (CDC-ACM) has no baud rate. The host opens the
port exclusively and leaves DTR raised. Many boards restart when DTR rises, so the host repeats HELLO for some
seconds; the box must tolerate half a line before it, the host a boot message.

A line is printable ASCII, words separated by one space, at most 240 bytes, and ends with LF (a preceding CR is
ignored). Its last five bytes are `*` and a checksum of everything before it in four hexadecimal digits (capitals):
CRC-16/CCITT-FALSE, polynomial 0x1021, initial value 0xFFFF, neither reflected nor inverted; "123456789" gives 29B1.

    host    <session> <number> <verb> <numbers>*<crc>
    box     <session> <number> OK <words>*<crc>             executed
            <session> <number> ERR <code> <words>*<crc>     refused, nothing was changed unless stated below
            ? ERR 1 bad frame*<crc>                         an invalid line was received: send it again
            ! <event> <words>*<crc>                         an event; never answered, may be lost

Exactly-once execution
----------------------
<session> is four characters that the host chooses at random when it opens the port. <number>, 0 to 9999, is increased
by one for each command, with 0 after 9999. A host that gets no answer in 150 ms (plus `light_us` if applicable) sends
the same line again, with the same number: at most 12 times, within 2.5 s. A box stores the last number and its answer.
The same number again: it repeats that answer, and does nothing else. A number up to 4999 ahead: a new command. Any
other: ERR 3. A line lost in either direction therefore costs time, and never shows a pattern twice.

Only HELLO begins a session. While it is active (lines of its host were received within the watchdog time), every line
of another session is answered with ERR 5, including HELLO. Without a session, all verbs except HELLO are answered with
ERR 8.

Verbs
-----
Numbers are decimal integers, crc32 is hexadecimal. *dark* : the verb switches the light off, ends any activity, and
acknowledges a fault, before it is answered, even with an error.

    HELLO version watchdog_ms on_ms duty bright    dark; begins a session, nothing is loaded. OK and <key>=<value> words
                                                   in any order; a host ignores unknown keys.
    PING                                           OK <µs> <state> <fault>; µs since the box started
    PICK at crc32 crc32 …                          dark, nothing is loaded; these are the patterns <at>, <at> + 1 … of
                                                   the next LOAD, at any position in the flash. Restarts at 0, and
                                                   continues without a gap. OK <picked so far> <those of this line that
                                                   the box lacks> …
    LOAD count crc32                               dark; OK <count> <first> <gap_us>; loads the picked patterns, or else
                                                   a run of that length, with that checksum. The first one is <first> of
                                                   the flash. ERR 9 <available> <crc32 of all> if neither matches
    SHOW index                                     OK <index> <µs>, once it is lit, since µs; it stays lit. The previous
                                                   pattern is switched off first.
    SEQ first count exposure_us period_us mode     OK <µs> of the first light. mode 0: the box lights one pattern each
                                                   period; mode 1: one at each TRIG. It is lit, a pulse goes to the
                                                   cameras, and it is switched off exposure_us + hold_us later.
    TRIG                                           OK <index> <µs>; the next pattern of a sequence of mode 1
    STOP                                           dark; OK <patterns of the last sequence that were lit>
    BLANK                                          dark; OK
    STATUS                                         OK state= loaded= first= index= frames= shows= fault= t_us=, without
                                                   index= before the first light
    BYE                                            dark; ends the session; nothing is loaded; OK

HELLO's version is 1. The other numbers are limits for the session; the box may grant lower ones, never higher.
watchdog_ms (50 or more): the host's longest silence. on_ms: longest light of one pattern. duty: permille of light in
any 10 s (with a tolerance of 2 %, since boxes switch with a delay). bright: permille of full power; a box that cannot
dim so far answers ERR 4 bright 1000. Its answer contains

    sltp=1 model= fw=            protocol, and two words of the manufacturer
    w= h= max=                   size in pixels; number of patterns in its flash, 0 if empty
    boot=                        eight hexadecimal digits that change with each start
    watchdog_ms= on_ms= duty= bright=       the granted limits
    light_us= error_us=          longest time from a command to its light; error of its time stamps
    gap_us= hold_us= least_us=   least time from one exposure's end to the next; how long a pattern of a sequence stays
                                 lit beyond its exposure; shortest exposure
    pick=                        maximum patterns of PICK; a box without this word has no PICK, and loads runs only
    pulse=exposure               the cameras' pulse lasts as long as the exposure, for cameras that expose for its
                                 length, and ends with the light at the latest; without this word it has a length of
                                 the box's own

gap_us in HELLO is for patterns in the order of the flash; LOAD returns that of the sequence, longer if it steps back.

States and events
-----------------
    idle      nothing loaded, dark               LOAD -> ready
    ready     dark                               SHOW -> lit, SEQ -> playing or waiting
    lit       a pattern is lit                   SHOW -> lit, SEQ
    playing   a sequence of mode 0 runs          its end -> ready
    waiting   a sequence of mode 1, from its beginning to its end; lit and dark

    ! FRAME index µs    a pattern of a sequence is lit since µs ! DONE count        a sequence has ended, dark ! FAULT
    code        the box switched the light off on its own, and is ready (or idle)

A fault stays until a *dark* verb acknowledges it: SHOW, SEQ and TRIG are refused until then, so that a host
cannot miss it. 1: no line of the session for watchdog_ms while lit, playing or waiting. 2: on_ms exceeded. 3: duty
exceeded. 4: the light engine failed; a box that cannot switch its light off keeps trying.

Errors: 1 invalid line (see above). 2 unknown verb. 3 not in this state, or an old number. 4 a number out of range.
5 busy, another session is active. 6 the light engine failed: dark, fault 4. 7 <fault> dark by an unacknowledged fault.
8 no such session: send HELLO. 9 other patterns. 10 a limit: more light than duty allows.

Behaviour of the host
---------------------
It sends PING five times per watchdog_ms while the port is open, lit or not, and stops when a command fails and darkness
is not confirmed, so that the watchdog switches the light off. ERR 8 in the middle of a session means that the box
restarted (another boot) or that another host used it. If it was dark, the host sends HELLO and LOAD again and
continues; if it was lit, frames may be dark, and the scan ends with DeviceGoneError, as after an unplugged cable.

The box's time stamps are converted to the host's clock with guaranteed bounds: a stamped instant is between the first
byte of a command and its answer. The box's clock may have a steady error of 1000 ppm; the bounds tighten as PINGs are
further apart.

A pattern's checksum is the CRC-32 (zlib's) of its image, a byte per pixel, row by row from the top left, 0 dark, 255
lit. The checksum in LOAD is the CRC-32 of those of its patterns, in order, four bytes each, most significant first.
`slrig patterns` writes the images of all patterns of a rig, and the checksums as patterns.json, for flashing.

A session
---------
A box of 4 x 2 pixels that holds white (2144DF1C), black (6522DF69) and a left half (B1C2A1A3). At the left is the box's
own clock, µs; `>` is to the box, `<` from it, and a line that begins with `|` continues the previous one after a space.

       1000 > 1A2B 1 HELLO 1 2000 60000 1000 1000*0F42
            < 1A2B 1 OK sltp=1 model=example fw=1.0 w=4 h=2 max=3 boot=00C0FFEE watchdog_ms=2000 on_ms=60000
            | duty=1000 bright=1000 light_us=2000 error_us=50 gap_us=3000 hold_us=500 least_us=200 pick=512
            | pulse=exposure*6739
       2000 > 1A2B 2 PING*8724
            < 1A2B 2 OK 2000 idle 0*2536
       3000 > 1A2B 3 LOAD 3 027B77B3*9533
            < 1A2B 3 OK 3 0 3000*F858
       4000 > 1A2B 4 SHOW 1*17D0
            < 1A2B 4 OK 1 4020*3A01
     154000 > 1A2B 4 SHOW 1*17D0
            < 1A2B 4 OK 1 4020*3A01
     200000 > 1A2B 5 SEQ 0 3 5000 10000 0*A611
            < 1A2B 5 OK 203000*1FBD
     203000 < ! FRAME 0 203020*FE9E
     213000 < ! FRAME 1 213020*131C
     223000 < ! FRAME 2 223020*35BB
     228520 < ! DONE 3*411E
     300000 > 1A2B 6 SHOW 0*A815
            < ? ERR 1 bad frame*C11E
     300500 > 1A2B 6 SHOW 2*A815
            < 1A2B 6 OK 2 300520*23B1
     310000 > 77F0 1 HELLO 1 2000 60000 1000 1000*C0D0
            < 77F0 1 ERR 5 held by 1A2B*7590
    2300501 < ! FAULT 1*C9ED
    2400000 > 1A2B 7 SHOW 0*CF84
            < 1A2B 7 ERR 7 1*73F1
    2400500 > 1A2B 8 BLANK*A5BB
            < 1A2B 8 OK*AD6B
    2401000 > 1A2B 9 STATUS*8E87
            < 1A2B 9 OK state=ready loaded=3 first=0 index=2 frames=3 shows=5 fault=0 t_us=2401000*22BE
    2401500 > 1A2B 10 PICK 0 B1C2A1A3 2144DF1C*ED29
            < 1A2B 10 OK 2*522A
    2401600 > 1A2B 11 LOAD 2 BC87C827*58DC
            < 1A2B 11 OK 2 2 3000*FFC5
    2401700 > 1A2B 12 SHOW 1*40D5
            < 1A2B 12 OK 1 2401720*2AF5
    2402000 > 1A2B 13 BYE*AB6E
            < 1A2B 13 OK*A571

The first answer to SHOW 1 was lost and repeated; the line to SHOW 2 was damaged. A second host was refused. The first
one was silent: the watchdog switched the light off, which it had to acknowledge. Last it picked the left half and
white, which are not consecutive in the flash.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a trigger box from a rig file's `[projector]` table (without its `driver`).

    Parameters
    ----------
    options
        `drivers.serial_projector.client.SerialProjectorOptions`.
    folder
        Folder of the rig file: `export_folder` is relative to it.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        pyserial is not installed.
    DeviceGoneError
        The port does not exist.
    DeviceBusyError
        Another program holds the port, or another host is in a session with the box.
    UnsupportedByDeviceError
        The box cannot keep to the limits.
    DeviceError
        No answer in SLTP/1, or this user may not open the port.
    """
    from drivers.serial_port import SerialPort
    from drivers.serial_projector.client import SerialProjectorOptions
    from drivers.serial_projector.projector import SerialProjector

    table = validate(SerialProjectorOptions, options, "the [projector] table of a serial projector")

    def open_port() -> SerialPort:
        return SerialPort(table.port, baud=table.baud, device="trigger box", driver="serial_projector")

    return SerialProjector(open_port, table, export_folder=folder / table.export_folder)


def find_devices() -> tuple[FoundDevice, ...]:
    """List the USB serial ports without opening them. Raises LibraryMissingError."""
    from drivers.serial_projector.link import find_ports

    return find_ports()

"""Trigger boxes on a serial port: a light engine that steps through patterns in its flash, cameras by wire, SLTP/1.

    [projector]
    driver = "serial_projector"
    port = "usb-MicroPython_Board_in_FS_mode_e66-if00"     # as slrig devices lists it; see options.py for the rest

Below is the protocol, enough to write firmware for a box of one's own. `device/` has a reference in MicroPython.

The line
--------
8 bits, no parity, one stop bit, 115200 baud unless agreed otherwise; USB (CDC-ACM) has no baud rate. The host opens the
port exclusively and leaves DTR raised. Many boards restart when DTR rises, so the host says HELLO again and again for
some seconds; the box must cope with half a line before it, the host with a boot message.

A line is printable ASCII, words with one space between them, at most 240 bytes, and ends with LF (CR before it is
passed over). Its last five bytes are `*` and a checksum of all before it in four hexadecimal digits (capitals):
CRC-16/CCITT-FALSE, polynomial 0x1021, begun with 0xFFFF, neither reflected nor inverted; "123456789" gives 29B1.

    host    <session> <number> <verb> <numbers>*<crc>
    box     <session> <number> OK <words>*<crc>             obeyed
            <session> <number> ERR <code> <words>*<crc>     not obeyed, nothing was changed unless it is said below
            ? ERR 1 bad frame*<crc>                         a line came that is no line: send it again
            ! <event> <words>*<crc>                         something happened; never answered, may be lost

Once, and only once
-------------------
<session> is four characters that the host chooses at random when it opens the port. <number>, 0 to 9999, is one more
for each command, and 0 after 9999. A host that gets no answer in 150 ms (longer for what `light_us` allows) sends the
same line again, with the same number: 12 times at most, within 2.5 s. A box remembers the number that came last and
what it answered. The same number again: it sends that answer again, and does nothing. A number up to 4999 ahead: a new
command. Any other: ERR 3. So a line that is lost on either way costs time, and never moves a pattern twice.

Only HELLO makes a session. While it lives (its host was heard within its watchdog's time), every line of another one
is answered with ERR 5, HELLO too. Without a session, all but HELLO are answered with ERR 8.

Verbs
-----
Numbers are decimal and whole, crc32 is hexadecimal. *dark* : the verb puts the light out, ends what goes on, and
acknowledges a fault, before it is answered, even with an error.

    HELLO version watchdog_ms on_ms duty bright    dark; begins a session, nothing is loaded. OK and <key>=<value> words
                                                   in any order; a host passes over keys that it does not know.
    PING                                           OK <µs> <state> <fault>; µs since the box started
    PICK at crc32 crc32 …                          dark, nothing is loaded; these are the patterns <at>, <at> + 1 … of
                                                   the next LOAD, wherever they lie in the flash. Begins anew at 0, and
                                                   goes on without a gap. OK <picked so far> <those of this line that
                                                   the box does not hold> …
    LOAD count crc32                               dark; OK <count> <first> <gap_us>; the patterns that were picked, or
                                                   else a run of that length, if they have that checksum. The first one
                                                   is <first> of the flash. ERR 9 <held> <crc32 of all> if neither has
    SHOW index                                     OK <index> <µs>, once its light is on the scene, since µs; it stays.
                                                   What was lit before is put out first.
    SEQ first count exposure_us period_us mode     OK <µs> of the first light. mode 0: the box lights one pattern each
                                                   period; mode 1: one at each TRIG. It is lit, a pulse goes to the
                                                   cameras, and it is put out exposure_us + hold_us later.
    TRIG                                           OK <index> <µs>; the next pattern of a sequence of mode 1
    STOP                                           dark; OK <patterns of the last sequence that were lit>
    BLANK                                          dark; OK
    STATUS                                         OK state= loaded= first= index= frames= shows= fault= t_us=, without
                                                   index= before the first light
    BYE                                            dark; ends the session; nothing is loaded; OK

HELLO's version is 1. The other numbers are limits that the box keeps to from then on; it grants less if it must, and
never more. watchdog_ms (50 or more): the host's longest silence. on_ms: how long one pattern may be lit. duty: permille
of any 10 s in which there may be light (2 % more before it is put out: no box switches without a delay). bright:
permille of full power; a box that cannot go so low answers ERR 4 bright 1000. Its answer tells

    sltp=1 model= fw=            protocol, and two words of the maker's
    w= h= max=                   extent in pixels; how many patterns are in its flash, 0 for none yet
    boot=                        eight hexadecimal digits that differ from start to start
    watchdog_ms= on_ms= duty= bright=       the limits that it keeps to
    light_us= error_us=          longest time from a command to its light; error of its time stamps
    gap_us= hold_us= least_us=   least time from one exposure's end to the next; how long a pattern of a sequence stays
                                 lit beyond its exposure; shortest exposure
    pick=                        how many patterns PICK takes; a box without this word has no PICK, and holds runs only

gap_us in HELLO is for patterns in the order of the flash; LOAD answers that of the sequence, longer where it goes back.

States and events
-----------------
    idle      nothing loaded, dark               LOAD -> ready
    ready     dark                               SHOW -> lit, SEQ -> playing or waiting
    lit       a pattern is lit until told        SHOW -> lit, SEQ
    playing   a sequence of mode 0 runs          its end -> ready
    waiting   a sequence of mode 1, from its beginning to its end; lit and dark

    ! FRAME index µs    a pattern of a sequence is lit since µs
    ! DONE count        a sequence has ended, dark
    ! FAULT code        the box put the light out by itself, and is ready (or idle)

A fault stays until a verb that is dark acknowledges it: SHOW, SEQ and TRIG are refused until then, so that a host
cannot miss it. 1: nothing of the session's was heard for watchdog_ms while lit, playing or waiting. 2: on_ms is over.
3: duty is used up. 4: the light engine failed; a box that cannot put its light out goes on trying.

Errors: 1 no line (see above). 2 unknown verb. 3 not in this state, or an old number. 4 a number out of range.
5 busy, another session lives. 6 the light engine failed: dark, fault 4. 7 <fault> dark by a fault not acknowledged yet.
8 no such session: say HELLO. 9 other patterns. 10 a limit: more light than duty allows.

What the host does with that
----------------------------
It sends PING five times per watchdog_ms while the port is open, lit or not, and stops that when a command fails and
darkness is not confirmed: then the watchdog sees to it. ERR 8 in the middle of a session means that the box restarted
(another boot) or that somebody else was there. Was it dark, the host says HELLO and LOAD again, and goes on; was
something lit, frames may be dark, and the scan ends with DeviceGoneError. So does an unplugged cable.

The box's time stamps become the host's by bounds, not by a guess: what was stamped happened between the first byte of a
command and its answer. Its clock may be 1000 ppm off, steadily; drift falls out as PINGs come to lie further apart.

A pattern's checksum is the CRC-32 (zlib's) of its image, a byte per pixel, row by row from the top left, 0 dark, 255
lit. The checksum in LOAD is the CRC-32 of those of its patterns, in order, four bytes each, most significant first.
`slrig patterns` writes the images of all that a rig shows, and the checksums as patterns.json, once, for flashing.

A session
---------
A box of 4 x 2 pixels that holds white (2144DF1C), black (6522DF69) and a left half (B1C2A1A3). At the left the box's
own clock, µs; `>` to the box, `<` from it, a line that begins with `|` goes on, after a space, with the one before it.

       1000 > 1A2B 1 HELLO 1 2000 60000 1000 1000*0F42
            < 1A2B 1 OK sltp=1 model=example fw=1.0 w=4 h=2 max=3 boot=00C0FFEE watchdog_ms=2000 on_ms=60000
            | duty=1000 bright=1000 light_us=2000 error_us=50 gap_us=3000 hold_us=500 least_us=200 pick=512*DC8B
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

The first answer to SHOW 1 was lost, and came again; the line to SHOW 2 was damaged. A second host was turned away. The
first one fell silent: its watchdog put the light out, and it had to acknowledge that. Last it picked the left half and
white, which do not lie so in the flash.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle.validation import checked
from slrig.devices import FoundDevice, Projector

__all__ = ["find_devices", "open_projector"]


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a trigger box from a rig file's `[projector]` table (without its `driver`).

    Parameters
    ----------
    options
        `drivers.serial_projector.options.SerialProjectorOptions`.
    folder
        The rig file's own: `export_folder` counts from there.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        pyserial is not installed.
    DeviceGoneError
        There is no such port.
    DeviceBusyError
        Another program holds the port, or another host is in a session with the box.
    UnsupportedByDeviceError
        The box cannot keep to the limits.
    DeviceError
        Nothing on the port speaks SLTP/1, or it may not be opened.
    """
    from drivers.serial_port import SerialPort
    from drivers.serial_projector.options import SerialProjectorOptions
    from drivers.serial_projector.projector import SerialProjector

    table = checked(SerialProjectorOptions, options, "the [projector] table of a serial projector")

    def open_port() -> SerialPort:
        return SerialPort(table.port, baud=table.baud, device="trigger box", driver="serial_projector")

    return SerialProjector(open_port, table, export_folder=folder / table.export_folder)


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the USB serial ports; opens none of them. Raises LibraryMissingError."""
    from drivers.serial_projector.link import find_ports

    return find_ports()

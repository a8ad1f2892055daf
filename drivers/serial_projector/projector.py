"""A trigger box as a projector: patterns in its flash, light by command, and darkness in case of doubt."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from drivers.serial_port import BytePort
from drivers.serial_projector.client import (
    BoxClient,
    BoxLimits,
    KeepAlive,
    SerialProjectorOptions,
    pattern_checksums,
    sequence_checksum,
)
from drivers.serial_projector.link import BoxFault, BoxLink, BoxRefusedError, RefusalCode, SequenceMode
from slrig.devices import Clock, DisplayedPattern, ProjectorInfo, ProjectorState, SystemClock
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

DESCRIPTION, HEADER = "patterns.json", "patterns.h"
"""Files that describe a pattern set to a box: the Pico reads the first, the Arduino's program is compiled with the
other.
"""

_FAULTS = {
    BoxFault.WATCHDOG: "it received nothing from this host for watchdog_s: the host was too busy or the cable is bad; "
    "raise watchdog_s in the rig file, or give the host less to do",
    BoxFault.ON_TIME: "a pattern was lit for max_on_s without another request; raise max_on_s in the rig file "
    "if the light may be on for longer",
    BoxFault.DUTY: "max_duty of light in 10 s was reached; raise max_duty in the rig file, or wait between scans",
    BoxFault.LIGHT: "its light engine failed; check its cables and power",
}
_Value = TypeVar("_Value")


class SerialProjector:
    """Implements `slrig.devices.Projector` on a box that speaks SLTP/1.

    A thread of the driver feeds the box's watchdog. When a command fails and the box does not confirm that it is dark,
    that thread stops, and the watchdog switches the light off.

    open_port : opens the port, at first and after the box was unplugged while dark; the projector closes it.
    export_folder : folder for `write_patterns`. clock : the rig's.
    """

    def __init__(
        self,
        open_port: Callable[[], BytePort],
        options: SerialProjectorOptions,
        *,
        export_folder: Path,
        clock: Clock | None = None,
    ) -> None:
        self._open_port = open_port
        self._clock = clock or SystemClock()
        self._options = options
        self._export_folder = export_folder
        limits = BoxLimits(
            watchdog_ms=round(options.watchdog_s * 1000),
            on_ms=round(options.max_on_s * 1000),
            duty=round(options.max_duty * 1000),
            bright=round(options.brightness * 1000),
        )
        port = open_port()
        link = BoxLink(port, options.reply_s, options.deadline_s, clock=self._clock)
        try:
            self._client = BoxClient(link, limits, label=options.port, open_s=options.open_s)
        except BaseException:
            port.close()
            raise
        box = self._client.box
        self._size = Size(box.w, box.h)
        self._info = ProjectorInfo(
            name="projector",
            model=f"{box.model} {box.fw}",
            serial=options.port,
            size=self._size,
            plays=True,
            latency_s=box.light_s,
            gap_s=box.gap_us / 1e6,
            duty=box.duty / 1000,
            pulses_expose=box.pulse == "exposure",
        )
        self._boot = box.boot
        self._state = ProjectorState(f"the trigger box on {options.port}")
        self._checksums: tuple[int, ...] = ()
        self._lit: str | None = None
        self._keep_alive = KeepAlive(self._client, watchdog_s=box.watchdog_ms / 1000, clock=self._clock)

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    @property
    def client(self) -> BoxClient:
        """The session with the box, for functions beyond `Projector`."""
        return self._client

    @property
    def played_patterns(self) -> tuple[DisplayedPattern, ...]:
        """Times at which the patterns of the last `play` became visible, as far as the box's events were received."""
        return tuple(DisplayedPattern(*frame) for frame in self._client.frames())

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. The box must hold these patterns: their checksums are compared. Raises
        UnsupportedByDeviceError if patterns are missing, or the sequence has another size, or is too long.
        """
        self._state.require_open()
        self._state.loaded = None
        self.blank()
        self._state.require_size(sequence, self._size)
        self._checksums = pattern_checksums(sequence)
        try:
            missing = self._send(lambda: self._client.load(self._checksums))
        except UnsupportedByDeviceError as error:
            missing, reason = tuple(range(len(sequence))), f"it supports only runs of its flash ({error})"
        else:
            reason = f"it lacks {len(missing)} of them, pattern {missing[0]} first" if missing else ""
        if missing:
            message = (
                f"requested {len(sequence)} patterns, the trigger box on {self._options.port} holds "
                f"{self._client.box.max}: {reason}. Flash it once with all patterns of this rig: slrig patterns RIG "
                f"writes them into {self._export_folder}"
            )
            raise UnsupportedByDeviceError(message)
        self._state.loaded = sequence

    def write_patterns(self, sequence: PatternSequence) -> str:
        """See `StoredPatternProjector`. Writes each set into its own folder."""
        self._state.require_size(sequence, self._size)
        crc32 = sequence_checksum(pattern_checksums(sequence))
        folder = self._export_folder / f"{crc32:08X}"
        export_patterns(sequence, folder)
        return (
            f"{len(sequence)} images, {DESCRIPTION} and {HEADER} are in {folder}: put the images into the light "
            f"engine's memory, in the order of their numbers, and {DESCRIPTION} onto the box (a Pico), or {HEADER} "
            "next to its main.c (an Arduino)"
        )

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. The instant is the box's own time stamp; its error comes from the exchanges with its
        clock.
        """
        self._state.require_pattern(index)
        with self._darken_on_error():
            t_visible_ns, t_err_ns = self._send(lambda: self._client.show(index))
            self._lit = f"pattern {index} was lit"
            self._clock.wait_until(t_visible_ns + t_err_ns, self._state.closed)
        return DisplayedPattern(index, t_visible_ns, t_err_ns)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Returns when the box has begun; the sequence ends dark."""
        count = len(self._state.require_loaded("play"))
        exposure_us, period_us = round(exposure_s * 1e6), round(period_s * 1e6)
        self._check_timing(exposure_us, period_us)
        with self._darken_on_error():
            # Detect a restart before the sequence begins.
            self._send(self._client.ping)
            self._lit = "a sequence played"
            self._send(lambda: self._client.sequence(0, count, exposure_us, period_us, SequenceMode.FREE))

    def stop(self) -> None:
        """See `Projector`."""
        self._darken(self._client.stop)

    def blank(self) -> None:
        """See `Projector`. Raises DeviceError if the box does not confirm it; then its watchdog puts the light out."""
        self._darken(self._client.blank)

    def close(self) -> None:
        """See `Projector`."""
        self._state.closed.set()
        self._client.close()
        self._keep_alive.stop()
        self._state.loaded = self._lit = None

    def _darken(self, command: Callable[[], object]) -> None:
        if self._state.closed.is_set():
            return
        try:
            self._send(command)
        except BaseException as error:
            self._abandon()
            if self._state.closed.is_set() and isinstance(error, DeviceStateError):
                # Closed by another thread meanwhile, and dark.
                return
            raise
        finally:
            self._lit = None

    @contextmanager
    def _darken_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._lit = None
            try:
                self._client.blank()
            except Exception:  # noqa: BLE001 - the original error is raised
                self._abandon()
            raise

    def _abandon(self) -> None:
        """Leave the box to its watchdog until a sequence is loaded again."""
        self._state.loaded = None
        self._client.abandon()

    def _send(self, command: Callable[[], _Value]) -> _Value:
        """Send a command; if the box restarted while dark, greet it, load again, and repeat the command once."""
        try:
            return self._run_command(command)
        except _RestartedError:
            # Repeat it below.
            pass
        except DeviceGoneError:
            # Unplugged and plugged in again while dark: nothing is lost.
            if self._lit is not None or self._state.closed.is_set():
                raise
            self._client.reconnect(self._open_port)
        try:
            self._resume_session()
            return self._run_command(command)
        except _RestartedError as error:
            message = f"the trigger box on {self._options.port} restarts repeatedly; check its power supply"
            raise DeviceGoneError(message) from error

    def _run_command(self, command: Callable[[], _Value]) -> _Value:
        """Run a command; translate refusals of the box into slrig's errors."""
        try:
            return command()
        except BoxRefusedError as refusal:
            match refusal.number:
                case RefusalCode.SESSION:
                    raise _RestartedError from refusal
                case RefusalCode.STATE:
                    raise DeviceStateError(f"{refusal}; stop its current action first") from refusal
                case RefusalCode.RANGE | RefusalCode.LIMIT | RefusalCode.PATTERNS:
                    raise UnsupportedByDeviceError(str(refusal)) from refusal
                case RefusalCode.BUSY:
                    message = (
                        f"another host took over the trigger box on {self._options.port} ({refusal}); end that one"
                    )
                    raise DeviceBusyError(message) from refusal
                case RefusalCode.FAULT:
                    raise DeviceError(_fault_message(self._options.port, refusal.words)) from refusal
                case _:
                    raise

    def _resume_session(self) -> None:
        """Greet and load a box that lost its session. Raises DeviceGoneError if it was lit."""
        lit, self._lit = self._lit, None
        box = self._client.greet()
        event = "restarted" if box.boot != self._boot else "was taken over by another host"
        boots = f"boot {self._boot}, now {box.boot}"
        if lit is not None:
            message = (
                f"the trigger box on {self._options.port} {event} ({boots}) while {lit}: frames since then may be "
                "dark; check its power supply and cable, open the rig again, and scan again"
            )
            raise DeviceGoneError(message)
        if (box.w, box.h) != (self._size.width_px, self._size.height_px):
            message = (
                f"the trigger box on {self._options.port} {event} ({boots}) and projects {box.w} x {box.h} instead of "
                f"{self._size}; open the rig again"
            )
            raise DeviceGoneError(message)
        self._boot = box.boot
        if self._state.loaded is not None and self._run_command(lambda: self._client.load(self._checksums)):
            message = f"the trigger box on {self._options.port} {event} and holds other patterns; load them again"
            raise DeviceGoneError(message)

    def _check_timing(self, exposure_us: int, period_us: int) -> None:
        box = self._client.box
        lit_us = exposure_us + box.hold_us
        requested = f"requested {exposure_us / 1e6:.6g} s exposures every {period_us / 1e6:.6g} s"
        for fits, found, remedy in (
            (exposure_us >= box.least_us, f"at least {box.least_us / 1e6:.6g} s", "expose for longer"),
            (
                period_us >= exposure_us + self._client.gap_us,
                f"at least {self._client.gap_us / 1e6:.6g} s between exposures",
                "lengthen the exposure: the period grows with it",
            ),
            (lit_us <= box.on_ms * 1000, f"at most {box.on_ms / 1000:.6g} s of light (max_on_s)", "raise max_on_s"),
            (
                lit_us * 1000 <= box.duty * period_us,
                f"light for {lit_us / period_us:.1%} of the time, where {box.duty / 1000:.1%} are allowed (max_duty)",
                "raise max_duty if the light may be on for so long",
            ),
        ):
            if not fits:
                message = f"{requested}, the trigger box on {self._options.port} gives {found}; {remedy}"
                raise UnsupportedByDeviceError(message)


class _RestartedError(DeviceError):
    """The box no longer knows the session."""


def _fault_message(port: str, words: tuple[str, ...]) -> str:
    reasons = {str(fault.value): reason for fault, reason in _FAULTS.items()}
    reason = reasons.get(words[0] if words else "", f"unknown fault {' '.join(words)}")
    return f"the trigger box on {port} went dark on its own: {reason}. Frames since then may be dark; scan again"


def export_patterns(sequence: PatternSequence, folder: Path) -> None:
    """Write the images for the light engine's flash, `000.png` …, and `patterns.json` and `patterns.h` for the box.

    Raises DeviceError if the folder cannot be written, UnsupportedByDeviceError if a pattern has more than 8 bits.
    """
    size = sequence.projector
    checksums = pattern_checksums(sequence)
    description = {
        "size_px": [size.width_px, size.height_px],
        "crc32": [f"{crc32:08X}" for crc32 in checksums],
        "crc32_of_all": f"{sequence_checksum(checksums):08X}",
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(len(sequence)):
            encoded, png = cv2.imencode(".png", np.ascontiguousarray(sequence.image(index)))
            if not encoded:
                message = f"pattern {index} could not be encoded as PNG; report it"
                raise DeviceError(message)
            (folder / f"{index:03d}.png").write_bytes(png.tobytes())
        (folder / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
        table = ", ".join(f"0x{crc32:08X}" for crc32 in checksums)
        header = f"#define WIDTH_PX {size.width_px}\n#define HEIGHT_PX {size.height_px}\n#define PATTERNS {table}\n"
        (folder / HEADER).write_text(header, encoding="utf-8")
    except OSError as error:
        message = f"export_folder: {folder} cannot be written ({error}); name another folder"
        raise DeviceError(message) from error

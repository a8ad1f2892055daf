"""The light engine as a projector: a table of patterns is shown once, or one pattern is held."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import partial

from drivers.dlpc350.engine import Command, Engine
from drivers.dlpc350.flash import Flash, Place
from drivers.dlpc350.link import Link
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.planes import MIRRORS
from drivers.dlpc350.tables import tables_of
from drivers.dlpc350.timing import DARK_US, MOST_PATTERNS, Timing, check_loading, check_timing, lit
from slrig.devices import ProjectorInfo, ProjectorState, Shown, SystemClock
from slrig.errors import DeviceGoneError, SlrigError, UnsupportedByDeviceError
from slrig.model import PatternSequence

AWAKE_S = 10.0
"""How long an engine may take to wake up."""
VALIDATED_S = 5.0
RUNNING_S = 2.0
_COMMANDS_S = 0.06
"""What the commands of one `show` take, typically: some twenty, of about 3 ms each."""


class LightEngine:
    """Implements `slrig.devices.Projector` on a DLPC350.

    Parameters
    ----------
    link
        An open engine, whatever state it is in; it is dark and ready afterwards, or closed if that failed.
    options, flash
        What the rig file says, and what lies in the engine's flash.

    Raises
    ------
    UnsupportedByDeviceError
        The flash does not hold what the list says, or the engine does not take a setting.
    DeviceError, DeviceGoneError
        The engine failed.
    """

    def __init__(self, link: Link, options: EngineOptions, flash: Flash, *, serial: str = "") -> None:
        self._engine = Engine(link)
        self._options = options
        self._flash = flash
        self._info = ProjectorInfo(
            name="projector",
            model="DLPC350 light engine",
            serial=serial,
            size=MIRRORS,
            plays=True,
            latency_s=options.image_load_s + _COMMANDS_S,
        )
        self._state = ProjectorState("the light engine")
        self._places: tuple[Place, ...] = ()
        self._lock = threading.RLock()
        try:
            self._prepare()
        except BaseException:
            self._leave()
            raise

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`. It steps, and it plays, with a pulse on TRIG_OUT_1 per pattern."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses patterns that the flash lacks, and writes the pictures that hold them."""
        self._state.require_open()
        self._state.loaded = None
        self.blank()
        self._state.require_size(sequence, MIRRORS)
        if len(sequence) > MOST_PATTERNS:
            message = (
                f"asked for a sequence of {len(sequence)} patterns, the engine's table takes {MOST_PATTERNS}; scan one "
                "axis only, or with a shorter line_shift_period_px"
            )
            raise UnsupportedByDeviceError(message)
        self._places = self._flash.places(sequence)
        self._state.loaded = sequence

    def show(self, index: int) -> Shown:
        """See `Projector`. Dark again after `hold_s`, whatever becomes of this program.

        When light begins is not told by the engine: it is after the command to start was sent, and before its sequencer
        says that it runs and a picture has had its time from the flash to the mirrors. The error is half of that span.
        """
        self._state.require_pattern(index)
        hold_us = round(self._options.hold_s * 1e6)
        timing = Timing(hold_us - DARK_US, hold_us)
        check_timing(timing)
        earliest_ns, running_ns = self._run((self._places[index],), timing)
        latest_ns = running_ns + round(self._options.image_load_s * 1e9)
        SystemClock().wait_until(latest_ns, self._state.closed)
        self._state.require_open()
        return Shown(index, (earliest_ns + latest_ns) // 2, (latest_ns - earliest_ns + 1) // 2)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Refuses, before the engine does, a timing that it does not have, and says which rule."""
        self._state.require_loaded("play")
        options = self._options
        timing = lit(exposure_s, period_s, margin_s=options.light_margin_s, duty_limit=options.duty_limit)
        counts = tables_of(self._places, options.colour, dark_between=timing.dark_between).counts
        check_loading(counts, timing.period_us, options.image_load_s)
        self._run(self._places, timing)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. LEDs off, then the sequence stopped: each is tried, whatever becomes of the other."""
        with self._lock:
            faults = [] if self._state.closed.is_set() else self._darken()
        # With the LEDs off it is dark, but an engine that does not do as it is told is to be known.
        if faults:
            raise faults[0]

    def close(self) -> None:
        """See `Projector`."""
        # Whoever waits for light need not wait any more.
        already = self._state.closed.is_set()
        self._state.closed.set()
        with self._lock:
            if not already:
                self._leave()

    def _run(self, places: tuple[Place, ...], timing: Timing) -> tuple[int, int]:
        """Stop, set, validate, start. Return when the command to start was sent, and when the engine said it runs."""
        tables = tables_of(places, self._options.colour, dark_between=timing.dark_between)
        engine = self._engine
        with self._lock:
            self._state.require_open()
            try:
                self.blank()
                engine.set_timing(timing)
                engine.set_tables(tables)
                engine.validate(VALIDATED_S)
                started_ns = time.monotonic_ns()
                engine.leds(by_sequence=True)
                engine.start()
                # A short sequence may be over before the engine could be asked.
                if tables.length * timing.period_us >= RUNNING_S * 1e6:
                    engine.wait_until_running(RUNNING_S)
                return started_ns, time.monotonic_ns()
            except BaseException:
                self._darken()
                raise

    def _darken(self) -> list[SlrigError]:
        """LEDs off, then stop, each tried whatever becomes of the other. Return what the engine said against it."""
        faults: list[SlrigError] = []
        for darken in (partial(self._engine.leds, by_sequence=False), self._engine.stop):
            try:
                darken()
            except SlrigError as error:
                faults.append(error)
        return faults

    def _prepare(self) -> None:
        """Darken the engine first, then look whether it is what the rig file says, then set what never changes."""
        engine, options = self._engine, self._options
        # An engine in standby may refuse this, and is dark.
        for fault in self._darken():
            if isinstance(fault, DeviceGoneError):
                raise fault
        if engine.byte(Command.POWER) & 1:
            engine.set_byte(Command.POWER, 0)
        engine.wait_until_initialised(AWAKE_S)
        self.blank()
        self._check_flash()
        engine.settle_byte(Command.DISPLAY_MODE, 1)
        engine.settle_byte(Command.PATTERN_SOURCE, 3)
        engine.settle_byte(Command.TRIGGER_MODE, 1)
        for unchanged in (Command.FLIP_LONG, Command.FLIP_SHORT, Command.INVERT_DATA):
            engine.settle_byte(unchanged, 0)
        engine.set_led_current(options.colour, options.current_byte, inverted=options.led_current_inverted)
        engine.set_trigger_out(active_low=options.trigger_polarity == "low", delay_us=options.trigger_delay_us)
        # Changing the mode may start what the engine shows by itself.
        self.blank()

    def _check_flash(self) -> None:
        flash = self._flash
        if not flash.pictures:
            return
        held = self._engine.byte(Command.IMAGES_IN_FLASH)
        wanted = max(picture.flash_index for picture in flash.pictures) + 1
        if held < wanted:
            message = (
                f"{self._engine.name}: the list in {flash.folder} names picture {wanted - 1} of its flash, it holds "
                f"{held}; flash the pictures of that folder with TI's LightCrafter 4500 program"
            )
            raise UnsupportedByDeviceError(message)
        tag = self._engine.firmware_tag()
        if flash.tag is not None and tag != flash.tag:
            message = (
                f'{self._engine.name}: the list in {flash.folder} is of a flash tagged "{flash.tag}", the engine says '
                f'"{tag}": it may hold other pictures; flash those of that folder with TI\'s LightCrafter 4500 program '
                "and give that tag, or let patterns in the rig file name the folder of what is flashed"
            )
            raise UnsupportedByDeviceError(message)

    def _leave(self) -> None:
        """Darken as far as the engine lets, and let it go."""
        self._darken()
        if self._options.standby:
            with suppress(SlrigError):
                self._engine.set_byte(Command.POWER, 1)
        self._state.loaded = None
        self._state.closed.set()
        self._engine.close()

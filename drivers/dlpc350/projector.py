"""The DLPC350 light engine as a projector: shows a table of patterns once, or holds one pattern."""

from __future__ import annotations

from drivers.dlpc350.engine import (
    DARK_US,
    MAX_PATTERNS,
    PAUSE_S,
    Dlpc350Command,
    Dlpc350Engine,
    Dlpc350EngineOptions,
    PatternTables,
    build_tables,
    check_loading,
    check_timing,
    play_timing,
)
from drivers.dlpc350.flash import MIRRORS, FlashContents, FlashedPlane
from drivers.pattern_engine.options import LedColour
from drivers.pattern_engine.projector import (
    COMMANDS_S,
    DIM_TIMING,
    MAX_UNATTENDED_S,
    START_TIMEOUT_S,
    Timing,
    UsbEngineProjector,
)
from drivers.pattern_engine.usb import UsbCommand, UsbController, UsbLink
from slrig.devices import Clock, DisplayedPattern, ProjectorInfo
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence

DLPC350 = UsbController("dlpc350", 0x6401, "3.0")
VALIDATION_TIMEOUT_S = 5.0
_PATTERN_MODE = 1
_POLLABLE_US = 1_000_000
"""A sequence of at least this length still runs when the engine is polled."""


class Dlpc350Projector(UsbEngineProjector[Dlpc350Engine]):
    """Implements `slrig.devices.Projector` on a DLPC350.

    link : an open engine in any state; it is dark and ready afterwards, or closed if that failed. flash : contents of
    the engine's flash. clock : the rig's; default: the system's. Raises UnsupportedByDeviceError if the flash does not
    match its list or the engine does not accept a setting, DeviceError and DeviceGoneError if the engine failed.
    """

    def __init__(
        self,
        link: UsbLink,
        options: Dlpc350EngineOptions,
        flash: FlashContents,
        *,
        serial: str = "",
        clock: Clock | None = None,
    ) -> None:
        super().__init__(Dlpc350Engine(link, clock), options, clock=clock)
        self._options = options
        self._flash = flash
        self._serial = serial
        self._places: tuple[FlashedPlane, ...] = ()
        self._colours: tuple[LedColour, ...] = ()
        # The tables sent last and the picture shown; None if unknown.
        self._last_sent: tuple[Timing, PatternTables] | None = None
        self._shown_picture: int | None = None
        self._initialise()

    def write_patterns(self, sequence: PatternSequence) -> str:
        """See `StoredPatternProjector`. Pictures in the flash keep their positions."""
        self._state.require_size(sequence, MIRRORS)
        return self._flash.write_patterns(sequence)

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses patterns that the flash lacks."""
        self._state.require_open()
        self._state.loaded = None
        self.blank()
        self._state.require_size(sequence, MIRRORS)
        if len(sequence) > MAX_PATTERNS:
            message = (
                f"the sequence has {len(sequence)} patterns, the engine's table takes {MAX_PATTERNS}; scan one "
                "axis only, or with a shorter line_shift_period_px"
            )
            raise UnsupportedByDeviceError(message)
        self._places = self._flash.places(sequence)
        self._colours = tuple(map(self._options.led_colour, sequence.patterns))
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. Dark again after `hold_s`, and `MAX_UNATTENDED_S` after the end of this program.

        The engine does not report when light begins: it is after the command to start was sent, and before the
        sequencer reports that it runs plus the loading time of a picture. The error is half of that span.
        """
        self._state.require_pattern(index)
        place = self._places[index]
        load_s = self._options.load_s(same_picture=self._shown_picture == place.image)
        # The sequence ends on its own; it may have to load a picture first.
        alone_us = round((MAX_UNATTENDED_S - self._options.image_load_s) * 1e6)
        if self.is_polarity_unknown:
            timing, count = DIM_TIMING, min(alone_us // DIM_TIMING.period_us, MAX_PATTERNS)
        else:
            timing, count = Timing(alone_us - DARK_US, alone_us), 1
        check_timing(timing)
        with self._lock:
            earliest_ns, running_ns = self._start_sequence((place,) * count, (self._colours[index],) * count, timing)
            self._hold_pattern(alone_us / 1e6, again_s=(MAX_UNATTENDED_S - self._options.image_load_s) / 2)
        return self._wait_for_light(index, earliest_ns, running_ns + round(load_s * 1e9))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Refuses an unsupported timing before the engine does; the message names the rule."""
        self._state.require_loaded("play")
        self._require_known_polarity()
        options = self._options
        timing = play_timing(exposure_s, period_s, margin_s=options.light_margin_s, duty_limit=options.duty_limit)
        counts = build_tables(self._places, self._colours, dark_between=timing.dark_between).counts
        check_loading(counts, timing.period_us, options.image_load_s)
        self._start_sequence(self._places, self._colours, timing)

    def _start_sequence(
        self, places: tuple[FlashedPlane, ...], colours: tuple[LedColour, ...], timing: Timing
    ) -> tuple[int, int]:
        """Stop, set, validate, start. Return the times of the command to start and of the engine's report that it
        runs.
        """
        tables = build_tables(places, colours, dark_between=timing.dark_between)
        engine = self._engine
        with self._lock:
            self._state.require_open()
            try:
                self._stop_for_settings()
                previous, self._last_sent = self._last_sent, None
                # What is validated and unchanged can be started again, as in TI's DLP SDK (`StartPatternSequence`).
                if previous != (timing, tables):
                    if previous is None or previous[0] != timing:
                        engine.set_timing(timing)
                    engine.set_tables(tables, None if previous is None else previous[1])
                    engine.validate(VALIDATION_TIMEOUT_S)
                started_ns = self._clock.now_ns()
                engine.switch_leds(by_sequence=True)
                engine.start()
                # A short sequence may end before the engine is polled.
                if tables.length * timing.period_us >= _POLLABLE_US:
                    engine.wait_until_running(START_TIMEOUT_S)
                self._last_sent, self._shown_picture = (timing, tables), places[-1].image
                return started_ns, self._clock.now_ns()
            except BaseException:
                self._shown_picture = None
                self._darken()
                raise

    def _prepare(self) -> ProjectorInfo:
        engine, options = self._engine, self._options
        self._check_flash()
        self._enter_mode(_PATTERN_MODE)
        engine.settle_byte(Dlpc350Command.PATTERN_SOURCE, 3)
        engine.settle_byte(Dlpc350Command.TRIGGER_MODE, 1)
        self._configure_leds()
        engine.set_trigger_out(active_low=options.trigger_polarity == "low", delay_us=options.trigger_delay_us)
        return ProjectorInfo(
            name="projector",
            model="DLPC350 light engine",
            serial=self._serial,
            size=MIRRORS,
            plays=not self.is_polarity_unknown,
            latency_s=options.load_s(same_picture=True) + COMMANDS_S + 2 * PAUSE_S,
            gap_s=options.light_margin_s,
            duty=options.duty_limit,
            lights=options.colour is LedColour.WHITE,
            shades=False,
        )

    def _check_flash(self) -> None:
        flash = self._flash
        if not flash.pictures:
            return
        available = self._engine.byte(Dlpc350Command.IMAGES_IN_FLASH)
        wanted = max(picture.flash_index for picture in flash.pictures) + 1
        if available < wanted:
            message = (
                f"{self._engine.name}: the list in {flash.folder} names picture {wanted - 1} of its flash, it holds "
                f"{available}; flash the pictures of that folder with TI's LightCrafter 4500 program"
            )
            raise UnsupportedByDeviceError(message)
        tag = self._engine.firmware_tag()
        if flash.tag is not None and tag != flash.tag:
            message = (
                f'{self._engine.name}: the list in {flash.folder} is of a flash tagged "{flash.tag}", the engine has '
                f'"{tag}": it may hold other pictures; flash those of that folder with TI\'s LightCrafter 4500 program '
                "and give that tag, or set patterns in the rig file to the folder of the flashed pictures"
            )
            raise UnsupportedByDeviceError(message)

    def _before_close(self) -> None:
        if self._options.standby:
            self._engine.set_byte(UsbCommand.POWER, 1)

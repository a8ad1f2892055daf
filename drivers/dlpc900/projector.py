"""The DLPC900 light engine as a projector: pictures are sent when a sequence is loaded, then a table of them is
shown.
"""

from __future__ import annotations

from drivers.dlpc900.engine import (
    ON_THE_FLY,
    SECOND_READY,
    Dlpc900Engine,
    Dlpc900EngineOptions,
    Dlpc900Mirrors,
    MemoryPlane,
    encode_definition,
    encode_picture,
    pack_sequence,
    play_timing,
)
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
from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import PatternSequence

DLPC900 = UsbController("dlpc900", 0xC900, "6.0")
OLDEST_FIRMWARE = (6, 0)
"""Before 5.0 patterns cannot be reordered (DLPU101, "Edit LUT"); up to 5.0.0 blocks of mirrors may lock after a change
of mode (DLPT028)."""
_DARK_END_US = 10_000
_ALONE_US = round(MAX_UNATTENDED_S * 1e6) - _DARK_END_US


class Dlpc900Projector(UsbEngineProjector[Dlpc900Engine]):
    """Implements `slrig.devices.Projector` on a DLPC900.

    link : an open engine in any state; it is dark and ready afterwards, or closed if that failed. clock : the rig's;
    default: the system's. Raises UnsupportedByDeviceError if its firmware or mirrors are not supported or it does not
    accept a setting, DeviceError and DeviceGoneError if the engine failed.
    """

    def __init__(
        self, link: UsbLink, options: Dlpc900EngineOptions, *, serial: str = "", clock: Clock | None = None
    ) -> None:
        super().__init__(Dlpc900Engine(link, clock), options, clock=clock)
        self._options = options
        self._serial = serial
        self._mirrors: Dlpc900Mirrors
        self._places: tuple[MemoryPlane, ...] = ()
        self._leds: tuple[int, ...] = ()
        # The part of the pattern table that the engine has.
        self._table: dict[int, bytes] = {}
        self._initialise()

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Sends the patterns, some 10 kB for 24 of them, at no more than 64 kB a second."""
        self._state.require_open()
        self._state.loaded = None
        self._stop_for_settings()
        self._state.require_size(sequence, self._mirrors.size)
        memory = pack_sequence(sequence)
        columns = self._mirrors.size.width_px // self._mirrors.controllers
        with self._lock:
            self._state.require_open()
            self._table.clear()
            self._places = memory.places
            self._leds = (*map(self._options.led_colour, sequence.patterns), 0)
            # Table first: pictures are lost when its length changes (DLPU018 section 2.4.4.4.2).
            for index in range(len(memory.places)):
                self._define(index, DIM_TIMING)
            self._engine.configure(len(memory.places), len(sequence))
            for number in reversed(range(len(memory.pictures))):
                picture = memory.pictures[number]
                halves = [picture[:, at : at + columns] for at in range(0, picture.shape[1], columns)]
                self._engine.upload(number, [encode_picture(half) for half in halves])
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. Dark again after `hold_s`, and `MAX_UNATTENDED_S` after the end of this program.

        A pattern without any LED ends each show, so that it is dark regardless of the mirrors after a sequence.
        """
        self._state.require_pattern(index)
        if self.is_polarity_unknown:
            exposure_us, dark_us = DIM_TIMING.exposure_us, DIM_TIMING.period_us - DIM_TIMING.exposure_us
            times = _ALONE_US // DIM_TIMING.period_us
        else:
            exposure_us, dark_us, times = _ALONE_US, _DARK_END_US, 1
        with self._lock:
            self._state.require_open()
            last = len(self._places) - 1
            try:
                self._stop_for_settings()
                self._define(index, Timing(exposure_us, exposure_us))
                self._define(last, Timing(dark_us, dark_us))
                self._engine.configure(len(self._places), len(self._places))
                self._engine.order((index, last), 2 * times)
                started_ns = self._start()
                self._engine.wait_until_running(START_TIMEOUT_S)
                self._engine.require_healthy()
            except BaseException:
                self._darken()
                raise
            self._hold_pattern(MAX_UNATTENDED_S, again_s=MAX_UNATTENDED_S / 2)
        return self._wait_for_light(index, started_ns, self._clock.now_ns() + round(self._options.start_s * 1e9))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Refuses an unsupported timing before the engine does; the message names the rule."""
        self._state.require_loaded("play")
        self._require_known_polarity()
        options = self._options
        timing = play_timing(
            exposure_s,
            period_s,
            margin_s=options.light_margin_s,
            duty_limit=options.duty_limit,
            least_us=self._mirrors.least_us,
        )
        with self._lock:
            self._state.require_open()
            try:
                self._stop_for_settings()
                patterns = len(self._places) - 1
                for index in range(patterns):
                    self._define(index, timing)
                self._engine.configure(len(self._places), patterns)
                self._start()
                self._engine.require_healthy()
            except BaseException:
                self._darken()
                raise

    def _define(self, index: int, timing: Timing) -> None:
        """Set an entry of the pattern table, unless it is already set."""
        dark_us = timing.period_us - timing.exposure_us
        entry = encode_definition(
            index, self._places[index], exposure_us=timing.exposure_us, dark_us=dark_us, leds=self._leds[index]
        )
        if self._table.get(index) != entry:
            self._table.pop(index, None)
            self._engine.define(entry)
            self._table[index] = entry

    def _start(self) -> int:
        """Start the sequence; return the time of the command."""
        started_ns = self._clock.now_ns()
        self._engine.switch_leds(by_sequence=True)
        self._engine.start()
        return started_ns

    def _prepare(self) -> ProjectorInfo:
        engine, options = self._engine, self._options
        version = engine.version()
        if version < OLDEST_FIRMWARE:
            found, wanted = (".".join(map(str, each)) for each in (version, OLDEST_FIRMWARE))
            message = f"{engine.name} has firmware {found}, this driver needs {wanted}; update it with TI's program"
            raise UnsupportedByDeviceError(message)
        self._mirrors = mirrors = engine.mirrors()
        if mirrors.controllers > 1 and not engine.byte(UsbCommand.HARDWARE_STATUS) & SECOND_READY:
            message = f"{engine.name}: a {mirrors.name} has two controllers, the second one does not answer; "
            message += "switch it off and on"
            raise DeviceError(message)
        self._enter_mode(ON_THE_FLY)
        self._configure_leds()
        engine.set_trigger_out(active_low=options.trigger_polarity == "low", delay_us=options.trigger_delay_us)
        return ProjectorInfo(
            name="projector",
            model=f"DLPC900 light engine, {mirrors.name}",
            serial=self._serial,
            size=mirrors.size,
            plays=not self.is_polarity_unknown,
            latency_s=options.start_s + COMMANDS_S,
            gap_s=options.light_margin_s + mirrors.least_us / 1e6,
            duty=options.duty_limit,
            lights=options.colour is LedColour.WHITE,
            shades=False,
        )

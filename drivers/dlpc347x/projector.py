"""The DLPC347x light engine as a projector: shows an order of patterns in its flash."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

from drivers.dlpc347x.bus import I2cBus
from drivers.dlpc347x.engine import Dlpc347xEngine, Dlpc347xEngineOptions, LightLimits, OrderEntry
from drivers.dlpc347x.flash import (
    Dlpc347xMirrors,
    FlashedLine,
    LineEncoder,
    PatternLine,
    build_block,
    find_lines,
    locate_patterns,
)
from drivers.pattern_engine.options import LedColour
from drivers.pattern_engine.projector import MAX_UNATTENDED_S, EngineProjector, Timing, check_duty, light_duration_us
from slrig.devices import Clock, DisplayedPattern, ProjectorInfo
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

MIRRORS = {
    0x0F: ("DLPC3470", Dlpc347xMirrors("DLP2010", Size(854, 480), before=(32, 0), after=(0, 10))),
    0x0B: ("DLPC3478", Dlpc347xMirrors("DLP3010", Size(1280, 720), before=(48, 0), after=(0, 0))),
}
"""Name and mirror array by the number of the controller (dlpc347x.h, `ControllerDeviceId_e`; data sheets, features).
Mirrors outside the picture: dlpc347x_internal_patterns.c, `SetDMDInfo`."""
WAKE_TIMEOUT_S = 10.0
COMMANDS_S = 0.06
"""Typical time for the commands of one `show`: 100 bits per ms, and some 600 bytes."""
MAX_LIGHT_US = 7_600
"""Longest light of a 1-bit pattern (release notes of DLPC3478 8.0.1, timings of internal patterns)."""
END_DARK_US = 1_000_000
"""Dark time at the end of a played sequence, in which this program stops the engine."""
MAX_REPEATS = 254
"""255 repeats forever in TI's programs."""


class Dlpc347xProjector(EngineProjector[Dlpc347xEngine]):
    """Implements `slrig.devices.StoredPatternProjector` on a DLPC3470 or DLPC3478.

    bus : an open engine in any state; it is dark and ready afterwards, or closed if that failed. clock : the rig's;
    default: the system's. Raises UnsupportedByDeviceError if it is another controller or does not accept a setting,
    DeviceError and DeviceGoneError if the engine failed.
    """

    def __init__(self, bus: I2cBus, options: Dlpc347xEngineOptions, *, clock: Clock | None = None) -> None:
        super().__init__(Dlpc347xEngine(bus, clock), options, clock=clock)
        self._options = options
        self._lines: LineEncoder
        self._available: Mapping[PatternLine, tuple[FlashedLine, ...]] = {}
        self._places: tuple[FlashedLine, ...] = ()
        self._colours: tuple[LedColour, ...] = ()
        self._lights: dict[tuple[LedColour, int], LightLimits] = {}
        self._initialise()

    def write_patterns(self, sequence: PatternSequence) -> str:
        """See `StoredPatternProjector`. Replaces the patterns in the engine's flash if it lacks any."""
        self._state.require_size(sequence, self._lines.mirrors.size)
        block = build_block(sequence, self._lines)
        with self._lock:
            self._state.require_open()
            self._state.loaded = None
            self.blank()
            if self._engine.flash() == block:
                return f"the flash of {self._engine.name} holds these {len(sequence)} patterns already"
            self._engine.write_flash(block)
            self._available = find_lines(block)
            self._engine.take_patterns_from_flash()
            self.blank()
        return (
            f"{len(sequence)} patterns were written into the flash of {self._engine.name}, and read back: it is ready"
        )

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses patterns that the flash lacks."""
        self._state.require_open()
        self._state.loaded = None
        self.blank()
        self._state.require_size(sequence, self._lines.mirrors.size)
        self._places = locate_patterns(sequence, self._lines, self._available)
        self._colours = tuple(map(self._options.led_colour, sequence.patterns))
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. The light pulses, 97 % of the time; dark again after `hold_s`, and `MAX_UNATTENDED_S` after
        the end of this program.
        """
        self._state.require_pattern(index)
        entry = self._entry(self._places[index], 1, self._colours[index], MAX_LIGHT_US)
        # One repeat more or less stays within the allowed time.
        repeats = min(round(MAX_UNATTENDED_S * 1e6) // entry.duration_us - 1, MAX_REPEATS)
        with self._lock:
            started_ns = self._start_sequence((entry,), repeats)
            self._hold_pattern(repeats * entry.duration_us / 1e6, again_s=MAX_UNATTENDED_S / 2)
            # It is not documented that LEDs stay dark after the last repeat.
            self._dark_at_s = self._held_until_s + MAX_UNATTENDED_S
        return self._wait_for_light(index, started_ns, self._clock.now_ns() + round(self._options.start_s * 1e9))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Refuses an unsupported timing before the engine does; the message names the rule."""
        sequence = self._state.require_loaded("play")
        if len({place.set for place in self._places}) > 1:
            message = (
                f"cannot play {len(sequence)} patterns of both axes, or more than one set of the flash holds: the time "
                "from one set to the next is unknown; scan one axis only, or with software trigger"
            )
            raise UnsupportedByDeviceError(message)
        options = self._options
        least = self._light_limits(options.colour, MAX_LIGHT_US)
        wanted_us = light_duration_us(
            exposure_s,
            period_s,
            margin_s=options.light_margin_s,
            least_us=least.least_us,
            dark_us=least.before_us + least.after_us,
        )
        check_duty(Timing(wanted_us, round(period_s * 1e6)), options.duty_limit)
        entries: list[OrderEntry] = []
        # The last pattern has its own entry, with dark time in which this program stops the engine: it is not
        # documented if a repeat of 0 is once or forever, and if 1 is once or twice.
        begins = [at for at in range(len(sequence)) if at in (0, len(sequence) - 1) or self._needs_own_entry(at)]
        for begin, end in pairwise([*begins, len(sequence)]):
            lit = self._entry(self._places[begin], end - begin, self._colours[begin], wanted_us)
            dark_us = round(period_s * 1e6) - wanted_us - lit.before_us + (END_DARK_US if end == len(sequence) else 0)
            entries.append(replace(lit, after_us=dark_us))
        duration_us = sum(entry.duration_us for entry in entries)
        with self._lock:
            self._start_sequence(tuple(entries), 1)
            self._dark_at_s = self._now_s() + options.start_s + (duration_us - END_DARK_US / 2) / 1e6

    def _needs_own_entry(self, at: int) -> bool:
        """True if pattern `at` is not the next one in the flash, or has other LEDs than its predecessor."""
        return self._places[at].index != self._places[at - 1].index + 1 or self._colours[at] != self._colours[at - 1]

    def _entry(self, place: FlashedLine, count: int, colour: LedColour, wanted_us: int) -> OrderEntry:
        light = self._light_limits(colour, wanted_us)
        return OrderEntry(place, count, colour, wanted_us, light.before_us, light.after_us)

    def _light_limits(self, colour: LedColour, wanted_us: int) -> LightLimits:
        """Return the limits of a light, queried once. Raises UnsupportedByDeviceError if it is not supported."""
        light = self._lights.get((colour, wanted_us)) or self._engine.light_limits(colour, wanted_us)
        if not light.supported:
            message = (
                f"requested {wanted_us} µs of {colour.name.lower()} light, which the engine does not support; its "
                f"shortest is {light.least_us} µs, the longest that TI states {MAX_LIGHT_US} µs; shorten exposure_s, "
                "or trigger the cameras by software, where exposures may be longer"
            )
            raise UnsupportedByDeviceError(message)
        self._lights[colour, wanted_us] = light
        return light

    def _start_sequence(self, entries: tuple[OrderEntry, ...], repeats: int) -> int:
        """Stop, set, start. Return the time of the command to start."""
        with self._lock:
            self._state.require_open()
            try:
                self.blank()
                self._engine.order(entries, repeats)
                started_ns = self._clock.now_ns()
                self._engine.switch_leds(by_sequence=True)
                self._engine.start()
            except BaseException:
                self._darken()
                raise
        return started_ns

    def _wake(self) -> None:
        for fault in self._darken():
            if isinstance(fault, DeviceGoneError):
                raise fault
        self._engine.wait_until_initialised(WAKE_TIMEOUT_S)

    def _prepare(self) -> ProjectorInfo:
        engine, options = self._engine, self._options
        engine.switch_leds(by_sequence=False)
        number = engine.controller()
        if number not in MIRRORS:
            message = f"{engine.name} is controller {number:#04x}, this driver supports the DLPC3470 and the DLPC3478"
            two = "; the DLPC3479 is not supported, because TI's sources differ on its flash format"
            raise UnsupportedByDeviceError(message + (two if number == 0x0C else ""))
        name, mirrors = MIRRORS[number]
        self._lines = LineEncoder(mirrors, (options.mirror_rows, options.mirror_columns))
        engine.take_patterns_from_flash()
        # A change of mode may start the engine's default sequence.
        self.blank()
        try:
            self._available = find_lines(block) if (block := engine.flash()) else {}
        except struct.error:
            self._available = {}
        engine.set_current(options.led_current)
        engine.set_trigger_out(active_low=options.trigger_polarity == "low", delay_us=options.trigger_delay_us)
        light = self._light_limits(options.colour, MAX_LIGHT_US)
        return ProjectorInfo(
            name="projector",
            model=f"{name} light engine, {mirrors.name}, firmware {engine.version()}",
            serial="",
            size=mirrors.size,
            plays=True,
            latency_s=options.start_s + COMMANDS_S,
            gap_s=options.light_margin_s + (light.before_us + light.after_us) / 1e6,
            duty=options.duty_limit,
            lights=options.colour is LedColour.WHITE,
            shades=False,
        )

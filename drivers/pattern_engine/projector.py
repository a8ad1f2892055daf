"""A pattern engine with a USB port as a projector, as far as these are alike: woken, and dim until proven."""

from __future__ import annotations

from abc import ABC
from typing import TypeVar

from drivers.pattern_engine.engine import UsbCommand, UsbEngine
from drivers.pattern_engine.light import EngineProjector
from drivers.pattern_engine.options import UsbLightOptions
from drivers.pattern_engine.timing import Timing
from slrig.devices import Clock
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError

WAKE_TIMEOUT_S = 10.0
"""How long an engine may take to wake up."""
START_TIMEOUT_S = 2.0
COMMANDS_S = 0.04
"""What the commands of one `show` take, typically: a dozen, of about 3 ms each."""
DIM_TIMING = Timing(1_250, 15_000)
"""Light for a twelfth of the time: at half current that is 4.2 % of the most, and never above 5 % at 60 %."""
_HALF_CURRENT = 128
"""A current that is half of the most, whichever way the register counts."""

EngineT = TypeVar("EngineT", bound=UsbEngine)


class UsbEngineProjector(EngineProjector[EngineT], ABC):
    """What implements `slrig.devices.Projector` and `UnprovenLight` on an engine with a USB port."""

    def __init__(self, engine: EngineT, options: UsbLightOptions, *, clock: Clock | None = None) -> None:
        super().__init__(engine, options, clock=clock)
        self._light: UsbLightOptions = options

    @property
    def unproven(self) -> bool:
        """See `UnprovenLight`."""
        return self._light.led_current_inverted is None

    @property
    def light_period_s(self) -> float:
        """See `UnprovenLight`."""
        return DIM_TIMING.period_us / 1e6

    def try_current(self, share: float) -> None:
        """See `UnprovenLight`."""
        if not self.unproven or not 0.4 <= share <= 0.6:
            message = f"asked to try a current register at {share:g}: only 0.4 to 0.6, while its sense is not known"
            raise UnsupportedByDeviceError(message)
        with self._lock:
            self._state.require_open()
            self.blank()
            self._engine.set_led_registers(bytes([round(share * 255)] * 3))

    def option_for(self, *, rises: bool) -> str:
        """See `UnprovenLight`."""
        inverted = rises == self._engine.led_polarity_turned
        return f"led_current_inverted = {str(inverted).lower()}"

    def _wake(self) -> None:
        # An engine in standby is dark, and takes no other command.
        if self._engine.byte(UsbCommand.POWER) & 1:
            self._engine.set_byte(UsbCommand.POWER, 0)
        else:
            for fault in self._darken():
                if isinstance(fault, DeviceGoneError):
                    raise fault
        self._engine.wait_until_initialised(WAKE_TIMEOUT_S)
        self.blank()

    def _set_up_light(self) -> None:
        """No mirroring, no inversion, and the current of the LEDs: half of it where its sense is not known."""
        engine, light = self._engine, self._light
        for unchanged in (UsbCommand.FLIP_LONG, UsbCommand.FLIP_SHORT, UsbCommand.INVERT_DATA):
            engine.settle_byte(unchanged, 0)
        if light.led_current_inverted is None:
            engine.set_led_registers(bytes([_HALF_CURRENT] * 3))
        else:
            engine.set_led_current(light.colour, light.current_byte, inverted=light.led_current_inverted)

    def _require_proven(self) -> None:
        if self.unproven:
            message = (
                "asked to play, but it is not known which way the LEDs' current goes, and light is dim until it is: "
                "slrig doctor finds it out, and says what to write into the rig file"
            )
            raise UnsupportedByDeviceError(message)

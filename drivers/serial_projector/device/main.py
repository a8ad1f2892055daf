"""The pins of the reference trigger box: a Raspberry Pi Pico (RP2040) with MicroPython, and a stepping light engine.

The engine keeps its patterns in its own flash: a pulse on STEP selects the next one, a pulse on HOME the first one, and
its light follows LAMP. This wiring suits engines whose patterns are advanced by a trigger input and whose LED has an
enable or dimming input.

    GP2  STEP    out, engine's trigger input      GP5  CAMERA  out, cameras' trigger inputs (opto-isolated)
    GP3  HOME    out, engine's reset input        GP6  READY   in, engine shows the selected pattern; None: settles
    GP4  LAMP    out, LED enable or dimming input, with a resistor of 10 kΩ to ground

The resistor on LAMP keeps it dark while the box starts, restarts or has no firmware, when the pin is an input. A
watchdog timer restarts the box if this program hangs for a second. The program ignores Ctrl-C: to change its files,
start the box with SERVICE (GP15) on ground, and it ends at once.
"""

# MicroPython has no `__future__`, its modules have no types, and `asm_pio` has names that are not defined here.
# ruff: noqa: F821, ANN001, ANN202
# mypy: disable-error-code="name-defined, no-untyped-def, no-untyped-call, untyped-decorator, type-arg"
# mypy: disable-error-code="call-overload, redundant-expr, import-not-found"

try:
    from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError
    from drivers.serial_projector.device.protocol import TriggerBox
except ImportError:
    # On a box the files are in one folder.
    from box import BoxDescription, BoxHardware, HardwareError  # type: ignore[no-redef]
    from protocol import TriggerBox  # type: ignore[no-redef]

MODEL, FIRMWARE = "slrig-pico", "1.2.0"
WIDTH_PX, HEIGHT_PX = 912, 1140

STEP_PIN, HOME_PIN, LAMP_PIN, CAMERA_PIN, READY_PIN, SERVICE_PIN = 2, 3, 4, 5, 6, 15

HOME_LEVEL = 1
"""Level of a pulse on HOME. 0 for an engine that runs while this input is high and restarts after it was low."""

STEPS_TO_FIRST = 0
"""Pulses on STEP from HOME to the first pattern: 1 if the first pattern also waits for a trigger."""

STEP_US = 50
"""Length of a pulse on STEP or HOME, and of the pause after it."""

SETTLE_US = 500
"""Time from the last step to a stable pattern, without READY."""

READY_US = 20000
"""Longest wait for READY."""

LAMP_US = 20
"""Delay from LAMP to light."""

CAMERA_LEVEL = 1
"""Level of the cameras' pulse, which lasts as long as the exposure: 0 for XTR of a Raspberry Pi camera."""

PULSE_LESS_US = 14
"""How much shorter than the exposure it is: an IMX296 exposes for its low level and 14.26 µs."""

HOLD_US = 500
"""How long a pattern of a sequence stays lit beyond its exposure: longer than the largest delay of this program."""

MIN_EXPOSURE_US = 200
ERROR_US = 50
DIM_HZ = 100000
RESTART_MS = 1000
MAX_DUTY, MAX_ON_MS = 1000, 3600000
TIDY_AFTER = 64


def describe_box(patterns: dict) -> BoxDescription:
    """Return the box's properties, from the patterns.json that was written with the engine's images."""
    fits = patterns.get("size_px") == [WIDTH_PX, HEIGHT_PX]
    crc32 = [int(each, 16) for each in patterns["crc32"]] if fits else []
    return BoxDescription(
        MODEL,
        FIRMWARE,
        WIDTH_PX,
        HEIGHT_PX,
        crc32,
        light_us=2 * STEP_US * (len(crc32) + 1 + STEPS_TO_FIRST) + max(SETTLE_US, READY_US) + LAMP_US,
        error_us=ERROR_US,
        gap_us=HOLD_US + 2 * STEP_US + SETTLE_US + 1000,
        hold_us=HOLD_US,
        least_us=MIN_EXPOSURE_US,
        step_us=2 * STEP_US,
        duty=MAX_DUTY,
        on_ms=MAX_ON_MS,
    )


class PicoBoard(BoxHardware):
    """The pins. machine, rp2, time : MicroPython's modules."""

    def __init__(self, machine, rp2, time) -> None:
        self._time = time
        self._lamp = machine.PWM(machine.Pin(LAMP_PIN), freq=DIM_HZ, duty_u16=0)
        self._step = machine.Pin(STEP_PIN, machine.Pin.OUT, value=0)
        self._home = machine.Pin(HOME_PIN, machine.Pin.OUT, value=1 - HOME_LEVEL)
        self._ready = None if READY_PIN is None else machine.Pin(READY_PIN, machine.Pin.IN, machine.Pin.PULL_DOWN)
        self._camera = _pulses(machine, rp2)
        self._level = 65535
        self._position = -1
        self._ticks = time.ticks_us()
        self._us = 0

    def time_us(self) -> int:
        """See `BoxHardware`. The board's own counter wraps after 18 minutes."""
        ticks = self._time.ticks_us()
        self._us += self._time.ticks_diff(ticks, self._ticks)
        self._ticks = ticks
        return self._us

    def select(self, pattern: int) -> None:
        """See `BoxHardware`."""
        if self._position < 0 or pattern < self._position:
            self._send(self._home, HOME_LEVEL)
            for _ in range(STEPS_TO_FIRST):
                self._send(self._step)
            self._position = 0
        while self._position < pattern:
            self._send(self._step)
            self._position += 1
        if self._ready is None:
            self._time.sleep_us(SETTLE_US)
            return
        begun_us = self.time_us()
        while not self._ready.value():
            if self.time_us() - begun_us > READY_US:
                # The position is unknown: home first, next time.
                self._position = -1
                raise HardwareError("the engine is not READY")

    def light(self) -> None:
        """See `BoxHardware`."""
        self._lamp.duty_u16(self._level)
        self._time.sleep_us(LAMP_US)

    def switch_off(self) -> None:
        """See `BoxHardware`. Ends a pulse that still lasts."""
        self._lamp.duty_u16(0)
        self._camera.restart()
        self._time.sleep_us(LAMP_US)

    def pulse(self, us: int) -> None:
        """See `BoxHardware`. The state machine ends it, without waiting."""
        # Beside the turns of its loop, it takes 1 µs before and 1 µs behind.
        self._camera.put(us - PULSE_LESS_US - 2)

    def set_brightness(self, permille: int) -> int:
        """See `BoxHardware`."""
        self._level = 65535 * permille // 1000
        return permille

    def _send(self, pin, level=1) -> None:
        pin.value(level)
        self._time.sleep_us(STEP_US)
        pin.value(1 - level)
        self._time.sleep_us(STEP_US)


def _pulses(machine, rp2):
    """Return a state machine that makes a pulse of the given number of µs."""

    @rp2.asm_pio(set_init=rp2.PIO.OUT_LOW if CAMERA_LEVEL else rp2.PIO.OUT_HIGH)
    def program(level=CAMERA_LEVEL, at_rest=1 - CAMERA_LEVEL) -> None:
        # MicroPython takes the module's names away while it assembles this.
        set(pins, at_rest)
        pull(block)
        mov(x, osr)
        set(pins, level)
        label("on")
        jmp(x_dec, "on")

    camera = rp2.StateMachine(0, program, freq=1000000, set_base=machine.Pin(CAMERA_PIN))
    camera.active(1)
    return camera


class UsbPort:
    """The board's USB serial port. select, sys : MicroPython's modules."""

    def __init__(self, select, sys) -> None:
        self._in, self._out = sys.stdin.buffer, sys.stdout.buffer
        self._poll = select.poll()
        self._poll.register(sys.stdin, select.POLLIN)

    def read(self) -> bytes:
        """Return the received bytes without waiting."""
        data = b""
        while len(data) < 64 and self._poll.poll(0):
            data += self._in.read(1)
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._out.write(data)


def serve(device: TriggerBox, port: UsbPort, alive, tidy) -> None:
    """Run a box forever. alive : feeds the watchdog timer. tidy : collects garbage, at the least disturbing time."""
    sent = 0
    while True:
        alive()
        data = port.read()
        out = device.feed(data) if data else device.poll()
        if out:
            port.write(out)
            sent += 1
            # Collect garbage in the dark: automatic collection could occur during an exposure.
            if sent >= TIDY_AFTER and device.wait_us() < 0:
                tidy()
                sent = 0


def run() -> None:
    """Run as a trigger box. Called on the board only."""
    # ruff: noqa: I001 - modules of the board only
    import gc
    import json
    import machine
    import micropython
    import os
    import rp2
    import select
    import sys
    import time

    if not machine.Pin(SERVICE_PIN, machine.Pin.IN, machine.Pin.PULL_UP).value():
        return
    # Do not treat bytes from the host as keyboard interrupts.
    micropython.kbd_intr(-1)
    board = PicoBoard(machine, rp2, time)
    try:
        with open("patterns.json") as file:  # noqa: PTH123 - MicroPython has no pathlib
            patterns = json.load(file)
    except (OSError, ValueError):
        patterns = {}
    device = TriggerBox(board, describe_box(patterns), int.from_bytes(os.urandom(4), "big"))
    watchdog = machine.WDT(timeout=RESTART_MS)
    try:
        serve(device, UsbPort(select, sys), watchdog.feed, gc.collect)
    finally:
        board.switch_off()


if __name__ == "__main__":
    run()

"""A board for tests, in MicroPython's interpreter: the reference core, whose board is at the other end of a channel."""

# mypy: ignore-errors
# ruff: noqa

import struct

import channel
import main  # the pins, which `test_board` tries: here it is to load
from box import BoxDescription, BoxHardware, HardwareError
from protocol import TriggerBox


def give(what, form="", *values):
    for byte in what.encode() + struct.pack("<" + form, *values):
        channel.give(byte)


def take(form):
    values = struct.unpack("<" + form, bytes([channel.take() for _ in range(struct.calcsize("<" + form))]))
    return values if len(values) > 1 else values[0]


def ask(what, form="", *values):
    give(what, form, *values)
    reason = bytes([channel.take() for _ in range(take("B"))])
    if reason:
        raise HardwareError(reason.decode())


class Board(BoxHardware):
    def time_us(self):
        give("t")
        return take("Q")

    def select(self, pattern):
        ask("s", "B", pattern)

    def light(self):
        ask("l")

    def switch_off(self):
        ask("d")

    def pulse(self, us):
        ask("p", "I", us)

    def set_brightness(self, permille):
        give("b", "H", permille)
        return take("H")


def send(data):
    for line in data.splitlines(True):
        give("o", "B", len(line))
        for byte in line:
            channel.give(byte)


boot = take("I")
model, firmware, width_px, height_px, count, *times, watchdog_ms, on_ms, duty = take("16s8sHHH9I")
names = ("light_us", "error_us", "gap_us", "hold_us", "least_us", "step_us")
about = BoxDescription(
    model.rstrip(b"\0").decode(),
    firmware.rstrip(b"\0").decode(),
    width_px,
    height_px,
    [take("I") for _ in range(count)],
    watchdog_ms=watchdog_ms,
    on_ms=on_ms,
    duty=duty,
    **dict(zip(names, times)),
)
box = TriggerBox(Board(), about, boot)
while True:
    give(".")
    if take("B") == ord("w"):
        give("r", "q", box.wait_us())
    else:
        data = bytes([channel.take() for _ in range(take("B"))])
        send(box.feed(data) if data else box.poll())

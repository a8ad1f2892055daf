"""The cores in MicroPython and on the Arduino do, byte for byte and call for call, what the reference does."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import pytest

from drivers.serial_projector.client import sequence_checksum
from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError
from drivers.serial_projector.device.protocol import TriggerBox
from drivers.serial_projector.link import encode_line
from tests.unit.drivers.serial_projector import remote
from tests.unit.drivers.serial_projector.remote import RemoteBox

pytestmark = pytest.mark.slow

CRC32 = list(range(1000, 1026))


class Light(BoxHardware):
    """Notes what happens, and fails now and then. `told` : (µs, call)."""

    def __init__(self) -> None:
        self.now_us, self.calls = 0, 0
        self.told: list[tuple[int, str]] = []

    def time_us(self) -> int:
        return self.now_us

    def select(self, pattern: int) -> None:
        self._did(f"select {pattern}")

    def light(self) -> None:
        self._did("light")
        self.now_us += 20

    def switch_off(self) -> None:
        self._did("dark")

    def pulse(self, us: int) -> None:
        self._did(f"pulse {us}")

    def set_brightness(self, permille: int) -> int:
        return permille

    def _did(self, what: str) -> None:
        self.calls += 1
        self.told.append((self.now_us, what))
        if self.calls % 97 == 0:
            message = f"number {self.calls}"
            raise HardwareError(message)


def play(
    make_box: Callable[[BoxHardware, BoxDescription, int], TriggerBox | RemoteBox], lines: Sequence[tuple[int, bytes]]
) -> list[tuple[int, str]]:
    """Return all that a box did and said."""
    light = Light()
    about = BoxDescription(
        "test", "1", 400, 300, CRC32, light_us=3000, error_us=50, gap_us=2000, hold_us=500, least_us=100
    )
    box = make_box(light, about, 0xC0FFEE)
    for passed_us, line in lines:
        until_us = light.now_us + passed_us
        while light.now_us < until_us and 0 <= (wait_us := box.wait_us()) <= until_us - light.now_us:
            light.now_us += max(wait_us, 1)
            light.told.append((light.now_us, box.poll().decode()))
        light.now_us = max(until_us, light.now_us)
        light.told.append((light.now_us, box.feed(line).decode()))
    if isinstance(box, RemoteBox):
        box.close()
    return light.told


def random_lines(seed: int, count: int) -> list[tuple[int, bytes]]:
    """(µs before it, line) of whatever hosts may send, some of it damaged, some of it again."""
    rng = random.Random(seed)
    lines: list[tuple[int, bytes]] = []
    number, data = 0, b""
    for step in range(count):
        session = "1A2B" if step % 200 < 180 else "77F0"
        first = rng.randrange(20)
        size = rng.randrange(1, 7)
        text = rng.choice(
            [
                *(f"HELLO 1 {rng.choice([40, 500, 1000])} {rng.choice([50, 5000])} {duty} 500" for duty in (200, 1000)),
                f"LOAD {size} 00C0FFEE",
                f"PICK 0 {CRC32[first]:08X} {CRC32[first - 7]:08X}",
                f"PICK {size} 00C0FFEE {CRC32[first]:08X}",
                f"LOAD 2 {sequence_checksum([CRC32[first], CRC32[first - 7]]):08X}",
                f"LOAD {size} {sequence_checksum(CRC32[first : first + size]):08X}",
                *(f"LOAD 26 {sequence_checksum(CRC32):08X}" for _ in range(4)),
                *(f"SHOW {rng.randrange(26)}" for _ in range(8)),
                f"SEQ {rng.randrange(3)} {size} {rng.choice([50, 4000, 9000])} {rng.choice([6400, 50000])} 0",
                f"SEQ 0 {size} 4000 10000 1",
                *("TRIG", "TRIG", "PING", "PING", "STOP", "BLANK", "STATUS", "DANCE", "SHOW", "SHOW -1", "LOAD x y"),
                *(["BYE"] if step % 50 == 0 else []),
            ]
        )
        chance = rng.random()
        if chance < 0.8 or not data:
            number = (number + 1) % 10_000
            data = encode_line(f"{session} {number} {text}")
        sent = data
        if chance > 0.95:
            at = rng.randrange(len(data))
            sent = data[:at] + rng.randbytes(rng.randrange(3)) + data[at + 1 :]
        lines.append((rng.choice([10, 1_000, 5_000, 30_000, 700_000]), sent))
    return lines


@pytest.mark.parametrize("make_box", [remote.micropython, remote.arduino])
def test_every_core_plays_the_same_sessions(make_box: Callable[[BoxHardware, BoxDescription, int], RemoteBox]) -> None:
    said = ""
    for seed in range(4):
        lines = random_lines(seed, 600)
        expected = play(TriggerBox, lines)
        assert play(make_box, lines) == expected
        said += "".join(what for _, what in expected)
    # All that a box may say was said.
    for each in (" OK ", *(f" ERR {code} " for code in (2, 3, 4, 5, 6, 7, 8, 9, 10)), "? ERR 1 "):
        assert each in said, each
    for event in ("FRAME", "DONE", *(f"FAULT {code}*" for code in (1, 2, 4))):
        assert event in said, event

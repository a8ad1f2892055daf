"""The reference box in MicroPython's own interpreter does, byte for byte, what it does in CPython."""

from __future__ import annotations

import contextlib
import io
import random
import subprocess
import sys
from pathlib import Path

import pytest

import tests.unit.drivers.serial_projector
from drivers.serial_projector.client import sequence_checksum
from drivers.serial_projector.device import box, main, protocol, wire
from drivers.serial_projector.link import encode_line
from tests.npm import npm_package

pytestmark = pytest.mark.slow

PACKAGE = "@micropython/micropython-webassembly-pyscript@1.27.0"
HERE = Path(tests.unit.drivers.serial_projector.__path__[0])
FIRMWARE = Path(main.__file__).parent
CRC32 = list(range(1000, 1026))

PLAY = """
from binascii import hexlify, unhexlify
import main  # the pins, which `test_board` tries: here it is to load
from box import BoxDescription, BoxHardware, HardwareError
from protocol import TriggerBox

class Light(BoxHardware):
    now_us, calls = 0, 0
    def time_us(self):
        return self.now_us
    def _did(self, what):
        self.calls += 1
        print(self.now_us, what)
        if self.calls % 97 == 0:
            raise HardwareError("number %d" % self.calls)
    def select(self, pattern):
        self._did("select %d" % pattern)
    def light(self):
        self._did("light")
        self.now_us += 20
    def switch_off(self):
        self._did("dark")
    def pulse(self):
        self._did("pulse")
    def set_brightness(self, permille):
        return permille

light = Light()
about = BoxDescription("test", "1", 400, 300, CRC32, light_us=3000, error_us=50, gap_us=2000, hold_us=500, least_us=100)
box = TriggerBox(light, about, 0xC0FFEE)
for passed_us, line in LINES:
    until_us = light.now_us + passed_us
    while light.now_us < until_us and 0 <= box.wait_us() <= until_us - light.now_us:
        light.now_us += max(box.wait_us(), 1)
        out = box.poll()
        if out:
            print(hexlify(out).decode())
    light.now_us = max(until_us, light.now_us)
    print(hexlify(box.feed(unhexlify(line))).decode())
"""


def in_micropython(script: str, folder: Path) -> str:
    command = ["node", str(HERE / "micropython_run.mjs"), str(npm_package(PACKAGE, "to run MicroPython")), str(folder)]
    done = subprocess.run(command, input=script, capture_output=True, text=True, check=False, timeout=60)  # noqa: S603
    assert done.returncode == 0, done.stderr + done.stdout[-2000:]
    return done.stdout


def in_cpython(script: str, monkeypatch: pytest.MonkeyPatch) -> str:
    for module in (box, wire, protocol, main):
        monkeypatch.setitem(sys.modules, module.__name__.rpartition(".")[2], module)
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        exec(compile(script, "script", "exec"), {})  # noqa: S102 - the script above
    return told.getvalue()


def random_lines(seed: int, count: int) -> list[tuple[int, str]]:
    """(µs before it, bytes) of whatever hosts may send, some of it damaged, some of it again."""
    rng = random.Random(seed)
    lines: list[tuple[int, str]] = []
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
        lines.append((rng.choice([10, 1_000, 5_000, 30_000, 700_000]), sent.hex()))
    return lines


def test_both_interpreters_play_the_same_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    told = ""
    for seed in range(4):
        script = f"CRC32 = {CRC32}\nLINES = {random_lines(seed, 600)}\n{PLAY}"
        in_ours = in_cpython(script, monkeypatch)
        assert in_micropython(script, FIRMWARE) == in_ours
        told += in_ours
    text = b"".join(bytes.fromhex(line) for line in told.splitlines() if " " not in line)
    # All that a box may say was said.
    for each in (b" OK ", *(b" ERR %d " % code for code in (2, 3, 4, 5, 6, 7, 8, 9, 10)), b"? ERR 1 "):
        assert each in text, each
    for event in (b"FRAME", b"DONE", *(b"FAULT %d*" % code for code in (1, 2, 4))):
        assert event in text, event

"""The cores of a trigger box in other machines: MicroPython's interpreter, and the Arduino's processor on simavr."""

from __future__ import annotations

import functools
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

from drivers.serial_projector.device import main
from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError
from tests.npm import lacking, npm_package

PACKAGE = "@micropython/micropython-webassembly-pyscript@1.27.0"
HERE = Path(__file__).parent
FIRMWARE = Path(main.__file__).parent
ARDUINO = FIRMWARE / "arduino"
_FLAGS = (
    "-mmcu=atmega328p",
    "-DF_CPU=16000000UL",
    "-std=gnu11",
    "-Os",
    "-flto",
    "-Wall",
    "-Werror",
    "-Wno-unused-parameter",
)


@functools.cache
def simulator() -> Path:
    """Return the ATmega328P that `simulator.c` describes, compiled. Skips without the compilers."""
    for program, package in (("avr-gcc", "gcc-avr avr-libc"), ("gcc", "gcc")):
        if not shutil.which(program):
            lacking(f"needs {program}, to run the Arduino's firmware: apt install {package} libsimavr-dev")
    made = Path(tempfile.mkdtemp()) / "simulator"
    done = _run("gcc", "-O2", str(HERE / "simulator.c"), "-o", str(made), "-lsimavr")
    if done.returncode:
        lacking(f"needs libsimavr, to run the Arduino's firmware: apt install libsimavr-dev ({done.stderr[:200]})")
    return made


def compiled(*sources: Path, include: Path = ARDUINO, options: tuple[str, ...] = ()) -> Path:
    """Compile a program for the Arduino. include : folder searched for headers, beside those of the firmware."""
    simulator()
    made = Path(tempfile.mkdtemp()) / "box.elf"
    done = _run("avr-gcc", *_FLAGS, *options, f"-I{include}", f"-I{ARDUINO}", *map(str, sources), "-o", str(made))
    assert done.returncode == 0, done.stderr
    return made


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)  # noqa: S603


@functools.cache
def _core_of_the_arduino() -> Path:
    return compiled(HERE / "arduino.c", ARDUINO / "protocol.c")


class RemoteBox:
    """A `TriggerBox` in another process, with the board here. `time` stands still while it thinks."""

    def __init__(self, command: list[str], hardware: BoxHardware, about: BoxDescription, boot_id: int) -> None:
        self._hardware = hardware
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - for the process's life
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said)  # noqa: S603
        given = struct.pack(
            "<I16s8sHHH9I",
            *(boot_id, about.model.encode(), about.firmware.encode(), about.width_px, about.height_px, about.count),
            *(about.light_us, about.error_us, about.gap_us, about.hold_us, about.least_us, about.step_us),
            *(about.watchdog_ms, about.on_ms, about.duty),
        )
        crc32 = (about.crc32[4 * at : 4 * at + 4][::-1] for at in range(about.count))
        self._exchange(given + b"".join(crc32))

    def feed(self, data: bytes) -> bytes:
        """As `TriggerBox`."""
        answers = [self._exchange(b"f" + bytes([len(part)]) + part) for part in _parts(data)]
        return b"".join(answers)

    def poll(self) -> bytes:
        """As `TriggerBox`."""
        return self._exchange(b"f\0")

    def wait_us(self) -> int:
        """As `TriggerBox`."""
        return int.from_bytes(self._exchange(b"w"), "little", signed=True)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
        self._said.close()

    def _exchange(self, data: bytes) -> bytes:
        """Send a request and answer what the box asks of its board; return the lines that it sent, or its result."""
        self._write(data)
        sent = b""
        while (what := self._read(1)) != b".":
            if what == b"o":
                sent += self._read(self._read(1)[0])
            elif what == b"r":
                sent = self._read(8)
            elif what == b"t":
                self._write(struct.pack("<Q", self._hardware.time_us()))
            elif what == b"b":
                (permille,) = struct.unpack("<H", self._read(2))
                self._write(struct.pack("<H", self._hardware.set_brightness(permille)))
            else:
                self._try(self._call(what))
        return sent

    def _call(self, what: bytes) -> Callable[[], None]:
        if what == b"s":
            return functools.partial(self._hardware.select, self._read(1)[0])
        if what == b"p":
            return functools.partial(self._hardware.pulse, int.from_bytes(self._read(4), "little"))
        return {b"l": self._hardware.light, b"d": self._hardware.switch_off}[what]

    def _try(self, call: Callable[[], None]) -> None:
        try:
            call()
        except HardwareError as error:
            reason = str(error).encode()
            self._write(bytes([len(reason)]) + reason)
        else:
            self._write(b"\0")

    def _write(self, data: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(count)
        if len(data) < count:
            self._said.seek(0)
            message = f"the box ended: {self._said.read().decode()[-2000:]}"
            raise AssertionError(message)
        return data


def _parts(data: bytes) -> list[bytes]:
    return [data[at : at + 255] for at in range(0, len(data), 255)] or [b""]


def micropython(hardware: BoxHardware, about: BoxDescription, boot_id: int) -> RemoteBox:
    """Return the reference core in MicroPython's own interpreter. Skips without Node."""
    package = str(npm_package(PACKAGE, "to run MicroPython"))
    script = [str(FIRMWARE), str(HERE / "micropython_board.py")]
    return RemoteBox(["node", str(HERE / "micropython.mjs"), package, *script], hardware, about, boot_id)


def arduino(hardware: BoxHardware, about: BoxDescription, boot_id: int) -> RemoteBox:
    """Return the core in C on the Arduino's processor. Skips without avr-gcc or simavr."""
    command = [str(simulator()), "channel", str(_core_of_the_arduino())]
    return RemoteBox(command, hardware, about, boot_id)

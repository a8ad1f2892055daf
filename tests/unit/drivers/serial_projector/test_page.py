"""The protocol's page: its example is what the reference box answers, and nothing that a box says is left out."""

from __future__ import annotations

import inspect
import re
import zlib

import drivers.serial_projector
from drivers.serial_projector.client import Box, Status
from drivers.serial_projector.device import wire
from drivers.serial_projector.device.box import Description, Hardware
from drivers.serial_projector.device.protocol import Device
from drivers.serial_projector.frames import Fault, Refused
from drivers.serial_projector.pattern_set import crc32_of_all

PAGE = inspect.getdoc(drivers.serial_projector) or ""
IMAGES = (b"\xff" * 8, b"\x00" * 8, b"\xff\xff\x00\x00" * 2)
LINE = re.compile(r"^ +(\d*) *([<>|]) (.*)$")


class ExampleLight(Hardware):
    """Takes 20 µs to be lit."""

    now_us = 0

    def time_us(self) -> int:
        return self.now_us

    def select(self, pattern: int) -> None:
        pass

    def light(self) -> None:
        self.now_us += 20

    def dark(self) -> None:
        pass

    def pulse(self) -> None:
        pass

    def dim(self, permille: int) -> int:
        return permille


def example() -> list[tuple[int | None, str, str]]:
    """(time or None, direction, text) of the page's example."""
    lines: list[tuple[int | None, str, str]] = []
    for line in PAGE.partition("\nA session\n")[2].splitlines():
        found = LINE.match(line)
        if found is None:
            continue
        time_us, direction, text = found.groups()
        if direction == "|":
            at, before, begun = lines.pop()
            lines.append((at, before, f"{begun} {text}"))
        else:
            lines.append((int(time_us) if time_us else None, direction, text))
    return lines


def test_the_example_is_what_the_reference_box_answers() -> None:
    crc32 = [zlib.crc32(image) for image in IMAGES]
    about = Description(
        "example", "1.0", 4, 2, crc32, light_us=2000, error_us=50, gap_us=3000, hold_us=500, least_us=200
    )
    light = ExampleLight()
    box = Device(light, about, 0xC0FFEE)
    waiting: list[str] = []
    lines = example()
    for time_us, direction, text in lines:
        if time_us is not None:
            while 0 <= (due_us := box.wait_us()) < time_us - light.now_us:
                light.now_us += max(due_us, 1)
                waiting += box.poll().decode().splitlines()
            assert not waiting or direction == "<", f"the page lacks {waiting}"
            light.now_us = time_us
            data = box.feed(text.encode() + b"\n") if direction == ">" else box.poll()
            waiting += data.decode().splitlines()
        if direction == "<":
            assert waiting.pop(0) == text
    assert not waiting
    assert sum(direction == ">" for _, direction, _ in lines) >= 10


def test_the_example_has_the_checksums_of_its_images() -> None:
    crc32 = [zlib.crc32(image) for image in IMAGES]
    assert all(f"({value:08X})" in PAGE for value in crc32)
    assert f"LOAD 3 {crc32_of_all(crc32):08X}*" in PAGE


def test_every_line_of_the_example_carries_its_checksum() -> None:
    faulty = [text for _, _, text in example() if wire.unframed(text.encode()) is None]
    assert len(faulty) == 1, "one line of the example is damaged, as it says"


def test_the_page_names_everything_that_goes_over_the_wire() -> None:
    verbs = {"HELLO", "PING", "PICK", "LOAD", "SHOW", "SEQ", "TRIG", "STOP", "BLANK", "STATUS", "BYE"}
    assert {verb for verb in verbs if re.search(rf"^    {verb}\b", PAGE, re.MULTILINE)} == verbs
    assert all(f"{name}=" in PAGE for name in (*Box.__dataclass_fields__, *Status.__dataclass_fields__))
    errors = PAGE.partition("Errors: ")[2].partition("\n\n")[0]
    assert {int(code) for code in re.findall(r"(?:^|[.\n] ?)(\d+) [a-z<]", errors)} == {each.value for each in Refused}
    faults = PAGE.partition("cannot miss it. ")[2].partition("\n\n")[0]
    assert {int(code) for code in re.findall(r"(\d): ", faults)} == {each.value for each in Fault}

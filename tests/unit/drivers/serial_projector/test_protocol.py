"""A box's core on a clock that the test moves: at most once, in one session, and dark when it must be.

The core is the reference, the same in MicroPython's interpreter, or the Arduino's on its processor in a simulator: the
results are the same.
"""

from __future__ import annotations

import inspect
import re
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import pytest

import drivers.serial_projector
from drivers.serial_projector.client import BoxInfo, BoxStatus, sequence_checksum
from drivers.serial_projector.device import wire
from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError
from drivers.serial_projector.device.protocol import TriggerBox
from drivers.serial_projector.link import (
    BoxAnswer,
    BoxEvent,
    BoxFault,
    LineSplitter,
    RefusalCode,
    UnreadableLine,
    encode_line,
    parse_line,
)
from tests.unit.drivers.serial_projector import remote
from tests.unit.drivers.serial_projector.remote import RemoteBox

CRC32 = [zlib.crc32(bytes([number])) for number in range(26)]
WATCHDOG_US, ON_US = 1_000_000, 5_000_000
HELLO = "HELLO 1 1000 5000 1000 1000"


@dataclass
class Light(BoxHardware):
    """A light engine whose clock stands still; `did` : the calls that it got."""

    now_us: int = 1_000
    did: list[str] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)
    dims: bool = True
    takes_us: int = 0
    """Until it is lit."""

    def time_us(self) -> int:
        return self.now_us

    def select(self, pattern: int) -> None:
        self._do("select", str(pattern))

    def light(self) -> None:
        self._do("light")
        self.now_us += self.takes_us

    def switch_off(self) -> None:
        self._do("dark")

    def pulse(self, us: int) -> None:
        self._do("pulse", str(us))

    def set_brightness(self, permille: int) -> int:
        return permille if self.dims else 1000

    def _do(self, *what: str) -> None:
        self.did.append(" ".join(what))
        if what[0] in self.broken:
            message = f"{what[0]} failed"
            raise HardwareError(message)

    def is_lit(self) -> bool:
        done = [each for each in self.did if each in {"light", "dark"}]
        return done[-1] == "light"

    @property
    def shown(self) -> list[int]:
        shown = []
        for index, each in enumerate(self.did):
            if each == "light":
                before = [other for other in self.did[:index] if other.startswith("select")]
                shown.append(int(before[-1].split()[1]))
        return shown


class Host:
    """Sends lines to a core, and reads what comes back."""

    make_box: ClassVar[staticmethod[[BoxHardware, BoxDescription, int], TriggerBox | RemoteBox]]

    def __init__(self, *, crc32: list[int] | None = None, **about: int) -> None:
        self.light = Light()
        limits = {"light_us": 2_000, "error_us": 50, "gap_us": 3_000, "hold_us": 500, "least_us": 200, **about}
        self.box = self.make_box(self.light, BoxDescription("test", "1", 4, 2, crc32 or CRC32, **limits), 0xB007)
        self.number = 0
        self.events: list[BoxEvent] = []

    def send(self, data: bytes) -> list[BoxAnswer | UnreadableLine]:
        answers: list[BoxAnswer | UnreadableLine] = []
        for line in LineSplitter().lines(self.box.feed(data)):
            self._sort(line, answers)
        return answers

    def ask(self, text: str, *, session: str = "1A2B", number: int | None = None) -> BoxAnswer:
        if number is None:
            self.number = number = (self.number + 1) % 10_000
        (answer,) = self.send(encode_line(f"{session} {number} {text}"))
        assert isinstance(answer, BoxAnswer)
        assert (answer.session, answer.number) == (session, number)
        return answer

    def ok(self, text: str, **how: str) -> tuple[str, ...]:
        answer = self.ask(text, **how)  # type: ignore[arg-type]
        assert answer.code is None, answer
        return answer.words

    def refused(self, text: str, **how: str) -> int | None:
        return self.ask(text, **how).code  # type: ignore[arg-type]

    def ready(self, hello: str = HELLO, count: int = 26) -> Host:
        self.ok(hello)
        self.ok(f"LOAD {count} {sequence_checksum(CRC32[:count]):08X}")
        return self

    def pass_us(self, us: int) -> None:
        """Let time pass, in which the box does what it has to."""
        until_us = self.light.now_us + us
        while self.light.now_us < until_us and 0 <= (due_us := self.box.wait_us()) <= until_us - self.light.now_us:
            self.light.now_us += max(due_us, 1)
            for line in LineSplitter().lines(self.box.poll()):
                self._sort(line, [])
        self.light.now_us = max(until_us, self.light.now_us)
        for line in LineSplitter().lines(self.box.poll()):
            self._sort(line, [])

    def state(self) -> str:
        """The state, as PING tells it; a sign of life."""
        return self.ok("PING")[1]

    def _sort(self, line: bytes, answers: list[BoxAnswer | UnreadableLine]) -> None:
        found = parse_line(line)
        assert found is not None, line
        assert len(line) <= 240
        if isinstance(found, BoxEvent):
            self.events.append(found)
        else:
            answers.append(found)


CORES = [
    TriggerBox,
    pytest.param(remote.micropython, marks=pytest.mark.slow),
    pytest.param(remote.arduino, marks=pytest.mark.slow),
]


@pytest.fixture(params=CORES, ids=["reference", "MicroPython", "Arduino"], autouse=True)
def make_box(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with ExitStack() as made:

        def make(*how: Any) -> TriggerBox | RemoteBox:
            box: TriggerBox | RemoteBox = request.param(*how)
            if isinstance(box, RemoteBox):
                made.callback(box.close)
            return box

        monkeypatch.setattr(Host, "make_box", staticmethod(make), raising=False)
        yield


@pytest.fixture
def host() -> Host:
    """In a session with a box that is loaded."""
    return Host().ready()


def test_a_box_starts_dark_and_without_a_session() -> None:
    host = Host()
    assert host.light.did == ["dark"]
    for verb in ("PING", "SHOW 0", "BLANK", "STATUS", "TRIG", "STOP", "BYE", "LOAD 1 00000000", "SEQ 0 1 200 9999 0"):
        assert host.refused(verb) == RefusalCode.SESSION


@pytest.mark.parametrize("text", ["SHOW 3", "SHOW 26", "BYE", "DANCE"])
def test_a_command_that_comes_again_is_answered_again_and_obeyed_once(host: Host, text: str) -> None:
    answers = set()
    for _ in range(12):
        answers.add(host.ask(text, number=77))
        host.light.now_us += 10
    assert len(answers) == 1
    assert host.light.shown == ([3] if text == "SHOW 3" else [])


def test_an_old_number_is_not_obeyed_and_numbers_wrap(host: Host) -> None:
    host.ok("SHOW 3")
    host.ok("SHOW 4")
    assert host.ask("SHOW 3", number=host.number - 1).code == RefusalCode.STATE
    host.number = 4_990
    host.ok("SHOW 5")
    host.number = 9_980
    for index in range(30):
        host.ok(f"SHOW {index % 26}")
    assert host.light.shown == [3, 4, 5, *range(26), 0, 1, 2, 3]
    assert host.number == 10


def test_damaged_and_strange_lines_are_reported(host: Host) -> None:
    whole = encode_line("1A2B 9 SHOW 1")
    strange = ("1A2B", "1A2B 9", "1A2B nine PING", "1A2B 10000 PING", "A 9 PING")
    for data in (whole.replace(b"1*", b"2*"), b"rubbish\n", b"\xff\xfe\n", *map(encode_line, strange)):
        assert host.send(data) == [UnreadableLine()]
    assert host.send(b"\n\r\n") in ([], [UnreadableLine()])
    # Nor does a flood without end of line fill its memory.
    host.send(b"x" * 10_000)
    assert host.send(b"\n") == [UnreadableLine()] or host.send(b"\n") == []
    assert host.light.shown == []
    assert host.send(whole[:5]) == []
    (answer,) = host.send(whole[5:])
    assert isinstance(answer, BoxAnswer)
    assert answer.code is None
    host.number = 9
    assert host.refused("DANCE") == RefusalCode.VERB


@pytest.mark.parametrize(
    "words",
    [
        *("SHOW", "SHOW 1 2", "SHOW x", "SHOW -1", "SHOW 26", "HELLO 1", "SEQ 0 1 2"),
        *("LOAD 26", "LOAD 26 XYZ", "LOAD 0 00000000", "LOAD 27 00000000"),
        *("SEQ 0 27 4000 10000 0", "SEQ 1 26 4000 10000 0", "SEQ 26 1 4000 10000 0", "SEQ 0 0 4000 10000 0"),
        *("SEQ 0 1 4000 10000 2", "SEQ 0 1 199 10000 0", "SEQ 0 1 5000000 9000000 0", "SEQ 0 1 4000 6999 0"),
        *("PICK 1 00000000", "PICK 0", "PICK", "PICK 0 100000000", "PICK 0 -1", "PICK x 0"),
    ],
)
def test_numbers_out_of_range_are_refused(host: Host, words: str) -> None:
    assert host.refused(words) == RefusalCode.RANGE
    if words.startswith("SEQ"):
        assert host.state() == "ready"
    assert not host.light.is_lit()


def test_a_second_session_waits_for_the_first_to_die_or_leave(host: Host) -> None:
    host.ok("SHOW 1")
    assert host.refused(HELLO, session="77F0") == RefusalCode.BUSY
    assert host.refused("BLANK", session="77F0") == RefusalCode.BUSY
    assert host.light.is_lit()
    host.pass_us(WATCHDOG_US + 1)
    assert host.refused("BLANK", session="77F0") == RefusalCode.SESSION
    assert host.ask(HELLO, session="77F0", number=1).code is None
    assert host.refused("SHOW 1") == RefusalCode.BUSY
    assert host.ask("BYE", session="77F0", number=2).code is None
    assert host.refused("SHOW 1") == RefusalCode.SESSION
    assert host.refused("PING", session="77F0") == RefusalCode.SESSION
    host.ready()


# Darkness.


def test_the_watchdog_puts_the_light_out_and_the_host_must_see_it(host: Host) -> None:
    host.ok("SHOW 1")
    host.pass_us(WATCHDOG_US - 1)
    assert host.state() == "lit"
    host.pass_us(WATCHDOG_US)
    assert host.light.is_lit()
    host.pass_us(1)
    assert not host.light.is_lit()
    assert host.events == [BoxEvent("FAULT", (str(BoxFault.WATCHDOG.value),))]
    assert host.ok("PING")[1:] == ("ready", "1")
    for verb in ("SHOW 1", "SEQ 0 26 5000 10000 0", "TRIG"):
        assert host.refused(verb) == RefusalCode.FAULT
    assert not host.light.is_lit()
    host.ok("BLANK")
    host.ok("SEQ 0 26 40000 100000 0")
    host.pass_us(WATCHDOG_US + 1)
    assert host.events[-1] == BoxEvent("FAULT", ("1",))
    shown = len(host.light.shown)
    host.pass_us(2_000_000)
    assert len(host.light.shown) == shown <= 12
    assert not host.light.is_lit()


@pytest.mark.parametrize(
    ("line", "stays"),
    [
        (encode_line("77F0 1 PING"), False),
        (b"rubbish\n", False),
        (encode_line("1A2B 9").replace(b"9", b"8"), False),
        (encode_line("1A2B 3 SHOW 1"), True),
    ],
    ids=["another host", "no line", "a damaged line", "a command sent again"],
)
def test_only_its_own_host_feeds_the_watchdog(host: Host, line: bytes, stays: bool) -> None:
    host.ok("SHOW 1")
    assert host.number == 3
    for _ in range(4):
        host.pass_us(WATCHDOG_US // 3)
        host.send(line)
    assert host.light.is_lit() is stays


def test_a_pattern_is_not_lit_for_longer_than_allowed(host: Host) -> None:
    host.ok("SHOW 1")
    for _ in range(ON_US // 500_000):
        host.pass_us(500_000)
        assert host.light.is_lit()
        host.state()
    host.pass_us(1)
    assert not host.light.is_lit()
    assert host.events == [BoxEvent("FAULT", (str(BoxFault.ON_TIME.value),))]
    host.ok("STOP")
    for index in range(20):
        host.ok(f"SHOW {index}")
        host.pass_us(500_000)
    assert host.light.is_lit(), "another pattern begins its own time"


def test_light_is_rationed_by_duty() -> None:
    host = Host().ready("HELLO 1 1000 60000 300 1000")
    host.ok("SHOW 1")
    begun_us = host.light.now_us
    while not host.events:
        host.pass_us(1_000)
        host.state()
    assert host.events == [BoxEvent("FAULT", (str(BoxFault.DUTY.value),))]
    assert host.light.now_us - begun_us == pytest.approx(3_200_000, abs=2_000)
    host.ok("BLANK")
    assert host.refused("SHOW 1") == RefusalCode.LIMIT
    host.pass_us(6_800_000)
    # The light is ten seconds back only in part.
    host.ok("SHOW 1")
    host.pass_us(700_000)
    assert host.refused("SHOW 2") in {RefusalCode.LIMIT, RefusalCode.FAULT}
    host.ok("BLANK")
    assert host.refused("SEQ 0 26 5000 10000 0") == RefusalCode.LIMIT, "more light than duty in the long run"
    host.pass_us(10_000_001)
    host.ok("SEQ 0 26 5000 20000 0")


@pytest.mark.parametrize(
    "dark", ["BLANK", "STOP", "BYE", "PICK 0 0", "LOAD 27 00000000", HELLO, "HELLO 2 1000 5000 1000 1000"]
)
@pytest.mark.parametrize("lit", ["SHOW 1", "SEQ 0 26 4000 10000 0"])
def test_every_verb_that_is_dark_is(host: Host, lit: str, dark: str) -> None:
    host.ok(lit)
    host.pass_us(4_000)
    assert host.light.is_lit()
    host.ask(dark)
    assert not host.light.is_lit()
    host.pass_us(500_000)
    assert not host.light.is_lit()


@pytest.mark.parametrize("broken", ["select", "light", "pulse"])
def test_an_engine_that_fails_is_dark_and_says_so(host: Host, broken: str) -> None:
    host.light.broken = {broken}
    if broken != "pulse":
        assert host.refused("SHOW 1") == RefusalCode.HARDWARE
        assert not host.light.is_lit()
        assert host.refused("SHOW 1") == RefusalCode.FAULT
        host.ok("BLANK")
    host.light.broken = set()
    host.ok("SEQ 0 26 4000 10000 0")
    host.light.broken = {broken}
    host.pass_us(200_000)
    assert host.events[-1] == BoxEvent("FAULT", (str(BoxFault.LIGHT.value),))
    assert host.light.did[-1] == "dark"
    assert host.state() == "ready"


def test_a_light_that_does_not_go_out_is_switched_off_again_and_again(host: Host) -> None:
    host.ok("SHOW 1")
    host.light.broken = {"dark"}
    assert host.refused("BLANK") == RefusalCode.HARDWARE
    for broken, least, most in (({"dark"}, 21, 1_000), (set[str](), 0, 3), (set[str](), 0, 0)):
        host.light.broken = broken
        tried = host.light.did.count("dark")
        host.pass_us(50_000)
        assert least <= host.light.did.count("dark") - tried <= most
    assert host.ok("PING")[2] == str(BoxFault.LIGHT.value)


# Sequences.


def test_a_sequence_runs_on_its_own_clock_and_can_be_stopped(host: Host) -> None:
    (first_us,) = host.ok("SEQ 2 5 4000 10000 0")
    assert not host.light.is_lit()
    host.light.did.clear()
    host.pass_us(100_000)
    frames = [event.words for event in host.events if event.name == "FRAME"]
    assert [int(index) for index, _ in frames] == [2, 3, 4, 5, 6]
    assert [int(t_us) - int(first_us) for _, t_us in frames] == [0, 10_000, 20_000, 30_000, 40_000]
    assert host.events[-1] == BoxEvent("DONE", ("5",))
    done = [each.split()[0] for each in host.light.did]
    assert done == [*["light", "pulse", "dark", "select"] * 4, "light", "pulse", "dark"]
    assert host.state() == "ready"
    assert host.ok("STOP") == ("5",)
    host.ok("SEQ 0 26 4000 10000 0")
    host.pass_us(35_000)
    assert host.ok("STOP") == ("4",)
    host.light.did.clear()
    host.pass_us(500_000)
    assert host.light.did == []
    for verb in ("SHOW 1", "SEQ 0 26 4000 10000 0"):
        host.ok("BLANK")
        host.ok(verb)


def test_a_pattern_is_lit_for_its_exposure_and_a_box_that_is_late_does_not_hurry(host: Host) -> None:
    host.ok("SEQ 0 1 4000 10000 0")
    host.pass_us(3_000 + 4_499)
    assert host.light.is_lit(), "for its exposure and the hold"
    host.pass_us(1)
    assert not host.light.is_lit()
    host.events.clear()
    host.ok("SEQ 0 3 4000 10000 0")
    host.pass_us(3_000)
    # The program stood still for 50 ms.
    host.light.now_us += 50_000
    host.pass_us(200_000)
    times = [int(event.words[1]) for event in host.events if event.name == "FRAME"]
    assert min(later - earlier for earlier, later in pairwise(times)) >= 9_999
    assert len(times) == 3


def test_a_sequence_waits_for_triggers(host: Host) -> None:
    assert host.refused("TRIG") == RefusalCode.STATE
    host.ok("SEQ 4 3 4000 10000 1")
    host.pass_us(500_000)
    assert host.light.shown == []
    # Nothing else is shown while it goes on.
    assert host.refused("SHOW 1") == RefusalCode.STATE
    assert host.refused("SEQ 0 1 4000 10000 0") == RefusalCode.STATE
    for index in (4, 5, 6):
        shown = host.ok("TRIG")
        assert shown == (str(index), str(host.light.now_us))
        assert host.refused("TRIG") == RefusalCode.STATE, "it is lit"
        host.pass_us(4_500)
        assert not host.light.is_lit()
    assert host.events[-1] == BoxEvent("DONE", ("3",))
    assert host.refused("TRIG") == RefusalCode.STATE
    assert host.light.shown == [4, 5, 6]
    assert host.light.did.count("pulse 4000") == 3


# What is loaded.


def test_any_run_of_the_flash_can_be_loaded_and_nothing_else(host: Host) -> None:
    assert host.ok(f"LOAD 3 {sequence_checksum(CRC32[7:10]):08X}") == ("3", "7", "3000")
    host.ok("SHOW 2")
    assert host.light.shown == [9]
    assert host.refused("SHOW 3") == RefusalCode.RANGE
    assert host.refused(f"LOAD 2 {sequence_checksum([CRC32[0], CRC32[2]]):08X}") == RefusalCode.PATTERNS
    assert not host.light.is_lit()
    assert host.refused("SHOW 0") == RefusalCode.STATE, "what does not fit leaves nothing loaded"


def picked(order: list[int]) -> list[str]:
    """What a host sends to load patterns of the flash in any order."""
    crc32 = [CRC32[index] for index in order]
    lines = (" ".join(f"{each:08X}" for each in crc32[at : at + 16]) for at in range(0, len(crc32), 16))
    return [
        *(f"PICK {16 * at} {line}" for at, line in enumerate(lines)),
        f"LOAD {len(order)} {sequence_checksum(crc32):08X}",
    ]


def test_patterns_are_picked_from_anywhere_in_the_flash() -> None:
    host = Host(step_us=100).ready()
    order = [0, 1, 25, 24, 3, 3, *range(8, 22), 0, 1]
    first, second, load = picked(order)
    assert host.ok(first) == ("16",)
    assert host.state() == "idle"
    assert host.ok(second) == ("22",)
    # Home, and 24 steps: 24 more than to the next one. The sequence may be longer than the flash, too.
    assert host.ok(load) == ("22", "0", str(3000 + 24 * 100))
    for index in range(len(order)):
        host.ok(f"SHOW {index}")
    assert host.light.shown == order
    assert host.refused("SHOW 22") == RefusalCode.RANGE
    assert host.refused("SEQ 0 22 4000 9399 0") == RefusalCode.RANGE
    host.ok("SEQ 2 3 4000 9400 0")
    host.pass_us(100_000)
    assert host.light.shown[22:] == [25, 24, 3]
    run = host.ok(f"LOAD 2 {sequence_checksum(CRC32[:2]):08X}")
    assert run == ("2", "0", "3000"), "what was picked is used up"


def test_patterns_that_the_flash_lacks_are_reported_and_picking_ends_with_its_session(host: Host) -> None:
    assert host.ok(f"PICK 0 {CRC32[4]:08X} 12345678 {CRC32[2]:08X} 0") == ("4", "1", "3")
    assert host.ok(f"PICK 4 {CRC32[0]:08X} 1") == ("6", "5")
    assert host.refused("LOAD 6 00000000") == RefusalCode.PATTERNS
    pick, load = picked([5, 4])
    host.ok(pick)
    assert host.refused(f"LOAD 2 {sequence_checksum([CRC32[2], CRC32[4]]):08X}") == RefusalCode.PATTERNS
    host.ok(pick)
    assert host.ask(pick, number=host.number).words == ("2",)
    host.ok(HELLO)
    assert host.refused(load) == RefusalCode.PATTERNS
    host.ok(pick)
    assert host.ok(load)[:2] == ("2", "5")


def test_limits_are_granted_in_part_and_never_exceeded() -> None:
    host = Host(watchdog_ms=800, on_ms=2_000, duty=400)
    words = dict(word.split("=") for word in host.ok("HELLO 1 5000 60000 1000 250"))
    assert [words[key] for key in ("watchdog_ms", "on_ms", "duty", "bright")] == ["800", "2000", "400", "250"]
    for limits in ("49 5000 1000 1000", "1000 0 1000 1000", "1000 5000 0 1000", "1000 5000 1001 1000"):
        assert host.refused(f"HELLO 1 {limits}") == RefusalCode.RANGE
    assert host.refused("PING") == RefusalCode.SESSION, "a HELLO that is refused leaves no session"
    host.light.dims = False
    assert host.refused("HELLO 1 1000 5000 1000 999") == RefusalCode.RANGE
    host.ok(HELLO)


def test_status_reports_everything(host: Host) -> None:
    words = dict(word.split("=") for word in host.ok("STATUS"))
    assert "index" not in words, "nothing was lit yet"
    host.ok("SHOW 5")
    told = "state=lit loaded=26 first=0 index=5 frames=0 shows=1 fault=0 t_us=1000"
    assert dict(word.split("=") for word in host.ok("STATUS")) == dict(word.split("=") for word in told.split())


# The protocol's page.

PAGE = inspect.getdoc(drivers.serial_projector) or ""
IMAGES = (b"\xff" * 8, b"\x00" * 8, b"\xff\xff\x00\x00" * 2)
EXAMPLE = re.compile(r"^ +(\d*) *([<>|]) (.*)$", re.MULTILINE)


def example() -> list[tuple[int | None, str, str]]:
    """(time or None, direction, text) of the page's example."""
    lines: list[tuple[int | None, str, str]] = []
    for time_us, direction, text in EXAMPLE.findall(PAGE.partition("\nA session\n")[2]):
        if direction == "|":
            at, before, begun = lines.pop()
            lines.append((at, before, f"{begun} {text}"))
        else:
            lines.append((int(time_us) if time_us else None, direction, text))
    return lines


def test_the_pages_example_is_what_the_reference_box_answers() -> None:
    crc32 = [zlib.crc32(image) for image in IMAGES]
    about = BoxDescription(
        "example", "1.0", 4, 2, crc32, light_us=2000, error_us=50, gap_us=3000, hold_us=500, least_us=200
    )
    light = Light(now_us=0, takes_us=20)
    box = Host.make_box(light, about, 0xC0FFEE)
    waiting: list[str] = []
    for time_us, direction, text in example():
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
    assert sum(direction == ">" for _, direction, _ in example()) >= 10
    assert all(f"({value:08X})" in PAGE for value in crc32)
    assert f"LOAD 3 {sequence_checksum(crc32):08X}*" in PAGE
    faulty = [text for _, _, text in example() if wire.decode_line(text.encode()) is None]
    assert len(faulty) == 1, "one line of the example is damaged, as it says"


def test_the_page_names_everything_that_goes_over_the_wire() -> None:
    verbs = {"HELLO", "PING", "PICK", "LOAD", "SHOW", "SEQ", "TRIG", "STOP", "BLANK", "STATUS", "BYE"}
    assert {verb for verb in verbs if re.search(rf"^    {verb}\b", PAGE, re.MULTILINE)} == verbs
    assert all(f"{name}=" in PAGE for name in (*BoxInfo.__dataclass_fields__, *BoxStatus.__dataclass_fields__))
    errors = PAGE.partition("Errors: ")[2].partition("\n\n")[0]
    assert {int(code) for code in re.findall(r"(?:^|[.\n] ?)(\d+) [a-z<]", errors)} == {
        each.value for each in RefusalCode
    }
    faults = PAGE.partition("cannot miss it. ")[2].partition("\n\n")[0]
    assert {int(code) for code in re.findall(r"(\d): ", faults)} == {each.value for each in BoxFault}

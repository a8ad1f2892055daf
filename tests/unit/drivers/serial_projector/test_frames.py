"""Lines: the host's codec, the box's, and what damage does to them."""

from __future__ import annotations

import random

import pytest

from drivers.serial_projector.device import wire
from drivers.serial_projector.frames import (
    MOST_LINE_BYTES,
    NUMBERS,
    Answer,
    Event,
    Fault,
    Mode,
    Refused,
    Splitter,
    Unread,
    framed,
    parsed,
)
from tests.unit.drivers.serial_projector.line import Noise


def test_the_checksum_is_the_one_with_the_published_check_value() -> None:
    assert wire.crc16(b"123456789") == 0x29B1
    assert framed("123456789") == b"123456789*29B1\n"


@pytest.mark.parametrize("text", ["1A2B 7 SHOW 3", "! DONE 26", "x", "a b " * 50])
def test_host_and_box_write_the_same_lines_and_read_each_others(text: str) -> None:
    assert wire.framed(text) == framed(text)
    assert wire.unframed(framed(text)[:-1]) == text


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("1A2B 7 OK 3 120", Answer("1A2B", 7, None, ("3", "120"))),
        ("1A2B 7 OK", Answer("1A2B", 7, None, ())),
        ("1A2B 7 ERR 4 26 of 26", Answer("1A2B", 7, 4, ("26", "of", "26"))),
        ("! FRAME 3 120", Event("FRAME", ("3", "120"))),
        ("? ERR 1 bad frame", Unread()),
        ("1A2B seven OK", None),
        ("1A2B 7 MAYBE", None),
        ("hello", None),
    ],
)
def test_lines_are_told_apart(text: str, line: object) -> None:
    assert parsed(framed(text)) == line
    assert parsed(framed(text)[:-1] + b"\r\n") == line


def test_a_damaged_line_is_never_taken_for_another_one() -> None:
    # Bursts of up to 16 bits are always found; what is longer slips through once in 65 536.
    noise = Noise(corruption=1.0, seed=3)
    line = framed("1A2B 7 SHOW 3")
    survived = 0
    for _ in range(20_000):
        received = noise.through(line)
        for each in Splitter().lines(received + b"\n"):
            answer = wire.unframed(each)
            survived += answer is not None
            assert answer in {None, "1A2B 7 SHOW 3"}
    # A line that lost its end, or has noise before it, may still be whole.
    assert survived < 2_000


def test_every_flipped_bit_is_found() -> None:
    line = framed("1A2B 7 SHOW 3")[:-1]
    for at in range(len(line)):
        for bit in range(8):
            flipped = line[:at] + bytes([line[at] ^ 1 << bit]) + line[at + 1 :]
            assert parsed(flipped) is None
            assert wire.unframed(flipped) is None


def test_bytes_come_in_pieces_of_any_size() -> None:
    text = b"".join(framed(f"1A2B {number} PING") for number in range(50))
    rng = random.Random(1)
    splitter, lines = Splitter(), []
    while text:
        size = rng.randrange(1, 40)
        lines += splitter.lines(text[:size])
        text = text[size:]
    assert len(lines) == 50
    assert all(isinstance(wire.unframed(line), str) for line in lines)


def test_a_line_without_end_does_not_fill_the_memory() -> None:
    splitter = Splitter()
    for _ in range(1_000):
        assert splitter.lines(b"x" * 100) == []
    assert splitter.lines(b"\n" + framed("1A2B 1 PING"))[1:] == [framed("1A2B 1 PING")[:-1]]


def test_the_numbers_of_errors_and_faults_are_the_same_at_both_ends() -> None:
    for kind in (Refused, Fault, Mode):
        assert {each.name: each.value for each in kind} == {each.name: getattr(wire, each.name) for each in kind}
    assert wire.NUMBERS == NUMBERS
    assert wire.MOST_LINE_BYTES == MOST_LINE_BYTES

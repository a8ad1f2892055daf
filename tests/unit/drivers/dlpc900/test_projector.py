"""What only this driver does, above a peer that keeps its guide's rules, and the pictures that it sends."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from drivers.dlpc900.engine import MAX_PICTURES, encode_picture, pack_sequence
from drivers.pattern_engine.projector import pattern_plane
from slrig.errors import DeviceError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, PatternSequence, Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc900_bench import MIRRORS
from tests.contract.dlpc900_device import unpacked
from tests.contract.suite import whole_scan
from tests.unit.drivers.pattern_engine.engine_bench import LEDS, LINES, START_STOP
from tests.unit.drivers.pattern_engine.engine_bench import SEQUENCE_900 as SEQUENCE
from tests.unit.drivers.pattern_engine.engine_bench import Bench900 as Bench

START = STOP = START_STOP


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_table_comes_before_the_pictures_and_these_last_one_first(bench: Bench) -> None:
    projector = bench.open()
    bench.commands()
    projector.load(encode((White(), LINES, LineShift(Axis.ROW, 1, 8)), MIRRORS))
    sent = list(bench.engine.commands)
    first = [index for index, (command, _) in enumerate(sent) if command == 0x1A2A]
    assert [command for command, _ in sent[: first[0]]] == [LEDS, STOP, *[0x1A34] * 4, 0x1A31]
    assert [struct.unpack("<HI", data)[0] for command, data in sent if command == 0x1A2A] == [1, 0]
    assert bench.engine.lit is None
    bench.commands()
    projector.show(2)
    # The pattern, one without LEDs, the table, their order: nothing is sent again that the engine has.
    assert bench.commands() == [LEDS, STOP, 0x1A34, 0x1A34, 0x1A31, 0x1A32, LEDS, START]
    projector.show(2)
    assert bench.commands() == [LEDS, STOP, 0x1A31, 0x1A32, LEDS, START]


def test_two_controllers_share_the_columns() -> None:
    bench = Bench(mirrors=2)
    projector = bench.open()
    size = Size(2560, 1600)
    assert projector.info.size == size
    sequence = encode((White(), Black(), LineShift(Axis.COLUMN, 3, 7)), size)
    projector.load(sequence)
    assert {0x1A2A, 0x1A2C} <= set(bench.commands())
    projector.show(2)
    assert bench.shows(sequence.profiles[2])
    projector.close()
    bench.engine.second_ready = False
    with pytest.raises(DeviceError, match="the second one does not answer"):
        bench.open()


def test_each_entry_of_a_played_sequence_has_its_light_and_the_dark_after_it(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(SEQUENCE)
    projector.play(0.01, 0.03)
    entries = [bench.engine.entries[index] for index in range(3)]
    assert {(entry.exposure_us, entry.dark_us, entry.leds, entry.cleared) for entry in entries} == {
        (12_000, 18_000, 7, True)
    }


@pytest.mark.parametrize(
    ("version", "mirrors", "told"),
    [
        ((5, 9), 1, "firmware 5.9, this driver needs 6.0"),
        ((6, 0), 9, "mirrors of type 9, this driver supports DLP6500"),
    ],
)
def test_what_is_not_known_is_refused_and_left_dark(version: tuple[int, int], mirrors: int, told: str) -> None:
    bench = Bench(version=version)
    bench.engine.mirrors = mirrors
    with pytest.raises(UnsupportedByDeviceError, match=told):
        bench.open()
    assert bench.engine.lit is None


def test_an_engine_that_never_says_that_it_has_stopped_is_waited_for_once(bench: Bench) -> None:
    bench.engine.bent = {0x1A0C: b"\2"}
    projector = bench.loaded()
    for index in (0, 2):
        begun_ns = bench.clock.now_ns()
        projector.show(index)
        assert bench.shows(SEQUENCE.profiles[index])
        assert bench.clock.now_ns() - begun_ns == 20_000_000


def test_what_the_engine_refuses_is_reported_in_its_words_and_it_is_dark(bench: Bench) -> None:
    projector = bench.open()
    bench.engine.refusing = {0x1A34: 8}
    with pytest.raises(UnsupportedByDeviceError, match=r"take definition .*its memory is full"):
        projector.load(SEQUENCE)
    with pytest.raises(DeviceStateError):
        projector.show(0)
    # Data is not answered: what is wrong with it is found in the error code.
    bench.engine.refusing = {0x1A2B: 9}
    with pytest.raises(UnsupportedByDeviceError, match=r"take picture 0: the picture.s encoding is unknown"):
        projector.load(SEQUENCE)
    bench.engine.refusing = {}
    projector.load(SEQUENCE)
    bench.engine._hardware |= 128
    for use in (lambda: projector.show(0), lambda: projector.play(0.01, 0.02)):
        with pytest.raises(DeviceError, match="the sequencer failed"):
            use()
        assert bench.engine.lit is None
        assert not bench.engine.running


def test_a_piece_of_a_picture_that_went_wrong_is_not_hidden_by_the_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    projector = bench.open()
    bench.commands()
    projector.load(SEQUENCE)
    assert bench.commands().count(0x1A2B) > 2
    answers = iter((6, *[0] * 100))
    monkeypatch.setattr(bench.engine, "_load", lambda _half, _data: next(answers))
    with pytest.raises(UnsupportedByDeviceError, match="take picture 0: a parameter is invalid"):
        projector.load(SEQUENCE)
    assert bench.commands().count(0x1A2B) == 1


def test_a_picture_is_packed_as_the_guides_example() -> None:
    # The pixels of DLPU018 table 2-110, in lines of 13.
    first = [0x040506] * 3 + [0x777777] * 5 + [0x040506, 0x070809, 0x0A0B0C] + [0x789ABC] * 2
    picture = np.array([first, first, [0x010203] + [0x040506] * 12], np.uint32)
    content = encode_picture(picture)
    assert content[:8] == b"Spld" + bytes([13, 0, 3, 0])
    assert content[12:48] == b"\xff" * 8 + bytes(4) + bytes([0, 2, 1]) + bytes(21)
    assert int.from_bytes(content[8:12], "little") == len(content) - 48
    told = "03 040506  05 777777  00 03 040506 070809 0a0b0c  02 789abc  00 01 0d  01 010203  0c 040506  00 01 00"
    data = bytes.fromhex(told)
    assert content[48:] == data + bytes(-len(data) % 4)


def test_long_runs_take_two_bytes() -> None:
    content = encode_picture(np.full((2, 0x1234), 0x789ABC, np.uint32))
    # The number of the guide's own example.
    assert content[48:58] == bytes.fromhex("b4 24 789abc 00 01 b4 24 00")


@pytest.mark.parametrize("seed", range(2))
def test_any_picture_comes_out_as_it_went_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = Size(300 + seed, 7)
    picture = np.repeat(rng.integers(0, 2**24, (7, 60), np.uint32), rng.integers(1, 9, 60), axis=1)[:, : size.width_px]
    picture = np.pad(picture, ((0, 0), (0, size.width_px - picture.shape[1])))
    picture[3] = picture[2]
    out = unpacked(encode_picture(picture), size)
    assert out is not None
    assert np.array_equal(out, picture)


def test_patterns_lie_where_the_table_says_each_once() -> None:
    shown = whole_scan(Size(480, 270), rows=True)
    memory = pack_sequence(shown)
    for index in range(len(shown)):
        place = memory.places[index]
        assert np.array_equal(memory.pictures[place.picture] >> np.uint32(place.plane) & 1, pattern_plane(shown, index))
    dark = memory.places[-1]
    assert not (memory.pictures[dark.picture] >> np.uint32(dark.plane) & 1).any()
    assert len(set(memory.places)) == len({profile.tobytes() for profile in shown.profiles})
    # What 24 patterns take over USB. Mixed directions in one picture would take far more.
    assert max(len(encode_picture(picture)) for picture in memory.pictures) < 5_000


def test_more_than_the_engine_holds_is_refused() -> None:
    small = Size(500, 2)
    one = encode((White(),), small)
    with pytest.raises(UnsupportedByDeviceError, match=r"400 patterns .* takes 399 in 18"):
        pack_sequence(PatternSequence(small, one.patterns * 400, one.profiles * 400))
    pack_sequence(PatternSequence(small, one.patterns * 399, one.profiles * 399))
    lines = tuple(LineShift(Axis.COLUMN, shift, 500) for shift in range(24 * MAX_PICTURES))
    with pytest.raises(UnsupportedByDeviceError, match="in 19 pictures"):
        pack_sequence(encode((*lines, Black()), small))

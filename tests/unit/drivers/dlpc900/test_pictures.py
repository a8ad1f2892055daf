"""Pictures as they are sent: header and packing byte by byte, and unpacked by the guide's rules."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.dlpc900.pictures import MOST_PICTURES, memory_of, packed
from drivers.pattern_engine.planes import plane_of
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, PatternSequence, Size, White
from slrig.patterns.sequence import encode
from tests.contract.bench_head import whole_scan
from tests.contract.dlpc900_device import unpacked


def test_a_picture_is_packed_as_the_guides_example() -> None:
    # The pixels of DLPU018 table 2-110, in lines of 13.
    first = [0x040506] * 3 + [0x777777] * 5 + [0x040506, 0x070809, 0x0A0B0C] + [0x789ABC] * 2
    picture = np.array([first, first, [0x010203] + [0x040506] * 12], np.uint32)
    content = packed(picture)
    assert content[:8] == b"Spld" + bytes([13, 0, 3, 0])
    assert content[12:48] == b"\xff" * 8 + bytes(4) + bytes([0, 2, 1]) + bytes(21)
    assert int.from_bytes(content[8:12], "little") == len(content) - 48
    told = "03 040506  05 777777  00 03 040506 070809 0a0b0c  02 789abc  00 01 0d  01 010203  0c 040506  00 01 00"
    data = bytes.fromhex(told)
    assert content[48:] == data + bytes(-len(data) % 4)


def test_long_runs_take_two_bytes() -> None:
    content = packed(np.full((2, 0x1234), 0x789ABC, np.uint32))
    # The number of the guide's own example.
    assert content[48:58] == bytes.fromhex("b4 24 789abc 00 01 b4 24 00")


@pytest.mark.parametrize("seed", range(2))
def test_any_picture_comes_out_as_it_went_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = Size(300 + seed, 7)
    picture = np.repeat(rng.integers(0, 2**24, (7, 60), np.uint32), rng.integers(1, 9, 60), axis=1)[:, : size.width_px]
    picture = np.pad(picture, ((0, 0), (0, size.width_px - picture.shape[1])))
    picture[3] = picture[2]
    out = unpacked(packed(picture), size)
    assert out is not None
    assert np.array_equal(out, picture)


def test_patterns_lie_where_the_table_says_each_once() -> None:
    shown = whole_scan(Size(480, 270), rows=True)
    memory = memory_of(shown)
    for index in range(len(shown)):
        place = memory.places[index]
        assert np.array_equal(memory.pictures[place.picture] >> np.uint32(place.plane) & 1, plane_of(shown, index))
    dark = memory.places[-1]
    assert not (memory.pictures[dark.picture] >> np.uint32(dark.plane) & 1).any()
    assert len(set(memory.places)) == len({profile.tobytes() for profile in shown.profiles})
    # What 24 patterns take over USB. Mixed directions in one picture would take far more.
    assert max(len(packed(picture)) for picture in memory.pictures) < 5_000


def test_more_than_the_engine_holds_is_refused() -> None:
    small = Size(500, 2)
    one = encode((White(),), small)
    with pytest.raises(UnsupportedByDeviceError, match=r"400 patterns .* takes 399 in 18"):
        memory_of(PatternSequence(small, one.patterns * 400, one.profiles * 400))
    memory_of(PatternSequence(small, one.patterns * 399, one.profiles * 399))
    lines = tuple(LineShift(Axis.COLUMN, shift, 500) for shift in range(24 * MOST_PICTURES))
    with pytest.raises(UnsupportedByDeviceError, match="in 19 pictures"):
        memory_of(encode((*lines, Black()), small))

"""What all display outputs share: EDIDs, when a picture's light is there, the thread that the work is done on."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from drivers.display.edid import parse
from drivers.display.pixels import coloured
from drivers.display.timing import copied, flipped, queued, whole_light
from drivers.display.working import OwnThread
from slrig.errors import DeviceError, DeviceGoneError
from slrig.model import Pattern, Primary, White

SECOND_NS = 10**9
LIGHTS: tuple[Pattern, ...] = (Primary("red"), Primary("green"), Primary("blue"), White())


def edid(*, maker: str = "EPS", name: str = "PJ 720", serial: str = "X1234", number: int = 0) -> bytes:
    packed = sum((ord(letter) - 64) << shift for letter, shift in zip(maker, (10, 5, 0), strict=True))
    block = bytearray(128)
    block[:8] = bytes.fromhex("00ffffffffffff00")
    block[8:10] = packed.to_bytes(2, "big")
    block[12:16] = number.to_bytes(4, "little")
    for at, tag, text in ((72, 0xFC, name), (90, 0xFF, serial)):
        if text:
            block[at : at + 5] = bytes([0, 0, 0, tag, 0])
            block[at + 5 : at + 18] = f"{text}\n".encode().ljust(13)
    block[127] = -sum(block) % 256
    return bytes(block)


def test_an_edid_names_its_display() -> None:
    found = parse(edid())
    assert found is not None
    assert (found.maker, found.name, found.serial, str(found)) == ("EPS", "PJ 720", "X1234", "EPS PJ 720")


def test_a_number_is_a_serial_too() -> None:
    found = parse(edid(serial="", number=77))
    assert found is not None
    assert found.serial == "77"


@pytest.mark.parametrize("at", [0, 9, 127])
def test_a_damaged_edid_names_none(at: int) -> None:
    block = bytearray(edid())
    block[at] ^= 0x10
    assert parse(bytes(block)) is None


def test_a_flip_lights_the_scene_one_refresh_later() -> None:
    lit, err = whole_light(flipped(SECOND_NS), refresh_s=0.02, latency_s=0.03, latency_error_s=0.0)
    assert lit == SECOND_NS + 50_000_000
    assert err == 500_000


def test_a_copy_may_miss_the_rows_that_were_scanned_out() -> None:
    lit, err = whole_light(copied(SECOND_NS, 0.02), refresh_s=0.02, latency_s=0.0, latency_error_s=0.0)
    # All rows were copied in time, or none of them.
    assert lit - err <= SECOND_NS + 20_000_000
    assert lit + err >= SECOND_NS + 40_000_000


def test_a_call_that_returned_tells_of_a_span() -> None:
    presented = queued(SECOND_NS, SECOND_NS + 7_000_000, 0.01)
    lit, err = whole_light(presented, refresh_s=0.01, latency_s=0.0, latency_error_s=0.004)
    assert lit - err <= SECOND_NS + 10_000_000 - 4_000_000
    assert lit + err >= SECOND_NS + 7_000_000 + 30_000_000 + 4_000_000


def test_what_is_done_on_the_own_thread_is_done_there() -> None:
    thread = OwnThread("the screen")
    assert thread.do(threading.get_ident, timeout_s=5) not in (threading.get_ident(), 0)
    with pytest.raises(DeviceGoneError, match="pulled"):
        thread.do(_fail, timeout_s=5)
    thread.end(timeout_s=5)


def test_a_hanging_thread_is_told_of_and_goes_on_later() -> None:
    thread, hang = OwnThread("the screen"), threading.Event()
    with pytest.raises(DeviceError, match=r"the screen did not answer in 0\.01 s"):
        thread.do(hang.wait, timeout_s=0.01)
    skipped: list[int] = []
    with pytest.raises(DeviceError, match="did not answer"):
        thread.do(lambda: skipped.append(1), timeout_s=0.01)
    hang.set()
    assert thread.do(lambda: "well", timeout_s=5) == "well"
    # What nobody waits for any more is not done late.
    assert not skipped
    thread.end(timeout_s=5)


def _fail() -> None:
    message = "the cable was pulled"
    raise DeviceGoneError(message)


def test_white_in_one_light_has_pixels_of_that_colour() -> None:
    words = [int(coloured(np.full((1, 1), 255, np.uint8), pattern)[0, 0]) for pattern in LIGHTS]
    assert words == [0xFF0000, 0x00FF00, 0x0000FF, 0xFFFFFF]

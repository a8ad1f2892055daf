"""What all display outputs share: EDIDs, when a picture's light is there, the thread that the work is done on."""

from __future__ import annotations

import threading
from unittest import mock

import numpy as np
import pytest

from drivers.display.projector import (
    ScanoutStart,
    WorkerThread,
    full_light_time,
    parse_edid,
    rgb_pixels,
    start_of_copy,
    start_of_flip,
    start_of_queued,
)
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


def test_an_edid_names_its_display_and_a_damaged_one_none() -> None:
    found = parse_edid(edid())
    assert found is not None
    assert (found.maker, found.name, found.serial, str(found)) == ("EPS", "PJ 720", "X1234", "EPS PJ 720")
    # A number is a serial, too.
    assert getattr(parse_edid(edid(serial="", number=77)), "serial", None) == "77"
    for at in (0, 9, 127):
        block = bytearray(edid())
        block[at] ^= 0x10
        assert parse_edid(bytes(block)) is None


@pytest.mark.parametrize(
    ("presented", "latency_s", "error_s", "earliest_ms", "latest_ms"),
    [
        # A flip lights the scene one refresh later.
        (start_of_flip(SECOND_NS), 0.03, 0.0, 49.5, 50.5),
        # A copy may miss the rows that were scanned out: all of them were copied in time, or none.
        (start_of_copy(SECOND_NS, 0.02), 0.0, 0.0, 20, 40),
        # A call that returned tells of a span.
        (start_of_queued(SECOND_NS, SECOND_NS + 7_000_000, 0.02), 0.0, 0.004, 20 - 4, 7 + 60 + 4),
    ],
    ids=["flipped", "copied", "queued"],
)
def test_full_light_time(
    presented: ScanoutStart, latency_s: float, error_s: float, earliest_ms: float, latest_ms: float
) -> None:
    lit, err = full_light_time(presented, refresh_s=0.02, latency_s=latency_s, latency_error_s=error_s)
    assert (lit - err - SECOND_NS) / 1e6 <= earliest_ms
    assert (lit + err - SECOND_NS) / 1e6 >= latest_ms
    assert err / 1e6 <= (latest_ms - earliest_ms) / 2 + 1


def test_jobs_run_on_the_worker_thread_and_a_hang_is_reported() -> None:
    thread, hang = WorkerThread("the screen"), threading.Event()
    assert thread.run(threading.get_ident, timeout_s=5) not in (threading.get_ident(), 0)
    with pytest.raises(DeviceGoneError, match="pulled"):
        thread.run(mock.Mock(side_effect=DeviceGoneError("the cable was pulled")), timeout_s=5)
    with pytest.raises(DeviceError, match=r"the screen did not answer in 0\.01 s"):
        thread.run(hang.wait, timeout_s=0.01)
    skipped = mock.Mock()
    with pytest.raises(DeviceError, match="did not answer"):
        thread.run(skipped, timeout_s=0.01)
    hang.set()
    assert thread.run(lambda: "well", timeout_s=5) == "well"
    # What was given up is not done late.
    skipped.assert_not_called()
    thread.end(timeout_s=5)


def test_white_in_one_primary_has_pixels_of_that_colour() -> None:
    words = [int(rgb_pixels(np.full((1, 1), 255, np.uint8), pattern)[0, 0]) for pattern in LIGHTS]
    assert words == [0xFF0000, 0x00FF00, 0x0000FF, 0xFFFFFF]

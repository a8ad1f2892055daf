"""What is asked of the drivers v4l2 and opencv on the kernel's vivid, in the guest.

`python -m tests.contract.guest.vivid_checks FILE [PART_OF_A_NAME ...]` writes what came of each check to FILE, as JSON.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers import v4l2
from slrig.conformance import run_checks
from slrig.conformance.bench import default_settings
from slrig.devices import Camera, Trigger
from slrig.errors import DeviceBusyError, DeviceGoneError, FrameTimeoutError
from tests.contract import vivid_bench
from tests.contract.guest.outcome import Notes, outcome
from tests.contract.guest.vivid import BARE, LOOPED, Control, Output, nodes
from tests.contract.suite import sequence_for
from tests.contract.vivid_bench import DRIVERS

FRAMES = {"v4l2": 500, "opencv": 300}
"""Patterns shown per time stamp source, each paired with a frame under disturbance. See `tests.contract.pairing.FRAMES`
for what 500 find."""
DROPPED_PERCENT = 10
CORRUPT_SHARE = 0.05
IDLE_SHARE = 0.1
LONGEST_IDLE_S = 0.2
PATIENCE_S = 20.0  # an emulated machine beside busy neighbours
SOURCES = ("end of frame", "start of exposure")
"""Where vivid's time stamps are taken, by the value of its control."""

UNPLUGGED = {"v4l2": 1, "opencv": 2}
DYING, FORMATS, BUSY = 3, 4, 5
"""The looped instances that the harsher checks have for themselves; 0 is the bench's."""
TOLD_APART, GOES = (6, 7), 8
"""The bare instances."""
BLACK, WHITE = 5, 6
"""vivid's own test patterns."""


@contextmanager
def armed(camera: Camera) -> Iterator[Camera]:
    try:
        camera.configure(default_settings(camera))
        camera.arm(10_000, Trigger.FREE)
        yield camera
    finally:
        camera.close()


def open_camera(instance: int, driver: str = "v4l2", /, **more: object) -> Camera:
    return DRIVERS[driver]("left", vivid_bench.options(instance, driver, **more), Path())


def pairing(driver: str, source: int, notes: Notes) -> None:
    """Count frames that do not show the pattern that they were read for: none, whatever is dropped, late or corrupt.

    Dropped buffers also make the projector late: its output node drops them, too.
    """
    node = vivid_bench.camera_node(0)
    node.set(Control.TIMESTAMP_SOURCE, source)
    sequence, frames = sequence_for(vivid_bench.PROJECTOR), FRAMES[driver]
    rng = np.random.default_rng(source)
    head = vivid_bench.head(Path(), driver)
    wrong, late, injected, previous, frame = 0, 0, 0, -1, None
    begun = time.monotonic()
    try:
        with armed(head.cameras["left"]) as camera:
            head.projector.load(sequence)
            node.set(Control.DROPPED_PERCENT, DROPPED_PERCENT)
            for _ in range(frames):
                if rng.random() < IDLE_SHARE:
                    threading.Event().wait(float(rng.random()) * LONGEST_IDLE_S)
                index = int(rng.choice([i for i in range(len(sequence)) if i != previous]))
                shown = head.projector.show(index)
                previous = index
                # About two buffers are filled for each that is read.
                if rng.random() < 2 * CORRUPT_SHARE:
                    node.set(Control.BUFFER_ERROR)
                    injected += 1
                try:
                    frame = camera.read(shown.t_visible_ns + shown.t_err_ns, PATIENCE_S)
                except FrameTimeoutError:
                    late += 1
                    continue
                wrong += not np.array_equal(frame.image, vivid_bench.expected(sequence.profiles[index]))
    finally:
        node.set(Control.DROPPED_PERCENT, 0)
        head.projector.close()
    assert frame is not None
    notes |= {
        "patterns": frames,
        "wrong": wrong,
        "timed out": late,
        "corrupt injected": injected,
        "lost, by the driver's count": frame.dropped_count,
        "ms per pattern": round((time.monotonic() - begun) / frames * 1e3, 1),
    }
    assert wrong == 0
    assert late == 0
    # OpenCV does not tell which buffers the kernel has marked; vivid's are whole, and in their time.
    assert driver == "opencv" or frame.dropped_count > injected


def a_reader_without_the_rule_gets_wrong_frames(notes: Notes) -> None:
    """Read without asking for the light's time: wrong frames come, so `pairing` would have seen them."""
    sequence = sequence_for(vivid_bench.PROJECTOR)
    head = vivid_bench.head(Path())
    wrong, count = 0, 20
    with armed(head.cameras["left"]) as camera:
        head.projector.load(sequence)
        for index in range(count):
            head.projector.show(index)
            frame = camera.read(0, PATIENCE_S)
            wrong += not np.array_equal(frame.image, vivid_bench.expected(sequence.profiles[index]))
    head.projector.close()
    notes |= {"patterns": count, "wrong": wrong}
    assert wrong >= 5


def found_cameras_have_names_of_their_own(notes: Notes) -> None:
    """Nine cameras on one parent, six with an output beside them: nine names, each opening its own camera."""
    found = v4l2.find_devices()
    notes |= {"found": len(found), "first": found[0].device}
    assert len(found) == LOOPED + BARE
    assert len({device.device for device in found}) == len(found)
    bare = [vivid_bench.camera_node(instance) for instance in TOLD_APART]
    for chosen in bare:
        for node in bare:
            node.set(Control.TEST_PATTERN, WHITE if node is chosen else BLACK)
        means = {}
        for device in found:
            if any(f"({node.path})" in device.label for node in bare):
                table = {"device": device.device, "pixel_format": "GREY", "size_px": [320, 180], "frame_rate_hz": 60}
                with armed(v4l2.open_camera("left", table, Path())) as camera:
                    means[device.label] = float(camera.read(time.monotonic_ns(), PATIENCE_S).image.mean())
        lit = [label for label, mean in means.items() if mean > 200]
        dark = [label for label, mean in means.items() if mean < 50]
        assert (len(lit), len(dark)) == (1, len(bare) - 1), means
        assert f"({chosen.path})" in lit[0]


def a_camera_that_another_program_streams_from_is_busy(driver: str, notes: Notes) -> None:
    with armed(open_camera(BUSY)) as camera:
        with pytest.raises(DeviceBusyError, match="/dev/video") as refused, armed(open_camera(BUSY, driver)):
            pass
        notes["says"] = str(refused.value)
        assert camera.read(time.monotonic_ns(), PATIENCE_S).image.size
    with armed(open_camera(BUSY, driver)) as camera:
        assert camera.read(time.monotonic_ns(), PATIENCE_S).image.size


def an_unplugged_camera_is_gone(driver: str, _: Notes) -> None:
    """Pulled while a frame is waited for: closed without an error, not opened again."""
    node = vivid_bench.camera_node(UNPLUGGED[driver])
    with armed(open_camera(UNPLUGGED[driver], driver)) as camera:
        thread = threading.Timer(0.2, node.set, (Control.DISCONNECT,))
        thread.start()
        with pytest.raises(DeviceGoneError):
            camera.read(time.monotonic_ns() + 60 * 10**9, 30.0)
        thread.join()
        with pytest.raises(DeviceGoneError):
            camera.read(0, PATIENCE_S)
        camera.disarm()
    camera.close()
    with pytest.raises(DeviceGoneError):
        open_camera(UNPLUGGED[driver], driver)


def an_unplugged_camera_is_not_found(_: Notes) -> None:
    """Its node stays for as long as somebody has it open; it is no camera any more."""
    before = {device.device for device in v4l2.find_devices()}
    node = vivid_bench.camera_node(GOES)
    node.set(Control.DISCONNECT)
    after = {device.device for device in v4l2.find_devices()}
    assert after < before
    assert len(after) == len(before) - 1


def a_stream_that_dies_is_gone_and_can_be_reopened(driver: str, _: Notes) -> None:
    node = vivid_bench.camera_node(DYING)
    with armed(open_camera(DYING, driver)) as camera:
        camera.read(time.monotonic_ns(), PATIENCE_S)
        node.set(Control.FATAL_ERROR)
        with pytest.raises(DeviceGoneError):
            camera.read(time.monotonic_ns() + 60 * 10**9, PATIENCE_S)
    with armed(open_camera(DYING, driver)) as camera:
        assert camera.read(time.monotonic_ns(), PATIENCE_S).image.size


def samples_come_as_they_were_sent(driver: str, notes: Notes) -> None:
    """Write random samples to the output in each format, and read them through the kernel's camera."""
    rng = np.random.default_rng(0)
    size = vivid_bench.CAMERA
    vivid_bench.camera_node(FORMATS)
    path = nodes()[f"vivid-{FORMATS:03d}-vid-out"]
    formats = (("GREY", 8), ("Y10 ", 10), ("Y12 ", 12), ("Y16 ", 16), ("YUYV", 8), ("UYVY", 8))
    for pixel_format, bits in formats:
        sent = rng.integers(0, 2**bits, size.shape).astype(np.uint8 if bits == 8 else "<u2")
        data = sent
        if pixel_format in {"YUYV", "UYVY"}:
            colour = rng.integers(0, 256, size.shape, dtype=np.uint8)
            data = np.stack([sent, colour] if pixel_format == "YUYV" else [colour, sent], axis=-1)
        output = Output(path, pixel_format, size.width_px, size.height_px, dark=bytes(data.nbytes))
        try:
            named = {"pixel_format" if driver == "v4l2" else "fourcc": pixel_format.strip()}
            with armed(open_camera(FORMATS, driver, **named)) as camera:
                assert camera.info.format.bit_depth == bits
                frame = camera.read(output.show(data.tobytes()) + 1_000, PATIENCE_S)
                assert frame.image.dtype == (np.uint8 if bits == 8 else np.uint16)
                assert np.array_equal(frame.image, sent), pixel_format
        finally:
            output.close()
    notes["formats"] = len(formats)


_OF_V4L2 = (
    found_cameras_have_names_of_their_own,
    a_reader_without_the_rule_gets_wrong_frames,
    an_unplugged_camera_is_not_found,
)
_OF_EACH = (
    samples_come_as_they_were_sent,
    a_camera_that_another_program_streams_from_is_busy,
    a_stream_that_dies_is_gone_and_can_be_reopened,
    an_unplugged_camera_is_gone,
)
ALL: dict[str, Callable[[Notes], None]] = {
    **{f"v4l2: {check.__name__}": check for check in _OF_V4L2},
    **{
        f"{driver}: pairing with stamps of {words}": partial(pairing, driver, source)
        for driver in DRIVERS
        for source, words in enumerate(SOURCES)
    },
    **{f"{driver}: {check.__name__}": partial(check, driver) for driver in DRIVERS for check in _OF_EACH},
}


def main(target: Path, chosen: list[str]) -> None:
    """Run the contract suite and the checks, and write what came of them after each: a run that is cut short tells."""
    told: dict[str, object] = {}
    for driver in DRIVERS:
        name = f"contract of {driver}"
        if not chosen or any(part in name for part in chosen):
            bench = vivid_bench.bench(target.parent, driver)
            told[name] = run_checks(bench.open_rig, bench.sequence).document()
    for name, check in ALL.items():
        if not chosen or any(part in name for part in chosen):
            told[name] = outcome(check)
            target.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])

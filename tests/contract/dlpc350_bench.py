"""The light engine's driver before a camera on its trigger wire: a bench for the contract suite.

Here the engine is at the other end of a pair of sockets. In the guest it is a HID device of the kernel, and the driver
opens its hidraw node: `python -m tests.contract.dlpc350_bench FILE` runs the contract suite and the checks below on it,
and writes what came of each to FILE, as JSON; `tests/contract/test_dlpc350_guest.py` asserts on that.
"""

from __future__ import annotations

import fcntl
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers import dlpc350, dlpc900
from drivers.dlpc350.flash import Flash, read_flash, write_pictures
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.planes import MIRRORS
from drivers.dlpc350.projector import DLPC350, LightEngine
from drivers.pattern_engine.finding import engines
from drivers.pattern_engine.link import Link
from slrig.capture.evidence import Evidence
from slrig.capture.sequencer import capture
from slrig.conformance import run
from slrig.devices import Projector
from slrig.errors import DeviceBusyError, DeviceGoneError
from slrig.model import PatternSequence, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract import dlpc900_bench
from tests.contract.bench_head import BenchHead
from tests.contract.dlpc350_device import Cable, FakeEngine, UhidEngine
from tests.contract.guest.outcome import Notes, outcome
from tests.contract.stage import Stage
from tests.contract.suite import Bench, rig_of
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import Scene

PICTURES = "pictures"
LOAD_S = 0.03
"""What the fake engine takes for a picture."""
_MOST_LOAD_S = 0.15
"""What its rig file says at the most. The fake is a thread, which a busy machine keeps waiting for a while."""
PROVEN = {"led_current_inverted": True}
_EXPOSURES_S = (1e-4, 0.5)
_GAINS = (1.0, 8.0)


def sequence(*, rows: bool = False) -> PatternSequence:
    """White, black, Gray code with inverses, shifted lines, and white and black again."""
    patterns = scan_patterns(
        MIRRORS, line_shift=True, period_px=16, line_width_px=2, gray_cell_px=None, gray_offset_px=0, rows=rows
    )
    return encode(patterns, MIRRORS)


def scene() -> Scene:
    """A camera that sees most of the mirrors' columns, and of their rows a band."""
    return Scene(
        camera=Size(640, 100),
        projector=MIRRORS,
        columns_per_px=1.4,
        rows_per_px=10.0,
        blur_px=0.8,
        noise_dn=0.5,
        white=0.5,
    )


class Table:
    """A stage, and a fake engine that lights it, with the pictures of a sequence in its flash; used by one head."""

    def __init__(self, folder: Path, shown: PatternSequence, **engine: float | str | bool) -> None:
        self.folder = folder
        self.stage = Stage(scene())
        self.flash: Flash = write_pictures(folder / PICTURES, shown)
        self._camera: WiredCamera | None = None
        pictures = {picture.flash_index: picture.content for picture in self.flash.pictures}
        options = {"tag": self.flash.tag, "load_s": LOAD_S, **engine}
        self.engine = FakeEngine(pictures, light=self.stage.show, pulse=self._pulse, **options)  # type: ignore[arg-type]

    def options(self, **more: object) -> dict[str, object]:
        """The engine's table in a rig file."""
        return {"patterns": PICTURES, "image_load_s": _MOST_LOAD_S, "light_margin_s": 0.002, **PROVEN, **more}

    def head(self, projector: Projector) -> BenchHead:
        """The projector and a new camera."""
        self._camera = WiredCamera("left", self.stage, usual_s=1 / 60, exposures_s=_EXPOSURES_S, gains=_GAINS)
        return BenchHead({"left": self._camera}, projector)

    def connected(self, **more: object) -> BenchHead:
        """The driver at the other end of a new cable."""
        flash = read_flash(self.folder / PICTURES)
        link = Link(Cable(self.engine).host, "light engine", DLPC350)
        return self.head(
            LightEngine(link, EngineOptions.model_validate(self.options(**more)), flash, serial="LC4500-1")
        )

    def opened(self, **more: object) -> BenchHead:
        """The driver as a rig opens it, on whatever engine the kernel has."""
        return self.head(dlpc350.open_projector(self.options(**more), self.folder))

    def _pulse(self, t_ns: int) -> None:
        if self._camera is not None:
            self._camera.pulse(t_ns)


def bench(folder: Path) -> Bench:
    """The contract suite's bench."""
    shown = sequence()
    table = Table(folder, shown)
    return Bench(table.connected, shown)


def a_dlpc900_beside_it_is_told_from_it_and_scans(_: Table, notes: Notes) -> None:
    """Plug one in, find each driver's own engine, send patterns through the kernel, and capture them by wire."""
    beside = dlpc900_bench.Table()
    device = UhidEngine(beside.engine, product=0xC900, serial="LCR6500-1", port="usb-0000:00:14.0-3/input0")
    other = UhidEngine(FakeEngine({}), product=0xC900, serial="LCR6500-1", port="usb-0000:00:14.0-3/input1")
    until_s = time.monotonic() + 30.0
    while not dlpc900.find_devices() and time.monotonic() < until_s:
        threading.Event().wait(0.05)
    assert [each.device for each in dlpc900.find_devices()] == ["LCR6500-1"]
    assert [each.device for each in dlpc350.find_devices()] == ["LC4500-1"]
    shown = dlpc900_bench.sequence()
    rig = rig_of(beside.opened(device="LCR6500-1"))
    evidence = Evidence(shown.patterns, {name: camera.info.format for name, camera in rig.cameras.items()})
    begun = time.monotonic()
    with rig:
        shots = list(capture(rig, shown, evidence=evidence))
    notes |= {"patterns": len(shown), "s": round(time.monotonic() - begun, 2)}
    assert (len(shots), evidence.summary().shot_again) == (len(shown), 0), evidence.summary()
    assert beside.engine.lit is None
    device.unplug()
    other.unplug()


def both_axes_are_scanned_by_wire(table: Table, notes: Notes) -> None:
    """Capture two pictures' worth of patterns in one play, every frame proven."""
    shown = sequence(rows=True)
    rig = rig_of(table.opened())
    evidence = Evidence(shown.patterns, {name: camera.info.format for name, camera in rig.cameras.items()})
    begun = time.monotonic()
    with rig:
        shots = list(capture(rig, shown, evidence=evidence))
    notes |= {"patterns": len(shown), "pictures": len(table.flash.pictures), "s": round(time.monotonic() - begun, 2)}
    summary = evidence.summary()
    assert (len(shots), summary.shot_again) == (len(shown), 0), summary
    assert table.engine.lit is None


def it_is_found_by_its_serial_number(table: Table, notes: Notes) -> None:
    """Find it without opening it, and open it by the name found."""
    (device,) = dlpc350.find_devices()
    notes["label"] = device.label
    assert (device.driver, device.device) == ("dlpc350", "LC4500-1")
    table.opened(device=device.device).projector.close()


def an_engine_that_another_program_holds_is_busy(table: Table, notes: Notes) -> None:
    """Hold it as another program does, and as this driver does."""
    path = engines(DLPC350)[0].path
    other = os.open(path, os.O_RDWR)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DeviceBusyError, match="another program holds it") as busy:
            table.opened()
        notes["says"] = str(busy.value)
    finally:
        os.close(other)
    with rig_of(table.opened()), pytest.raises(DeviceBusyError):
        table.opened()


def showing_takes_what_it_says(table: Table, notes: Notes) -> None:
    """Time `show`, and see that light is there when it says."""
    head = table.opened()
    with rig_of(head):
        head.projector.load(sequence())
        took = []
        for index in range(10):
            begun = time.monotonic()
            shown = head.projector.show(index % 2)
            took.append(time.monotonic() - begun)
            assert shown.t_visible_ns + shown.t_err_ns <= time.monotonic_ns()
            lit = table.engine.lit
            assert lit is not None
            assert lit[0, 0] == (255 if index % 2 == 0 else 0)
        notes["median_show_ms"] = round(float(np.median(took)) * 1e3, 1)
        notes["declared_latency_ms"] = round(head.projector.info.latency_s * 1e3, 1)


def an_engine_that_is_unplugged_is_gone(table: Table, notes: Notes) -> None:
    """Unplug it while it shows: gone, closed without error, and found no more. It is the last check."""
    head = table.opened()
    head.projector.load(sequence())
    head.projector.show(0)
    device.unplug() if (device := _PLUGGED.pop(id(table), None)) is not None else None
    with pytest.raises(DeviceGoneError) as gone:
        head.projector.show(1)
    notes["says"] = str(gone.value)
    head.projector.close()
    head.projector.close()
    assert dlpc350.find_devices() == ()
    with pytest.raises(DeviceGoneError, match="plugged in: none"):
        table.opened()


_PLUGGED: dict[int, UhidEngine] = {}
CHECKS: tuple[Callable[[Table, Notes], None], ...] = (
    a_dlpc900_beside_it_is_told_from_it_and_scans,
    both_axes_are_scanned_by_wire,
    it_is_found_by_its_serial_number,
    an_engine_that_another_program_holds_is_busy,
    showing_takes_what_it_says,
    an_engine_that_is_unplugged_is_gone,
)


def _wait_until_found() -> None:
    """The kernel makes the node in its own time."""
    until, pause = time.monotonic() + 30.0, threading.Event()
    while not dlpc350.find_devices() and time.monotonic() < until:
        pause.wait(0.05)


def main(target: Path) -> None:
    """Run the contract suite and the checks on the kernel's node, and write what came of each."""
    table = Table(target.parent, sequence(rows=True))
    _PLUGGED[id(table)] = UhidEngine(table.engine)
    _wait_until_found()
    bench = Bench(table.opened, sequence())
    told: dict[str, object] = {"contract": run(bench.open_rig, bench.sequence).document()}
    target.write_text(json.dumps(told, indent=1))
    for check in CHECKS:
        told[check.__name__] = outcome(partial(check, table))
        target.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""The light engine's driver before a camera on its trigger wire: a bench for the contract suite.

`python -m tests.contract.dlpc350_bench FILE` runs it in the guest, on a HID device of the kernel, with more checks.
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
from typing import Any

import pytest

from drivers import dlpc350, dlpc900
from drivers.dlpc350.engine import Dlpc350EngineOptions
from drivers.dlpc350.flash import MIRRORS, read_flash_list, write_pictures
from drivers.dlpc350.projector import DLPC350, Dlpc350Projector
from drivers.pattern_engine.usb import UsbLink, find_engines
from slrig.capture.sequencer import capture
from slrig.capture.verifier import Evidence
from slrig.conformance import run_checks
from slrig.errors import DeviceBusyError, DeviceGoneError
from slrig.model import PatternSequence
from tests.contract import dlpc900_bench
from tests.contract.dlpc350_device import Cable, FakeEngine, UhidEngine
from tests.contract.guest.outcome import Notes, outcome
from tests.contract.suite import Bench, BenchHead, WiredTable, rig_of, whole_scan

PICTURES = "pictures"
LOAD_S = 0.03
"""What the fake engine takes for a picture."""
_MOST_LOAD_S = 0.15
"""What its rig file says at the most. The fake is a thread, which a busy machine keeps waiting for a while."""


class Table(WiredTable):
    """A stage, and a fake engine that lights it, with the pictures of a sequence in its flash."""

    def __init__(self, folder: Path, shown: PatternSequence, **engine: Any) -> None:
        super().__init__(MIRRORS, columns_per_px=1.4)
        self.folder = folder
        flash = write_pictures(folder / PICTURES, shown)
        pictures = {picture.flash_index: picture.content for picture in flash.pictures}
        options = {"tag": flash.tag, "load_s": LOAD_S, "light": self.stage.show, "pulse": self.pulse, **engine}
        self.engine = FakeEngine(pictures, **options)

    def options(self, **more: object) -> dict[str, object]:
        usual = {"patterns": PICTURES, "image_load_s": _MOST_LOAD_S, "light_margin_s": 0.002}
        return {**usual, "led_current_inverted": True, **more}

    def connected(self, **more: object) -> BenchHead:
        link = UsbLink(Cable(self.engine).host, "light engine", DLPC350)
        options = Dlpc350EngineOptions.model_validate(self.options(**more))
        return self.head(Dlpc350Projector(link, options, read_flash_list(self.folder / PICTURES), serial="LC4500-1"))

    def opened(self, **more: object) -> BenchHead:
        """The driver as a rig opens it, on whatever engine the kernel has."""
        return self.head(dlpc350.open_projector(self.options(**more), self.folder))


def bench(folder: Path) -> Bench:
    shown = whole_scan(MIRRORS)
    table = Table(folder, shown)
    return Bench(table.connected, shown)


def a_dlpc900_beside_it_is_told_from_it_and_scans(_: Table, notes: Notes) -> None:
    """Plug one in, find each driver's own engine, send patterns through the kernel, and capture them by wire."""
    beside = dlpc900_bench.Table()
    device = UhidEngine(beside.engine, product=0xC900, serial="LCR6500-1", port="usb-0000:00:14.0-3/input0")
    other = UhidEngine(FakeEngine({}), product=0xC900, serial="LCR6500-1", port="usb-0000:00:14.0-3/input1")
    _await_node(dlpc900.find_devices)
    assert [each.device for each in dlpc900.find_devices()] == ["LCR6500-1"]
    assert [each.device for each in dlpc350.find_devices()] == ["LC4500-1"]
    shown = whole_scan(dlpc900_bench.MIRRORS)
    rig = rig_of(beside.opened(device="LCR6500-1"))
    evidence = Evidence(shown.patterns, {name: camera.info.format for name, camera in rig.cameras.items()})
    with rig:
        shots = list(capture(rig, shown, evidence=evidence))
    notes |= {"patterns": len(shown)}
    assert (len(shots), evidence.summary().shot_again) == (len(shown), 0), evidence.summary()
    assert beside.engine.lit is None
    device.unplug()
    other.unplug()


def an_engine_that_another_program_holds_is_busy(table: Table, notes: Notes) -> None:
    """Hold it as another program does, and as this driver does."""
    path = find_engines(DLPC350)[0].path
    other = os.open(path, os.O_RDWR)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DeviceBusyError, match="another program holds the light engine") as busy:
            table.opened()
        notes["says"] = str(busy.value)
    finally:
        os.close(other)
    with rig_of(table.opened()), pytest.raises(DeviceBusyError):
        table.opened()


def an_engine_that_is_unplugged_is_gone(table: Table, notes: Notes) -> None:
    """Unplug it while it shows: gone, closed without error, and found no more. It is the last check."""
    head = table.opened()
    head.projector.load(whole_scan(MIRRORS))
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
    an_engine_that_another_program_holds_is_busy,
    an_engine_that_is_unplugged_is_gone,
)


def _await_node(find_devices: Callable[[], object]) -> None:
    """The kernel makes a node in its own time."""
    until, pause = time.monotonic() + 30.0, threading.Event()
    while not find_devices() and time.monotonic() < until:
        pause.wait(0.05)


def main(target: Path) -> None:
    # Two pictures' worth of patterns.
    table = Table(target.parent, whole_scan(MIRRORS, rows=True))
    _PLUGGED[id(table)] = UhidEngine(table.engine)
    _await_node(dlpc350.find_devices)
    bench = Bench(table.opened, whole_scan(MIRRORS, rows=True))
    # A whole scan, shot twice and judged, takes an emulated processor a minute and a half.
    told: dict[str, object] = {"contract": run_checks(bench.open_rig, bench.sequence, limit_s=180.0).document()}
    target.write_text(json.dumps(told, indent=1))
    for check in CHECKS:
        told[check.__name__] = outcome(partial(check, table))
        target.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

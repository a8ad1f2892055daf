"""The driver kms on a guest's graphics cards (virtio-gpu), against what QEMU scans out of them.

`python -m tests.contract.kms_bench FILE FOLDER [CHECK ...]` writes what came of each check to FILE, as JSON.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from drivers import kms
from drivers.kms import finding, holding
from drivers.kms.card import Card
from slrig.conformance import run_checks
from slrig.devices import Projector
from slrig.errors import DeviceBusyError, DeviceGoneError
from slrig.model import Size
from tests.contract.guest.outcome import Notes, outcome
from tests.contract.guest.scanout import HeadPixels, Monitor
from tests.contract.screen_bench import CAMERA, ScreenCamera, sequence
from tests.contract.suite import Bench, BenchHead
from tests.unit.capture.fake_rig import Scene

FIRST, FORCED, SECOND = "Virtual-1", "Virtual-2", "Virtual-3"
"""An output of each card that a display is connected to, and one of the first card that has none until it is forced."""
# The synchronising pulse of QEMU's EDID is 0.5 % of the rows: below 200 it has none, and the kernel refuses it.
HERE, ELSEWHERE = Size(96, 200), Size(128, 210)
DEVICES = (
    f"virtio-gpu-pci,id=first,max_outputs=2,xres={HERE.width_px},yres={HERE.height_px}",
    f"virtio-gpu-pci,id=second,xres={ELSEWHERE.width_px},yres={ELSEWHERE.height_px}",
)
WHITE, BLACK = 0, 1
FAR_S = 60.0


class Heads:
    """What the guest's displays get."""

    def __init__(self, monitor: Monitor) -> None:
        self.first, self.forced = HeadPixels(monitor, "first"), HeadPixels(monitor, "first", 1)
        self.second = HeadPixels(monitor, "second")


def options(output: str = FIRST, **more: object) -> dict[str, object]:
    """A `[projector]` table for a light that is there as soon as its pixels are."""
    exact = {"latency_s": 0.0, "latency_error_s": 0.0, "dark_after_s": 0.0}
    return {"output": output, **exact, **more}


@contextmanager
def opened(output: str = FIRST, **more: object) -> Iterator[Projector]:
    """The driver on an output, which is the console's again afterwards."""
    projector = kms.open_projector(options(output, **more), Path())
    try:
        yield projector
    finally:
        projector.close()
        holding.release_card(finding.find_connector(output).card)


def is_dark(head: HeadPixels) -> bool:
    return not head.colours().any()


def is_console(head: HeadPixels) -> bool:
    """Most of it white: its cursor is not."""
    return float(head.colours().mean()) > 128


def whiten() -> None:
    """Make the text consoles white, without a cursor."""
    Path("/dev/tty1").write_text("\033[?25l")
    for path in sorted(Path("/dev").glob("fb?")):
        with path.open("wb") as file:
            words = (Path("/sys/class/graphics") / path.name / "virtual_size").read_text().split(",")
            file.write(b"\xff" * (4 * int(words[0]) * int(words[1])))


def until(condition: Callable[[], bool], within_s: float = FAR_S) -> float:
    begun_s = time.monotonic()
    while not condition():
        assert time.monotonic() - begun_s < within_s
    return time.monotonic() - begun_s


def every_pattern_is_exact(heads: Heads, notes: Notes, output: str, *, legacy: bool = False) -> None:
    """Compare all pixels of all patterns with what is scanned out, and the other card's with what they were."""
    ours, theirs = (heads.first, heads.second) if output == FIRST else (heads.second, heads.first)
    before = theirs.colours()
    size = HERE if output == FIRST else ELSEWHERE
    older = mock.patch.object(Card, "_can", return_value=False) if legacy else nullcontext()
    with older, opened(output) as projector:
        assert projector.info.size == size
        shown = sequence(size)
        projector.load(shown)
        assert is_dark(ours)
        wrong = 0
        for index in range(len(shown)):
            projector.show(index)
            wrong += not np.array_equal(ours.grey(), shown.image(index))
        projector.blank()
        assert is_dark(ours)
    notes |= {"patterns": len(shown), "wrong": wrong}
    assert wrong == 0
    assert np.array_equal(theirs.colours(), before)
    until(lambda: is_console(ours))


def exact_on_the_first_card(heads: Heads, notes: Notes) -> None:
    every_pattern_is_exact(heads, notes, FIRST)


def exact_on_the_second_card(heads: Heads, notes: Notes) -> None:
    every_pattern_is_exact(heads, notes, SECOND)


def exact_without_atomic_commits(heads: Heads, notes: Notes) -> None:
    every_pattern_is_exact(heads, notes, FIRST, legacy=True)


def another_connector_of_the_same_card(heads: Heads, notes: Notes) -> None:
    """Force a display on, show there and not on its neighbour, and take it away: gone, and dark by itself."""
    status = finding.SYSTEM / f"card0-{FORCED}" / "status"
    status.write_text("on")
    try:
        before = heads.first.colours()
        with opened(FORCED, native_px=[640, 480]) as projector:
            shown = sequence(Size(640, 480))
            projector.load(shown)
            for index in (WHITE, BLACK, 5, len(shown) - 1):
                projector.show(index)
                assert np.array_equal(heads.forced.grey(), shown.image(index)), index
            assert np.array_equal(heads.first.colours(), before)
            status.write_text("off")
            with pytest.raises(DeviceGoneError, match="nothing is connected") as gone:
                projector.show(WHITE)
            notes["says"] = str(gone.value)
            projector.close()
    finally:
        status.write_text("detect")


def spawned(index: int, *, dark_after_s: float) -> int:
    told, tells = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            projector = kms.open_projector(options(dark_after_s=dark_after_s), Path())
            projector.load(sequence(HERE))
            projector.show(index)
            os.write(tells, b"shown")
            time.sleep(10 * FAR_S)
        finally:
            os._exit(1)
    os.close(tells)
    assert os.read(told, 5) == b"shown"
    os.close(told)
    return child


def killed(child: int) -> None:
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def dark_after_kill(heads: Heads, notes: Notes) -> None:
    """Kill the process while it shows white; then another one while it shows black, and see no light for 3 s."""
    child = spawned(WHITE, dark_after_s=2.0)
    assert int(heads.first.grey().min()) == 255
    killed(child)
    notes["dark after s"] = round(until(lambda: is_dark(heads.first)), 2)
    assert float(notes["dark after s"]) < 2.0
    until(lambda: is_console(heads.first))
    child = spawned(BLACK, dark_after_s=3.0)
    killed(child)
    begun_s, looks = time.monotonic(), 0
    while is_dark(heads.first):
        looks += 1
        assert time.monotonic() - begun_s < FAR_S
    notes |= {"dark for s": round(time.monotonic() - begun_s, 2), "looks": looks}
    assert float(notes["dark for s"]) > 2.5


def without_a_guard_the_console_is_lit(heads: Heads, _: Notes) -> None:
    """What the guard is for: killed as well, it leaves the card, and the kernel shows its console."""
    child = spawned(BLACK, dark_after_s=600.0)
    guards = [int(path.name) for path in Path("/proc").glob("[0-9]*") if b"drivers.kms.guard" in _command(path)]
    assert len(guards) == 1
    os.kill(guards[0], signal.SIGKILL)
    killed(child)
    until(lambda: is_console(heads.first))


def _command(process: Path) -> bytes:
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


def the_next_process_takes_over_in_the_dark(heads: Heads, notes: Notes) -> None:
    """A process is killed; the next one gets the card from its guard, and nothing lights up in between."""
    child = spawned(BLACK, dark_after_s=600.0)
    with pytest.raises(DeviceBusyError, match=f"process {child} shows patterns on output {FIRST}") as busy, opened():
        pass
    notes["busy"] = str(busy.value)
    killed(child)
    lit: list[float] = []
    done = threading.Event()

    def look() -> None:
        while not done.is_set():
            lit.append(float(heads.first.colours().max()))

    looking = threading.Thread(target=look)
    looking.start()
    try:
        projector = kms.open_projector(options(), Path())
    finally:
        done.set()
        looking.join(FAR_S)
    notes["looks"] = len(lit)
    assert len(lit) > 3
    assert max(lit) == 0
    projector.load(sequence(HERE))
    projector.show(WHITE)
    assert int(heads.first.grey().min()) == 255
    projector.close()
    assert is_dark(heads.first)
    holding.release_card(finding.find_connector(FIRST).card)
    # The first guard has left, too.
    until(lambda: is_console(heads.first))


def a_card_that_another_program_has_is_busy(_: Heads, notes: Notes) -> None:
    """As a display server has it."""
    other = os.open("/dev/dri/card0", os.O_RDWR)
    try:
        pipe, tells = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(tells)
            os.read(pipe, 1)
            os._exit(0)
        os.close(pipe)
    finally:
        os.close(other)
    with pytest.raises(DeviceBusyError, match=rf"held by \S+ \(process {child}\)") as busy, opened():
        pass
    notes["says"] = str(busy.value)
    os.close(tells)
    os.waitpid(child, 0)
    with opened():
        pass


class GuestCamera(ScreenCamera):
    """Looks twice during an exposure: a look takes QEMU longer than an exposure."""

    LOOKS = 2


CHECKS: tuple[Callable[[Heads, Notes], None], ...] = (
    exact_on_the_first_card,
    exact_on_the_second_card,
    exact_without_atomic_commits,
    another_connector_of_the_same_card,
    dark_after_kill,
    without_a_guard_the_console_is_lit,
    the_next_process_takes_over_in_the_dark,
    a_card_that_another_program_has_is_busy,
)


def main(target: Path, host_folder: str, chosen: list[str]) -> None:
    heads = Heads(Monitor(host_folder))
    told: dict[str, object] = {}
    for check in CHECKS:
        if chosen and check.__name__ not in chosen:
            continue
        whiten()
        until(lambda: is_console(heads.first))
        told[check.__name__] = outcome(partial(check, heads))
        target.write_text(json.dumps(told, indent=1))

    def open_head() -> BenchHead:
        projector = kms.open_projector(options(), Path())
        return BenchHead(
            {"eye": GuestCamera("eye", heads.first, Scene(camera=CAMERA, projector=HERE, noise_dn=1.0))}, projector
        )

    if not chosen or "contract" in chosen:
        bench = Bench(open_head, sequence(HERE))
        told["contract"] = run_checks(bench.open_rig, bench.sequence).document()
        target.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])

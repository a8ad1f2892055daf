"""Dark when the process is killed, its thread hangs or its guard is killed. The desktop is white."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.display.projector import DisplayProjector, ScanoutStart
from drivers.screen import guard as screen_guard
from drivers.screen import open_projector
from slrig.errors import DeviceStateError
from slrig.model import Size
from tests.contract.screen_bench import rig_options, sequence
from tests.contract.screen_server import DummyServer, OutputPixels
from tests.unit.drivers.screen.conftest import LEFT, OPEN, RIGHT, SIZE, started

FAR_S = 20.0
WHITE, BLACK = 0, 1

pytestmark = pytest.mark.realtime


def opened(**options: object) -> DisplayProjector:
    projector = open_projector(rig_options(RIGHT, SIZE, **options), Path())
    assert isinstance(projector, DisplayProjector)
    OPEN.append(projector)
    return projector


def lit(projector: DisplayProjector) -> DisplayProjector:
    projector.load(sequence(SIZE))
    projector.show(WHITE)
    return projector


def until(condition: Callable[[], bool], *, within_s: float = FAR_S) -> float:
    """How long it took until the condition held."""
    begun_s = time.monotonic()
    while not condition():
        assert time.monotonic() - begun_s < within_s
    return time.monotonic() - begun_s


def is_white(pixels: OutputPixels) -> bool:
    return int(pixels.grey().min()) == 255


def is_black(pixels: OutputPixels) -> bool:
    return not pixels.colours().any()


@pytest.mark.parametrize(
    ("backend", "number"),
    [("x11", signal.SIGKILL), ("x11", signal.SIGTERM), ("x11", signal.SIGINT), ("sdl", signal.SIGKILL)],
)
def test_the_output_is_black_when_the_process_is_killed(right: OutputPixels, backend: str, number: int) -> None:
    with started(backend, dark_after_s=1.5) as child:
        assert is_white(right)
        child.send_signal(number)
        child.wait(FAR_S)
        assert until(lambda: is_black(right), within_s=1.0) < 0.5
    with started(backend, dark_after_s=1.0, pattern=BLACK) as child:
        child.send_signal(number)
        # From now on no picture has light in it until the guard has done its time: the desktop was white all along.
        begun_s, pictures = time.monotonic(), 0
        while is_black(right):
            pictures += 1
            assert time.monotonic() - begun_s < FAR_S
        assert time.monotonic() - begun_s > 1.0
        assert pictures > 20
        child.wait(FAR_S)


def test_another_process_takes_the_output_over_from_the_guard_of_a_killed_one(right: OutputPixels) -> None:
    with started("x11", dark_after_s=600) as child:
        child.kill()
        child.wait(FAR_S)
        until(lambda: is_black(right))
        projector = lit(opened())
        assert is_white(right)
        projector.blank()
        assert is_black(right)
        projector.close()
    screen_guard.release_guard(None, RIGHT)
    # The first guard has left, too: nothing else would show the desktop now.
    assert until(lambda: is_white(right)) < FAR_S


def test_blank_from_another_thread_interrupts_a_show(right: OutputPixels, monkeypatch: pytest.MonkeyPatch) -> None:
    projector = opened()
    projector.load(sequence(SIZE))
    darkening = threading.Thread(target=projector.blank)
    present = projector._output.show

    def darkened_meanwhile(index: int | None) -> ScanoutStart:
        presented = present(index)
        if index == WHITE:
            # The picture is there, and `show` has yet to return.
            assert is_white(right)
            darkening.start()
            assert projector._blanked.wait(FAR_S)
        return presented

    monkeypatch.setattr(projector._output, "show", darkened_meanwhile)
    with pytest.raises(DeviceStateError, match="blanked from outside"):
        projector.show(WHITE)
    darkening.join(FAR_S)
    assert is_black(right)


def test_the_guard_covers_a_window_whose_thread_hangs(right: OutputPixels) -> None:
    projector = lit(opened())
    hang = threading.Event()
    stuck = threading.Thread(target=lambda: projector._thread.run(hang.wait, timeout_s=FAR_S))
    stuck.start()
    outside = threading.Thread(target=projector.blank)
    outside.start()
    outside.join(FAR_S)
    assert not hang.is_set()
    assert is_black(right)
    hang.set()
    stuck.join(FAR_S)
    # It answers again: patterns are above the guard again.
    projector.show(WHITE)
    assert is_white(right)
    projector.close()
    assert is_black(right)


def test_a_guard_that_is_killed_is_replaced_when_the_rig_is_opened_again(right: OutputPixels) -> None:
    opened().close()
    _, guard = screen_guard._guards[(None, RIGHT)]
    os.kill(guard._process.pid, signal.SIGKILL)
    until(lambda: is_white(right))
    assert not guard.cover()
    projector = lit(opened())
    projector.close()
    assert is_black(right)
    assert screen_guard._guards[(None, RIGHT)][1] is not guard


def test_the_guard_goes_where_its_output_goes_and_ends_with_it(server: DummyServer, right: OutputPixels) -> None:
    opened(dark_after_s=600).close()
    assert is_black(right)
    small = Size(100, 80)
    places = server.arrange(**{LEFT: small, RIGHT: small})
    moved = OutputPixels(server.display, places[RIGHT], small)
    until(lambda: is_black(moved))
    left = OutputPixels(server.display, places[LEFT], small)
    until(lambda: is_white(left))
    moved.close()
    left.close()
    _, guard = screen_guard._guards[(None, RIGHT)]
    assert guard.is_alive
    server.run("xrandr", "--output", RIGHT, "--off")
    until(lambda: not guard.is_alive)

"""Ways out: the projector goes dark, devices are let go, twice if need be, and nothing works after that but opening."""

from __future__ import annotations

from collections.abc import Callable

from slrig.conformance.bench import SHORT_S, RigBench, View
from slrig.conformance.check import Check, Need, check
from slrig.conformance.expectation import ExpectationError as Broken
from slrig.conformance.expectation import Failure, at, expect, refused
from slrig.conformance.light import DARK
from slrig.devices import Camera, Projector, Rig, Trigger
from slrig.errors import DeviceStateError

_SEEN = (Need.STEPPED, Need.WHITE_AND_BLACK)


@check(
    asks=("Projector.blank", "Projector.stop", "Projector.load", "Projector.show"),
    needs=_SEEN,
)
def the_projector_is_dark_unless_it_shows(bench: RigBench) -> None:
    """The projector is dark unless it shows: after blank, stop and load."""
    name, trigger = next(bench.ways())
    with bench.view(name, trigger) as view:
        view.learn()
        dark: dict[str, Callable[[], None]] = {
            "blank": view.projector.blank,
            "stop": view.projector.stop,
            "load": lambda: view.projector.load(bench.sequence),
        }
        for call, darken in dark.items():
            view.expect_level(
                view.expose(0), 0, asked="a shown white pattern is seen white", do="light the pattern that is shown"
            )
            darken()
            _expect_dark(view, f"after {call}")


@check(
    asks=("Projector.close",),
    needs=_SEEN,
    fresh=True,
)
def the_projector_is_dark_after_opening_and_close(bench: RigBench) -> None:
    """The projector is dark when it was opened, and when it is closed."""
    name, trigger = next(bench.ways())
    with bench.view(name, trigger) as view:
        view.learn()
    # Left shining: whatever closes a rig after an error closes it so.
    bench.rig.projector.show(0)
    bench.close()
    with bench.view(name, trigger, load=False) as view:
        _expect_dark(view, "after opening")
        view.projector.load(bench.sequence)
        view.show(0)
        view.projector.close()
        _expect_dark(view, "after close")


@check(
    asks=("Camera.disarm", "Camera.close", "Projector.stop", "Projector.blank", "Projector.close"),
    fresh=True,
)
def close_may_be_called_twice(bench: RigBench) -> None:
    """The way out may be taken twice."""
    rig = _in_use(bench)
    for _ in range(2):
        for what, leave in _leaving(rig, closing=False):
            _without_error(what, leave)
    for _ in range(2):
        for what, leave in _leaving(rig, closing=True):
            _without_error(what, leave)
    for what, leave in _leaving(rig, closing=False):
        _without_error(f"{what} after close", leave)


@check(
    asks=("Camera.close", "Projector.close"),
    fresh=True,
)
def nothing_works_after_close(bench: RigBench) -> None:
    """Nothing works after close."""
    rig = _in_use(bench)
    for what, leave in _leaving(rig, closing=True):
        _without_error(what, leave)
    for name, camera in rig.cameras.items():
        with at(f"camera '{name}'"):
            for what, call in _uses(camera, bench, name):
                with refused(DeviceStateError, asked=f"{what} after close", do="refuse every use of a closed device"):
                    call()
    projector = rig.projector
    calls: dict[str, Callable[[], object]] = {
        "load": lambda: projector.load(bench.opening),
        "show": lambda: projector.show(0),
        "play": lambda: projector.play(0.01, 0.02),
    }
    with at("projector"):
        for what, call in calls.items():
            with refused(DeviceStateError, asked=f"{what} after close", do="refuse every use of a closed device"):
                call()


@check(
    asks=("Camera.close", "Projector.close"),
    fresh=True,
)
def a_closed_rig_opens_again(bench: RigBench) -> None:
    """A rig that was closed can be opened again at once, and gives frames."""
    for _ in range(2):
        _in_use(bench)
        bench.close()
        with at("rig"):
            try:
                rig = bench.rig
            except Exception as error:
                failure = Failure(
                    "a rig opens again after it was closed",
                    f"{type(error).__name__}: {error}",
                    "close lets the device go entirely: handles, threads, locks",
                )
                raise Broken(failure) from error
            expect(rig.cameras, asked="the rig has its cameras again", found="none", do="open every device afresh")
    for name, trigger in bench.ways():
        with bench.view(name, trigger) as view:
            view.expose(0)


def _expect_dark(view: View, when: str) -> None:
    level = view.darkest()
    expect(
        level <= DARK,
        asked=f"{when}, the projector is dark",
        found=f"{level:.0%} of white's light",
        do="go dark before the call returns; a device that cannot shows a black picture",
    )


def _in_use(bench: RigBench) -> Rig:
    """The rig with every camera armed, a frame under way where one can be, and the projector shining."""
    rig = bench.rig
    rig.projector.load(bench.sequence)
    best = dict(bench.ways())
    for name, camera in rig.cameras.items():
        camera.configure(bench.settings(name))
        camera.arm(2, best.get(name, Trigger.HARDWARE))
    rig.projector.show(0)
    for name, trigger in best.items():
        if trigger is Trigger.SOFTWARE:
            rig.cameras[name].trigger()
    return rig


def _leaving(rig: Rig, *, closing: bool) -> list[tuple[str, Callable[[], None]]]:
    projector: Projector = rig.projector
    cameras = rig.cameras.items()
    if closing:
        return [("projector: close", projector.close), *((f"camera '{n}': close", c.close) for n, c in cameras)]
    return [
        *((f"camera '{name}': disarm", camera.disarm) for name, camera in cameras),
        ("projector: stop", projector.stop),
        ("projector: blank", projector.blank),
    ]


def _without_error(what: str, leave: Callable[[], None]) -> None:
    try:
        leave()
    except Exception as error:
        failure = Failure(
            f"{what} works in every state and any number of times",
            f"{type(error).__name__}: {error}",
            "return at once when there is nothing left to do",
        )
        raise Broken(failure) from error


def _uses(camera: Camera, bench: RigBench, name: str) -> list[tuple[str, Callable[[], object]]]:
    settings = bench.settings(name)
    return [
        ("configure", lambda: camera.configure(settings)),
        ("arm", lambda: camera.arm(1, min(camera.info.triggers))),
        ("trigger", camera.trigger),
        ("read", lambda: camera.read(0, SHORT_S)),
    ]


CHECKS: tuple[Check, ...] = (
    the_projector_is_dark_unless_it_shows,
    the_projector_is_dark_after_opening_and_close,
    close_may_be_called_twice,
    nothing_works_after_close,
    a_closed_rig_opens_again,
)

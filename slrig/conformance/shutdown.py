"""Ways out: the projector goes dark, devices are let go, twice if need be, and nothing works after that but opening."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from slrig.conformance.bench import SHORT_S, Need, RigBench, at, check, expect, refused, works
from slrig.devices import Camera, CameraSettings, Rig, Trigger
from slrig.errors import DeviceStateError


@check(Need.STEPPED, Need.WHITE_AND_BLACK)
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
            view.expect_dark(f"after {call}")


@check(Need.STEPPED, Need.WHITE_AND_BLACK, fresh=True)
def the_projector_is_dark_after_opening_and_close(bench: RigBench) -> None:
    """The projector is dark when it was opened, and when it is closed."""
    name, trigger = next(bench.ways())
    with bench.view(name, trigger) as view:
        view.learn()
    # Left shining: whatever closes a rig after an error closes it so.
    bench.rig.projector.show(0)
    bench.close()
    with bench.view(name, trigger, load=False) as view:
        view.expect_dark("after opening")
        view.projector.load(bench.sequence)
        view.show(0)
        view.projector.close()
        view.expect_dark("after close")


@check(fresh=True)
def close_may_be_called_twice(bench: RigBench) -> None:
    """The way out may be taken twice."""
    rig = _in_use(bench)
    for ways_out in (_resting(rig), _resting(rig), _closing(rig), _closing(rig)):
        _expect_to_work(ways_out)
    _expect_to_work(_resting(rig), " after close")


@check(fresh=True)
def nothing_works_after_close(bench: RigBench) -> None:
    """Nothing works after close."""
    rig = _in_use(bench)
    _expect_to_work(_closing(rig))
    uses = {f"camera '{name}'": _uses(camera, bench.settings(name)) for name, camera in rig.cameras.items()}
    uses["projector"] = {
        "load": lambda: rig.projector.load(bench.opening),
        "show": lambda: rig.projector.show(0),
        "play": lambda: rig.projector.play(0.01, 0.02),
    }
    for device, calls in uses.items():
        with at(device):
            for what, call in calls.items():
                with refused(DeviceStateError, asked=f"{what} after close", do="refuse every use of a closed device"):
                    call()


@check(fresh=True)
def a_closed_rig_opens_again(bench: RigBench) -> None:
    """A rig that was closed can be opened again at once, and gives frames."""
    for _ in range(2):
        _in_use(bench)
        bench.close()
        with at("rig"):
            rig = bench.opened_again()
            expect(rig.cameras, asked="the rig has its cameras again", found="none", do="open every device afresh")
    for name, trigger in bench.ways():
        with bench.view(name, trigger) as view:
            view.expose(0)


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


def _resting(rig: Rig) -> dict[str, Callable[[], None]]:
    resting = {f"camera '{name}': disarm": camera.disarm for name, camera in rig.cameras.items()}
    return resting | {"projector: stop": rig.projector.stop, "projector: blank": rig.projector.blank}


def _closing(rig: Rig) -> dict[str, Callable[[], None]]:
    closing = {"projector: close": rig.projector.close}
    return closing | {f"camera '{name}': close": camera.close for name, camera in rig.cameras.items()}


def _expect_to_work(ways_out: Mapping[str, Callable[[], None]], when: str = "") -> None:
    do = "return at once when there is nothing left to do"
    for what, leave in ways_out.items():
        with works(asked=f"{what}{when} works in every state and any number of times", do=do):
            leave()


def _uses(camera: Camera, settings: CameraSettings) -> dict[str, Callable[[], object]]:
    return {
        "configure": lambda: camera.configure(settings),
        "arm": lambda: camera.arm(1, min(camera.info.triggers)),
        "trigger": camera.trigger,
        "read": lambda: camera.read(0, SHORT_S),
    }

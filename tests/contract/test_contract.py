"""The contract suite over every driver, and over itself: no method of a protocol may go unasked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import pytest

from drivers import replay
from drivers.replay import ReplayCamera, ReplayProjector
from slrig.devices import Camera, Head, Projector
from slrig.model import Frame
from tests.contract.benches import BENCHES
from tests.contract.suite import CHECKS, Bench


@pytest.fixture(scope="session", params=BENCHES)
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return BENCHES[request.param](tmp_path_factory.mktemp("bench"))


@pytest.mark.parametrize("check", CHECKS.values(), ids=CHECKS.keys())
def test_contract(bench: Bench, check: Callable[[Bench], None]) -> None:
    check(bench)


def members(protocol: type) -> set[str]:
    return {f"{protocol.__name__}.{name}" for name in vars(protocol) if not name.startswith("_")}


def recording(target: object, protocol: type, asked: set[str]) -> Any:
    """Stand in for `target`, noting which members of the protocol are asked for."""

    def property_of(name: str) -> property:
        def get(_: object) -> object:
            asked.add(f"{protocol.__name__}.{name}")
            return getattr(target, name)

        return property(get)

    names = [name for name in vars(protocol) if not name.startswith("_")]
    return type("Recording", (), {name: property_of(name) for name in names})()


class RecordingHead:
    """A head whose every use is noted."""

    def __init__(self, head: Head, asked: set[str]) -> None:
        self._noted = cast("Head", recording(head, Head, asked))
        self._asked = asked

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return {name: recording(camera, Camera, self._asked) for name, camera in self._noted.cameras.items()}

    @property
    def projector(self) -> Projector:
        return cast("Projector", recording(self._noted.projector, Projector, self._asked))

    @property
    def calibration(self) -> Any:
        return self._noted.calibration

    def truth(self) -> Any:
        return self._noted.truth()


def test_the_suite_asks_for_every_member_of_every_protocol(tmp_path_factory: pytest.TempPathFactory) -> None:
    plain = BENCHES["replay"](tmp_path_factory.mktemp("bench"))
    asked: set[str] = set()
    noted = Bench(lambda: RecordingHead(plain.open_head(), asked), plain.sequence)
    for check in CHECKS.values():
        check(noted)
    assert asked == members(Camera) | members(Projector) | members(Head)


class ReturnsStaleFrames(ReplayCamera):
    """Ignores how early a frame may begin."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        return super().read(min(after_ns, 0), timeout_s)


class TriggersUnarmed(ReplayCamera):
    """Ignores a trigger in the wrong state."""

    def trigger(self) -> None:
        if self._armed:
            super().trigger()


class StaysLit(ReplayProjector):
    """Does not go dark."""

    def blank(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (ReturnsStaleFrames, "read_passes_over_stale_frames"),
        (TriggersUnarmed, "trigger_and_read_need_an_armed_camera"),
        (StaysLit, "the_projector_is_dark_unless_it_shows"),
        (StaysLit, "every_end_of_a_capture_is_dark_and_leaves_the_rig_usable"),
    ],
)
def test_the_suite_finds_a_driver_that_breaks_the_contract(
    broken: type, check: str, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = BENCHES["replay"](tmp_path_factory.mktemp("bench"))
    monkeypatch.setattr(replay, broken.__mro__[1].__name__, broken)
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        CHECKS[check](bench)

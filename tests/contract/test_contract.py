"""The contract suite over every driver, and over itself: it uses every member of the protocols."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from slrig.conformance import CHECKS, Check, CheckOutcome, ConformanceRun
from slrig.devices import Camera, HasClock, Projector, ScannerHead
from tests.contract.benches import BENCHES
from tests.contract.picamera2_bench import picamera2
from tests.contract.suite import Bench

VIRTUAL = ("simulated", "replay", "v4l2 (fake kernel)", "picamera2 (a stand-in for the library)", "picamera2 by wire")
"""Benches on virtual time. The others take as long as their devices would, ten seconds and more; where a busy machine
keeps the thread of their light waiting, a frame shows two patterns.
"""


@pytest.fixture(
    scope="session",
    params=[pytest.param(name, marks=() if name in VIRTUAL else pytest.mark.realtime) for name in BENCHES],
)
def examination(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConformanceRun]:
    bench = BENCHES[request.param](tmp_path_factory.mktemp("bench"))
    with bench.examination() as examination:
        yield examination
    bench.end()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract(examination: ConformanceRun, check: Check) -> None:
    result = examination.run_check(check)
    if result.outcome is CheckOutcome.NOT_APPLICABLE:
        pytest.skip(result.reason or "")
    assert result.outcome is CheckOutcome.PASSED, str(result.failure)


def members(protocol: type) -> list[str]:
    return [name for name in vars(protocol) if not name.startswith("_")]


def recording(target: object, protocol: type, asked: set[str], **instead: Callable[[Any], object]) -> Any:
    """Stand in for `target`, and note which members of the protocol are used. instead : what is given of some."""

    def property_of(name: str) -> property:
        def get(_: object) -> object:
            asked.add(f"{protocol.__name__}.{name}")
            found = getattr(target, name)
            return instead[name](found) if name in instead else found

        return property(get)

    kept = {"clock": target.clock} if isinstance(target, HasClock) else {}
    return type("Recording", (), {**kept, **{name: property_of(name) for name in members(protocol)}})()


def test_the_suite_uses_every_member_of_the_protocols(tmp_path: Path) -> None:
    plain = picamera2(tmp_path)
    asked: set[str] = set()

    def open_head() -> ScannerHead:
        def noted(cameras: Mapping[str, Camera]) -> Mapping[str, Camera]:
            return {name: recording(camera, Camera, asked) for name, camera in cameras.items()}

        head = recording(
            plain.open_head(),
            ScannerHead,
            asked,
            cameras=noted,
            projector=lambda found: recording(found, Projector, asked),
        )
        return cast("ScannerHead", head)

    with Bench(open_head, plain.sequence).examination() as examination:
        for check in CHECKS:
            assert examination.run_check(check).outcome in {CheckOutcome.PASSED, CheckOutcome.NOT_APPLICABLE}, (
                check.name
            )
    protocols = (Camera, Projector, ScannerHead)
    assert asked == {f"{protocol.__name__}.{name}" for protocol in protocols for name in members(protocol)}

"""The contract suite over every driver, and over itself: it uses every member of the protocols."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from slrig.conformance import CHECKS, Check, Examination, Outcome
from slrig.devices import Camera, Head, KeepsTime, Projector
from tests.contract import picamera2_bench
from tests.contract.benches import BENCHES
from tests.contract.suite import Bench

QUICK = ("simulated", "replay", "v4l2 (fake kernel)", "picamera2 (a stand-in for the library)")
"""Benches on virtual time. The others take as long as their devices would, ten seconds and more."""


@pytest.fixture(
    scope="session", params=[pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in BENCHES]
)
def examination(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Examination]:
    bench = BENCHES[request.param](tmp_path_factory.mktemp("bench"))
    with bench.examination() as examination:
        yield examination
    bench.end()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract(examination: Examination, check: Check) -> None:
    result = examination.judge(check)
    if result.outcome is Outcome.NOT_APPLICABLE:
        pytest.skip(result.reason or "")
    assert result.outcome is Outcome.PASSED, str(result.failure)


def recording(target: object, protocol: type, asked: set[str]) -> Any:
    """Stand in for `target`, noting which members of the protocol are used."""

    def property_of(name: str) -> property:
        def get(_: object) -> object:
            asked.add(f"{protocol.__name__}.{name}")
            return getattr(target, name)

        return property(get)

    return type("Recording", (), {name: property_of(name) for name in members(protocol)})()


def members(protocol: type) -> list[str]:
    return [name for name in vars(protocol) if not name.startswith("_")]


class RecordingHead:
    """A head whose every use is noted."""

    def __init__(self, head: Head, asked: set[str]) -> None:
        assert isinstance(head, KeepsTime)
        self.clock = head.clock
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


def test_the_suite_uses_every_member_of_the_protocols(tmp_path: Path) -> None:
    plain = picamera2_bench.bench(tmp_path)
    asked: set[str] = set()
    with Bench(lambda: RecordingHead(plain.open_head(), asked), plain.sequence).examination() as examination:
        for check in CHECKS:
            assert examination.judge(check).outcome in {Outcome.PASSED, Outcome.NOT_APPLICABLE}, check.name
    assert asked == {
        f"{protocol.__name__}.{name}" for protocol in (Camera, Projector, Head) for name in members(protocol)
    }

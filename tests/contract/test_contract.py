"""The contract suite over every driver, and over itself: no method of a protocol may go unasked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

import pytest

from slrig.conformance import CHECKS, Check, Examination, Outcome
from slrig.devices import Camera, Head, Projector
from tests.contract.benches import BENCHES
from tests.contract.suite import Bench

QUICK = ("simulated", "replay")
"""Benches on virtual time. The others take as long as their devices would, ten seconds and more."""


@pytest.fixture(
    scope="session", params=[pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in BENCHES]
)
def examination(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Examination]:
    with BENCHES[request.param](tmp_path_factory.mktemp("bench")).examination() as examination:
        yield examination


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract(examination: Examination, check: Check) -> None:
    result = examination.judge(check)
    if result.outcome is Outcome.NOT_APPLICABLE:
        pytest.skip(result.reason or "")
    assert result.outcome is Outcome.PASSED, str(result.failure)


def members(protocol: type) -> set[str]:
    return {f"{protocol.__name__}.{name}" for name in vars(protocol) if not name.startswith("_")}


def recording(target: object, protocol: type, asked: set[str]) -> Any:
    """RigBench in for `target`, noting which members of the protocol are asked for."""

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
    with noted.examination() as examination:
        for check in CHECKS:
            asked.clear()
            outcome = examination.judge(check).outcome
            assert outcome in {Outcome.PASSED, Outcome.NOT_APPLICABLE}, check.name
            if outcome is Outcome.PASSED:
                # A check asks for what it says it asks for.
                assert asked >= set(check.asks), check.name
    assert {member for check in CHECKS for member in check.asks} == members(Camera) | members(Projector) | members(Head)

"""Scans with the light engine: what the list of its flash says wrongly is found out by the frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from slrig.capture.evidence import Evidence
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Rig
from slrig.errors import ScanEvidenceError
from tests.contract.bench_head import BenchHead
from tests.contract.dlpc350_bench import Table, sequence
from tests.contract.dlpc350_device import FakeEngine
from tests.contract.suite import rig_of

FAST = CameraSettings(0.005)


def rig(head: BenchHead) -> Rig:
    return replace(rig_of(head), settings=dict.fromkeys(head.cameras, FAST))


def test_a_scan_by_wire_is_proven(tmp_path: Path) -> None:
    shown = sequence()
    table = Table(tmp_path, shown)
    with rig(table.connected()) as opened:
        evidence = Evidence(shown.patterns, {"left": opened.cameras["left"].info.format})
        shots = list(capture(opened, shown, evidence=evidence))
        assert len(shots) == len(shown)
        assert (evidence.summary().verified, evidence.summary().shot_again) == (len(shown), 0)
        assert table.engine.lit is None
    # One start for all patterns: the engine played them.
    assert [data for command, data in table.engine.commands if command == 0x1A24].count(b"\2") == 1


def misplace(engine: FakeEngine) -> None:
    """Exchange two bits of the Gray code, as pictures are that were put together in another order."""
    planes = list(engine._planes[0])
    planes[3], planes[5] = planes[5], planes[3]
    engine._planes[0] = tuple(planes)


def darken(engine: FakeEngine) -> None:
    """Hold nothing but black, as a flash that was never written."""
    engine._planes[0] = (engine._planes[0][0] * 0,) * 24


def turn_around(engine: FakeEngine) -> None:
    """Hold every plane inverted."""
    engine._planes[0] = tuple(255 - plane for plane in engine._planes[0])


@pytest.mark.parametrize(
    "spoil", [misplace, *(pytest.param(each, marks=pytest.mark.slow) for each in (darken, turn_around))]
)
def test_a_flash_that_holds_something_else_ends_the_scan_in_the_dark(
    tmp_path: Path, spoil: Callable[[FakeEngine], None]
) -> None:
    table = Table(tmp_path, sequence())
    spoil(table.engine)
    with rig(table.connected()) as opened:
        with pytest.raises(ScanEvidenceError):
            list(capture(opened, sequence()))
        assert table.engine.lit is None

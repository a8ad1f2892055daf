"""A solve that takes its process with it, or all memory: it fails with its cause, and nothing else is harmed."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.calibrate.records import SessionState
from slrig.jobs.records import JobState
from tests.unit.calibrate.calibration_bench import CalibrationBench
from tests.unit.scan.bench import PIPELINE


@pytest.mark.parametrize(
    ("how", "kind", "words"),
    [
        ("crash", "worker-lost", "ended in the middle of the solve (signal SIGSEGV)"),
        ("exhaust", "out-of-memory", "Unable to allocate 64.0 GiB"),
    ],
)
def test_a_solve_that_is_lost_costs_the_solve_only(tmp_path: Path, how: str, kind: str, words: str) -> None:
    bench = CalibrationBench(tmp_path, solve=f"{PIPELINE}:{how}")
    bench.runner.start()
    session_id = bench.session()
    bench.shot(session_id)
    bench.calibrations.solves.solve(session_id)
    waiting = bench.scan(wait=True)
    lost = bench.until_session(session_id, lambda found: found.state is not SessionState.SOLVING)
    assert (lost.state, lost.solve) == (SessionState.FAILED, 0)
    assert lost.fault is not None
    assert lost.fault.code == kind
    assert words in lost.fault.message
    assert bench.until(waiting.id).state is JobState.SUCCEEDED
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 1, "the rig stayed open"
    bench.close()

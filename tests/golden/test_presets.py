"""Presets on the objects that they are for, and what the exposure assistant proposes, against a small sweep.

The whole sweep, with what each scan costs, is printed by `python -m tests.bench.preset_sweep`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from tests.bench.preset_sweep import best_within, by_assistant, by_preset, object_rig, swept

# For each object: exposures from too short to too long, and a bracket that does it.
SWEEPS = {
    "dark": ((1 / 2,), (2,), (1, 8)),
    "shiny": ((1 / 4,), (2,), (1 / 4, 2)),
    "mixed": ((1,), (1 / 4, 4), (1 / 16, 1 / 2, 4)),
}
WITHIN = 0.1
"""Of the completeness of the best scan of the sweep that took no longer."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", SWEEPS)
def test_preset_and_assistant_are_as_complete_as_the_best_of_a_sweep_in_their_time(kind: str, tmp_path: Path) -> None:
    with open_rig(read_rig(object_rig(tmp_path, kind))) as rig:
        rows = list(swept(rig, SWEEPS[kind]))
        preset, (assisted, found), (short, _) = by_preset(rig, kind), by_assistant(rig), by_assistant(rig, 1.2)
    best = max(row.complete for row in rows)
    # The object is one that not every exposure can do.
    assert min(row.complete for row in rows) < best - 0.02
    for row in (preset, assisted, short):
        assert row.complete >= (1 - WITHIN) * best_within(rows, row.seconds + 1e-6), row
    for row in (preset, assisted):
        assert row.complete >= best - 0.01
    assert preset.rms_um <= 1.1 * min(row.rms_um for row in rows if row.complete > best - 0.01)
    # It said what it would take, and how much it would see.
    assert found.seconds == pytest.approx(assisted.seconds, rel=0.15)
    assert found.completeness == pytest.approx(assisted.complete / best, abs=0.03)
    assert short.seconds <= 1.2 * 1.15

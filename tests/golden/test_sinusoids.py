"""A rendered ball by sinusoids, captured and reconstructed, against its own truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Axis, Black, Gray, Pattern, Sine, White
from slrig.patterns import encode
from slrig.scan import acquisition
from slrig.scan.plan import ScanPlan
from tests.golden.test_bundles import reconstructed
from tests.prepared_bundles import BUNDLES

pytestmark = pytest.mark.slow

COLUMNS = 256
CODE = tuple(Gray(Axis.COLUMN, bit, 5, 8, 0, inverted) for bit in range(5) for inverted in (False, True))


def steps(period_px: float, count: int) -> tuple[Sine, ...]:
    return tuple(Sine(Axis.COLUMN, period_px, shift, count) for shift in range(count))


@pytest.mark.parametrize(
    ("patterns", "method", "rms_mm"),
    [
        ((White(), Black(), *CODE, *steps(16.0, 4)), "Gray code and phase shift", 0.03),
        (tuple(each for count in (16, 18, 20.25) for each in steps(COLUMNS / count, 4)), "phase shift", 0.02),
        ((*steps(32.0, 3), *steps(256.0, 3)), "phase shift", 0.06),
        ((*steps(18.62, 3), *(Sine(Axis.COLUMN, period, 0, 1) for period in (19.7, 20.9, 22.2))), "phase shift", 0.04),
    ],
    ids=["4 steps and Gray", "three periods", "2x3", "micro"],
)
def test_sinusoids_measure_a_rendered_ball(
    patterns: tuple[Pattern, ...], method: str, rms_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig_file = BUNDLES["ball with its truth"].rig_file(tmp_path)
    monkeypatch.setattr(acquisition, "rig_sequence", lambda _plan, rig: encode(patterns, rig.projector.info.size))
    with open_rig(read_rig(rig_file)) as rig:
        acquisition.capture_frames(rig, ScanPlan(), tmp_path / "bundle").finish()
    report = reconstructed(tmp_path / "bundle", tmp_path / "mesh")
    assert report["method"] == method
    assert any("to the power of 1." in str(note) for note in report["notes"])
    truth = report["truth"]
    assert truth["rms_mm"] <= rms_mm
    assert truth["gross_fraction"] <= 0.0005
    assert truth["complete_0.1mm"] >= 0.9
    assert 0.7 <= truth["error_over_sigma_p68"] <= 1.25

"""Scans in light and by cameras as benches have them, against the same scan by an ideal one.

A webcam whose values are made for displays; a bright room; exposure that creeps; highlights that clip; lamps on mains
before a rolling shutter; lenses that are sharp at one distance.
`pytest tests/golden/test_real_light.py -s -m slow` prints the table.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from slrig.errors import ScanEvidenceError
from slrig.scan.plan import PatternPlan
from tests.golden.test_light_axis import BALL, LEFT, PROJECTOR, rig_file, scanned

STAND = {**PROJECTOR, "position_mm": (105.0, 0.0, -590.0)}
LINES, GRAY_ONLY = PatternPlan(), PatternPlan(line_shift=False, gray_cell_px=2)
PLANS = {"lines": LINES, "Gray only": GRAY_ONLY}


@dataclass(frozen=True)
class Light:
    """What differs from the ideal. rms, complete : how much worse than there a scan may be: times, and share lost;
    sigma : the error over what is stated for it, at most.
    """

    camera: Mapping[str, Any] = field(default_factory=dict)
    projector: Mapping[str, Any] = field(default_factory=dict)
    head: str = "ambient = 0.01"
    rms: float = 1.2
    complete: float = 0.01
    sigma: float = 1.3


# Measured with lines, ideal 9.6 µm: 9.1, 12.8, 9.6 and 19.4. The webcam's values are made straight first; its deviation
# is a little larger, so that it smooths more.
LIGHTS = {
    "webcam": Light({"response": 0.45}, rms=1.05),
    "bright room": Light(head="ambient = 0.3", rms=1.4),
    "creeping exposure": Light({"exposure_drift": 0.0015}, rms=1.1),
    "rolling bands": Light({"line_time_s": 3e-5}, head="ambient = 0.1\nambient_flicker_depth = 0.3", rms=2.3),
    # Sharp at the ball; on the wall behind it the projector's spread is 1.5 px more, and the camera's 1.0 px. The rms,
    # 40.2 and 57.3 µm, is that of the shadow's border, where the projector's spread is wider than what is refused; the
    # median error is 10 µm. 1.10 and 1.39 times what is stated.
    # The projector's focus changes with the slope here, and lines would tell 0.56 px of blur for 0.67; but slopes are
    # so even that what is expected stands.
    "focus over depth": Light(
        {"focus_mm": 540.0, "defocus_px": 9.5}, {"focus_mm": 570.0, "defocus_px": 15.0}, rms=4.9, sigma=1.5
    ),
}


def scan_of(folder: Path, light: Light, plan: PatternPlan, faults: str = "") -> Mapping[str, Any]:
    rig = rig_file(folder, BALL, {**STAND, **light.projector}, {**LEFT, **light.camera})
    text = rig.read_text()
    assert text.count("ambient = 0.01") == 1
    rig.write_text(text.replace("ambient = 0.01", light.head) + faults)
    return scanned(rig, plan=plan)


@pytest.mark.slow
@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_nothing_is_shot_again_and_the_surface_is_as_good(tmp_path: Path, plan: PatternPlan) -> None:
    ideal = scan_of(tmp_path / "ideal", Light(), plan)["truth"]
    wrong = []
    for name, light in LIGHTS.items():
        report = scan_of(tmp_path / name.replace(" ", "-"), light, plan)
        truth, evidence = report["truth"], report["evidence"]
        sys.stdout.write(
            f"{name:20} {evidence['patterns_verified']:>7} {evidence['shot_again']} again, rms "
            f"{1000 * truth['rms_mm']:5.1f} ({1000 * ideal['rms_mm']:.1f}) µm, covered {truth['complete_0.3mm']:.2%} "
            f"({ideal['complete_0.3mm']:.2%}), error/σ {truth['error_over_sigma_p68']:.2f}\n"
        )
        if (
            evidence["shot_again"]
            or evidence["contradictions"]
            or truth["rms_mm"] > light.rms * ideal["rms_mm"]
            or truth["error_over_sigma_p68"] > light.sigma
            or truth["complete_0.3mm"] < ideal["complete_0.3mm"] - light.complete
        ):
            wrong.append(name)
    assert wrong == []


@pytest.mark.slow
def test_automatic_exposure_is_refused_in_words(tmp_path: Path) -> None:
    faults = "[head.faults]\nexposure_step_frames = [9]\nexposure_step = 0.75\n"
    with pytest.raises(
        ScanEvidenceError, match=r"7[3-7]% of the light of white and black, evenly .* automatic exposure"
    ):
        scan_of(tmp_path / "stepped", Light(), LINES, faults)

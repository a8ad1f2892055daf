"""Worse light on a small scene costs at most half more error; presets and the exposure assistant against a small sweep.

`python -m tests.bench.preset_sweep` has the whole sweep of exposures.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from tests.bench.preset_sweep import best_within, by_assistant, by_preset, object_rig, swept
from tests.golden.lit_scenes import Figures, Light, scanned

pytestmark = pytest.mark.slow

GOAL = 1.5
SHARE = 0.4
SCALED = Light(signal_blur_px=0.5)


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> dict[Light, Figures]:
    """The best light, from a projector with native pixels and through a scaler."""
    return {light: scanned(light, tmp_path_factory.mktemp("reference"), share=SHARE) for light in (Light(), SCALED)}


@pytest.mark.parametrize(
    ("light", "reference"),
    [
        pytest.param(Light(gamma=2.6, signal_blur_px=0.5), SCALED, id="gamma 2.6"),
        pytest.param(Light(ambient=0.04), Light(), id="ambient x4"),
        pytest.param(Light(texture_ratio=7.0, texture="noise"), Light(), id="texture 7:1"),
        pytest.param(Light(lobe=0.3, lobe_exponent=80.0), Light(), id="specular"),
    ],
)
def test_worse_light_costs_at_most_half_more_error(
    light: Light, reference: Light, references: dict[Light, Figures], tmp_path: Path
) -> None:
    found, best = scanned(light, tmp_path, share=SHARE), references[reference]
    assert best.rms_mm < 0.012
    assert found.rms_mm <= GOAL * best.rms_mm
    assert found.complete_03 >= best.complete_03 - 0.005


def test_a_camera_out_of_focus_states_what_it_errs_by(references: dict[Light, Figures], tmp_path: Path) -> None:
    # The whole scene: its borders are what matters. Light fades out there over more than the usual 2 px: with these
    # 22 µm, and 9 stated.
    found = scanned(Light(camera_blur_px=1.2), tmp_path)
    assert found.rms_mm <= 1.2 * found.sigma_rms_mm
    assert found.rms_mm <= 3 * references[Light()].rms_mm
    assert found.complete_03 >= 0.985


@pytest.mark.parametrize("texture", ["noise", "checker"])
def test_of_a_texture_out_of_focus_what_is_stated_holds(texture: str, tmp_path: Path) -> None:
    """7:1, by a camera that blurs by 1.2 px: errors were 1.5 and 1.9 of what was stated, with the blur told 14 % too
    small and nothing said of what the first order leaves beside an edge.
    """
    light = Light(camera_blur_px=1.2, texture_ratio=7.0, texture=texture)
    assert 0.8 <= scanned(light, tmp_path).error_over_sigma <= 1.25


# For each object: exposures from too short to too long, and a bracket that does it.
SWEEPS = {  # of the dark and the mixed object; the whole sweep has the shiny one, too
    "dark": ((1 / 2,), (2,), (1, 8)),
    "mixed": ((1,), (1 / 4, 4), (1 / 16, 1 / 2, 4)),
}
WITHIN = 0.1
"""Of the completeness of the best scan of the sweep that took no longer."""


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

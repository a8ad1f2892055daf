"""Worse light on a small scene costs at most half more error; `tests/bench/test_light_sweep.py` has the whole sweep."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.light_sweep import Figures, Light, lit_scene

pytestmark = pytest.mark.slow

GOAL = 1.5
SHARE = 0.4
SCALED = Light(signal_blur_px=0.5)


def scanned(light: Light, work: Path) -> Figures:
    return lit_scene(light, share=SHARE).scanned(work, seed=1)


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> dict[Light, Figures]:
    """The best light, from a projector with native pixels and through a scaler."""
    return {light: scanned(light, tmp_path_factory.mktemp("reference")) for light in (Light(), SCALED)}


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
    found, best = scanned(light, tmp_path), references[reference]
    assert best.rms_mm < 0.012
    assert found.rms_mm <= GOAL * best.rms_mm
    assert found.complete_03 >= best.complete_03 - 0.005


def test_a_camera_out_of_focus_states_what_it_errs_by(references: dict[Light, Figures], tmp_path: Path) -> None:
    # The whole scene: its borders are what matters. Light fades out there over more than the usual 2 px: with these
    # 22 µm, and 9 stated.
    found = lit_scene(Light(camera_blur_px=1.2)).scanned(tmp_path, seed=1)
    assert found.rms_mm <= 1.2 * found.sigma_rms_mm
    assert found.rms_mm <= 3 * references[Light()].rms_mm
    assert found.complete_03 >= 0.985


@pytest.mark.parametrize("texture", ["noise", "checker"])
def test_of_a_texture_out_of_focus_what_is_stated_holds(texture: str, tmp_path: Path) -> None:
    """7:1, by a camera that blurs by 1.2 px: errors were 1.5 and 1.9 of what was stated, with the blur told 14 % too
    small and nothing said of what the first order leaves beside an edge.
    """
    light = Light(camera_blur_px=1.2, texture_ratio=7.0, texture=texture)
    assert 0.8 <= lit_scene(light).scanned(tmp_path, seed=1).error_over_sigma <= 1.25


def test_gamma_does_nothing_to_native_pixels_of_black_and_white() -> None:
    straight, bent = (lit_scene(Light(gamma=gamma), share=0.1) for gamma in (1.0, 2.6))
    for profile in straight.sequence.profiles:
        assert (straight.exposed.electrons(profile) == bent.exposed.electrons(profile)).all()

"""Exposures proposed from looks at a made-up object: bright here, dark there, and shining in a corner."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from slrig.capture.frame_checks import Samples
from slrig.errors import ConfigError
from slrig.model import FloatArray
from slrig.scan.exposure import Look, Proposal, SeenObject, proposal, seen_object

FULL = 255
DARK_DN, READ_DN, SLOPE = 6.0, 0.4, 0.05
COUNT = 12_000


def object_seen(rates: Sequence[tuple[float, float]], looks_s: Sequence[float], *, ambient: float = 20.0) -> SeenObject:
    """An object whose parts give so many DN per second under white, each on a share of the pixels."""
    rng = np.random.default_rng(3)
    # Of a `Sampler`, pixels of the second half lie beside those of the first.
    rate = np.tile(np.concatenate([np.full(round(COUNT / 2 * share), dn_per_s) for dn_per_s, share in rates]), 2)

    def frames(light: FloatArray) -> Samples:
        seen = rng.normal(DARK_DN + light, np.sqrt(READ_DN**2 + SLOPE * light), (2, len(light)))
        return np.clip(np.rint(seen), 0, FULL).astype(np.float32)

    black = np.full_like(rate, ambient)
    looks = [Look(each, frames((rate + ambient) * each), frames(black * each)) for each in looks_s]
    return seen_object(looks, FULL)


def proposed(seen: SeenObject, *times_s: float, budget_s: float | None = None) -> Proposal:
    return proposal({"left": seen}, times_s, frames=26, overhead_s=0.02, budget_s=budget_s)


def test_noise_darkness_and_what_another_exposure_would_show_are_found() -> None:
    seen = object_seen([(8000.0, 0.5), (2000.0, 0.5)], [0.005, 0.02])
    assert seen.noise.slope == pytest.approx(SLOPE, rel=0.15)
    level = np.full(1, DARK_DN + 40, np.float32)
    assert seen.noise.variance(level)[0] == pytest.approx(READ_DN**2 + SLOPE * 40 + 1 / 12, rel=0.15)
    assert seen.dark_dn == pytest.approx(DARK_DN, abs=0.5)
    white, black, saturated = seen.at(0.04)
    bright = np.arange(COUNT) % (COUNT // 2) < COUNT // 4
    assert saturated[bright].all()
    assert not saturated[~bright].any()
    # Neither look was so long.
    assert np.median(white[~bright]) == pytest.approx(DARK_DN + 2020 * 0.04, rel=0.03)
    assert np.median(black) == pytest.approx(DARK_DN + 20 * 0.04, abs=0.5)


def test_an_even_object_gets_one_exposure_and_no_longer_than_it_needs() -> None:
    found = proposed(object_seen([(8000.0, 1.0)], [0.02]), 0.005, 0.01, 0.02, 0.04)
    assert [each.exposure_s for each in found.exposures] == [0.005]
    assert found.completeness == found.well == 1
    assert found.seconds == pytest.approx(26 * (0.005 + 0.02))
    assert found.notes == []
    assert [each.saturated for each in found.others] == [0, 0, 1]


def test_what_is_dark_here_and_bright_there_gets_a_bracket_within_the_budget() -> None:
    seen = object_seen([(40_000.0, 0.3), (400.0, 0.7)], [0.004, 0.016, 0.064, 0.256])
    times_s = (0.004, 0.016, 0.064, 0.256)
    found = proposed(seen, *times_s)
    assert [each.exposure_s for each in found.exposures] == [0.004, 0.256]
    assert found.completeness == pytest.approx(1, abs=0.01)
    assert [(round(each.well, 1), round(each.saturated, 1)) for each in found.exposures] == [(0.3, 0.0), (0.7, 0.3)]
    short = proposed(seen, *times_s, budget_s=4.0)
    assert short.seconds <= 4
    assert [each.exposure_s for each in short.exposures] == [0.004, 0.064]
    assert short.well < found.well
    assert any("noise is felt" in note for note in short.notes)
    least = proposed(seen, *times_s, budget_s=0.7)
    assert least.too_dark == pytest.approx(0.7, abs=0.01)
    assert any("70.0% of what is lit is too dark even at 0.004 s" in note for note in least.notes)


def test_a_mirror_that_no_exposure_can_do_is_told_of() -> None:
    found = proposed(object_seen([(1e6, 0.1), (4000.0, 0.9)], [0.004, 0.016]), 0.004, 0.016)
    assert found.saturated == pytest.approx(0.1, abs=0.01)
    assert any("saturated even at" in note for note in found.notes)


def test_what_is_clear_counts_where_most_of_the_object_is_saturated_at_every_look() -> None:
    found = proposed(object_seen([(1e6, 0.6), (4000.0, 0.4)], [0.0167, 0.05]), 0.0167, 0.05)
    assert found.completeness == pytest.approx(0.4, abs=0.01)
    assert found.saturated == pytest.approx(0.6, abs=0.01)


def test_no_light_and_no_time_are_refused_in_words() -> None:
    with pytest.raises(ConfigError, match="nothing that the projector lights"):
        proposed(object_seen([(0.0, 1.0)], [0.02]), 0.02)
    with pytest.raises(ConfigError, match=r"budget_s: found 0\.1 s; the shortest .* takes 1\.04 s of 26 frames"):
        proposed(object_seen([(4000.0, 1.0)], [0.02]), 0.02, budget_s=0.1)

"""Which exposure is proposed, for lights that are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from slrig.doctor.advice import ExposureAdvice, exposure_advice, unsnapped
from slrig.doctor.findings import Finding, Severity, fault, ok
from slrig.doctor.flicker import Flicker
from slrig.doctor.light import Seen
from slrig.doctor.measures.levels import LightLevels, light_levels


def levels() -> LightLevels:
    rng = np.random.default_rng(0)
    images = [[rng.normal(mean, 1.0, (20, 20)).astype(np.uint8) for _ in range(3)] for mean in (120, 10)]
    return light_levels(images[0], images[1], full_scale=255)


def seen(own_exposure_s: float, *, shortest_s: float = 0.002, longest_s: float = 0.04) -> Seen:
    return Seen("left", own_exposure_s, levels(), 0.02, levels(), shortest_s, longest_s, 0.0)


LIMITS_S = (1e-5, 1.0)
MAINS = Flicker("room", 100.0, 0.05)
WHEEL = Flicker("projector", 180.0, 0.4)


@pytest.mark.parametrize(
    ("own_s", "refresh_hz", "flickers", "expected_s"),
    [
        # A good exposure is kept.
        (0.02, None, (), 0.02),
        (1 / 60, 60.0, (), 1 / 60),
        (0.02, None, (MAINS,), 0.02),
        # One that saturates, or drowns in noise, gives way to the longest.
        (0.08, None, (), 0.04),
        (0.0005, None, (), 0.04),
        # Whole periods: of the refresh, of a colour wheel, of the mains.
        (0.02, 60.0, (), 2 / 60),
        (0.019, None, (WHEEL,), 7 / 180),
        (0.017, None, (MAINS,), 0.04),
        # Refresh and mains together: 50 ms would serve both and saturates; 2/60 s leaves less than 1/60 s.
        (0.02, 60.0, (MAINS,), 2 / 60),
    ],
)
def test_an_exposure_is_kept_or_snapped(
    own_s: float, refresh_hz: float | None, flickers: tuple[Flicker, ...], expected_s: float
) -> None:
    advice = exposure_advice(seen(own_s), LIMITS_S, refresh_hz=refresh_hz, flickers=flickers)
    assert advice.exposure_s == pytest.approx(expected_s, rel=1e-6)
    assert ("kept" in advice.reason) is (expected_s == own_s)


def test_advice_gives_its_reason_and_keeps_to_the_limits() -> None:
    def advised(
        own_s: float, longest_s: float, limits_s: tuple[float, float] = LIMITS_S, **more: Any
    ) -> ExposureAdvice:
        return exposure_advice(
            seen(own_s, longest_s=longest_s), limits_s, **{"refresh_hz": 60.0, "flickers": (), **more}
        )

    # Three refreshes serve the mains, too.
    advice = advised(0.02, 0.06, flickers=(MAINS,))
    assert advice.exposure_s == pytest.approx(0.05)
    assert advice.reason == "3 × the refresh period (16.7 ms)"
    # Light is too bright for one period.
    advice = advised(0.02, 0.01)
    assert advice.exposure_s == 0.01
    assert "less than the refresh period (16.7 ms)" in advice.reason
    advice = advised(0.08, 0.04, (1e-3, 0.03), refresh_hz=None)
    assert (advice.exposure_s, advice.usable_s) == (0.03, (0.002, 0.03))


def test_exposure_that_misses_the_refresh_is_noted() -> None:
    assert unsnapped(seen(0.02), None) == []
    assert unsnapped(seen(1 / 30), 60.0) == []
    [told] = unsnapped(seen(0.02), 60.0)
    assert (told.name, told.severity) == ("exposure.refresh", Severity.NOTE)


def test_a_fault_needs_a_remedy_and_what_is_well_has_none() -> None:
    assert ok("light.part", "camera 'left'", "all is lit").remedy == ""
    with pytest.raises(ValueError, match="a remedy belongs to every note and fault"):
        fault("light.none", "camera 'left'", "nothing is lit", "")
    with pytest.raises(ValueError, match="a remedy belongs to every note and fault"):
        Finding("light.part", "camera 'left'", Severity.OK, "all is lit", "do nothing")

"""Stripe centres against the Cramér-Rao bound of rendered scenes, small; `tests/bench` has more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from tests.bench.stripe_limit import PLANE, SOFT_PX, SPHERE, exposed_at_snr, measured, rig


@pytest.mark.slow
@pytest.mark.parametrize("snr", [20.0, 60.0])
@pytest.mark.parametrize(("thing", "goal"), [(PLANE, 1.15), (SPHERE, 1.5)], ids=["plane", "sphere"])
def test_noise_costs_little_more_than_the_bound(thing: Mapping[str, object], goal: float, snr: float) -> None:
    bench = rig(thing, size_px=(200, 140), blur_px=SOFT_PX)
    points = measured(bench, exposed_at_snr(bench, snr), captures=4)
    assert len(points.error_px) > 40_000
    assert np.median(points.snr) == pytest.approx(snr, rel=0.05)
    assert points.ratio <= goal
    # The light of all line frames can better a single frame's bound, but not that of the few pixels that are read.
    assert 2 < points.pixels_worth < 30
    assert points.bias_rms_px < 0.01

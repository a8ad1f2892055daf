"""How near stripe location comes to the noise limit of the light itself. Prints a table and holds the goals.

    pytest tests/bench/test_stripe_limit.py -s

The bound is that of the line frame alone, as if albedo and room light were known without noise, averaged along the
stripe over the 2√π σ rows that a Gaussian of the stripe's own width (at least 1 px) smooths. Points that are refined by
the light of all line frames may come below it; "worth" says of how many pixels, read in all line frames without loss,
they have the scatter.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

import numpy as np
import pytest

from tests.bench.stripe_limit import PLANE, SHARP_PX, SOFT_PX, SPHERE, Points, exposed_at_snr, measured, rig
from tests.unit.reconstruction.builders import rms

CAPTURES = 6
SNRS = (20.0, 30.0, 40.0, 60.0)
HEADING = "scene   blur  SNR n/1000  rms, px    bound ratio bias, px  worth"


def row(scene: str, blur_px: float, points: Points) -> str:
    return (
        f"{scene:7} {blur_px:4.1f} {np.median(points.snr):4.0f} {len(points.error_px) / 1000:6.0f} "
        f"{rms(points.error_px):8.5f} {rms(points.bound_px):8.5f} {points.ratio:5.3f} {points.bias_rms_px:8.5f} "
        f"{points.pixels_worth:6.1f}"
    )


@pytest.mark.parametrize("blur_px", [SHARP_PX, SOFT_PX])
@pytest.mark.parametrize(("scene", "thing", "goal"), [("plane", PLANE, 1.15), ("sphere", SPHERE, 1.5)])
def test_stripes_are_located_at_the_limit_of_their_light(
    scene: str, thing: Mapping[str, object], goal: float, blur_px: float
) -> None:
    bench = rig(thing, size_px=(320, 256), blur_px=blur_px)
    sys.stdout.write(f"\n{HEADING}\n")
    found = {}
    for snr in SNRS:
        points = measured(bench, exposed_at_snr(bench, snr), captures=CAPTURES)
        sys.stdout.write(f"{row(scene, blur_px, points)}\n")
        found[snr] = points.ratio
    assert all(ratio <= goal for ratio in found.values()), f"{scene}, goal {goal}: rms / bound by SNR {found}"

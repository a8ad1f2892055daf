"""Stripe centres against the Cramér-Rao bound of rendered scenes, and beside the projector's border."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from slrig.model import FloatArray
from tests.golden.stripe_limit import PLANE, SHARP_PX, SOFT_PX, SPHERE, Points, exposed_at_snr, measured, rig
from tests.unit.reconstruction.builders import rms

pytestmark = pytest.mark.slow

COLUMNS = 140
SNR = 40.0


@pytest.fixture(scope="module")
def points() -> tuple[Points, FloatArray]:
    """The points of some captures, and the distance of each one's line from the nearer border's, columns."""
    # The light of so narrow a projector ends inside the view on both sides.
    bench = rig(PLANE, size_px=(240, 90), blur_px=SHARP_PX, columns=COLUMNS)
    column = bench.view.truth().projector_px[..., 0]
    assert np.isnan(column[45, [0, -1]]).all()
    found = measured(bench, exposed_at_snr(bench, SNR), captures=20)
    line = found.cell // bench.camera.size.height_px
    return found, np.minimum(line, COLUMNS - 1 - line).astype(np.float64)


def test_lines_near_the_border_are_no_worse_than_they_state(points: tuple[Points, FloatArray]) -> None:
    found, distance = points
    beside = distance < 8
    assert beside.sum() > 2000
    for at in np.unique(distance[beside]):
        here = distance == at
        # Two standard deviations of a root mean square of so many; a fit to 5 x 5 pixels ties five points of a line.
        most = 1 + 2 / np.sqrt(2 * here.sum() / 5)
        assert rms(found.error_px[here]) < most * rms(found.stated_px[here]), f"{at} columns from the border"


def test_only_the_lines_beside_the_border_are_left_out(points: tuple[Points, FloatArray]) -> None:
    _, distance = points
    assert set(np.unique(distance)) == set(range(3, COLUMNS // 2))
    counts = np.bincount(distance.astype(int))
    assert counts[3:12].min() > 0.9 * np.median(counts[12:])


@pytest.mark.parametrize("snr", [20.0, 60.0])
@pytest.mark.parametrize(("thing", "goal"), [(PLANE, 1.15), (SPHERE, 1.5)], ids=["plane", "sphere"])
def test_noise_costs_little_more_than_the_bound(thing: Mapping[str, object], goal: float, snr: float) -> None:
    bench = rig(thing, size_px=(200, 140), blur_px=SOFT_PX)
    points = measured(bench, exposed_at_snr(bench, snr), captures=4)
    assert len(points.error_px) > 40_000
    assert np.median(points.snr) == pytest.approx(snr, rel=0.05)
    assert points.ratio <= goal
    assert points.bias_rms_px < 0.01

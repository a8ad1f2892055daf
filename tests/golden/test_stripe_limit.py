"""Stripe centres against the Cramér-Rao bound of rendered scenes, and beside the projector's border."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from simulated_rig.options import ProjectorOptions
from simulated_rig.rendering import Stage, View
from simulated_rig.scene import Scene, surface_of
from slrig.model import FloatArray
from slrig.patterns.sequence import encode, scan_patterns
from tests.bench.stripe_limit import (
    PLANE,
    SHARP_PX,
    SOFT_PX,
    SPHERE,
    Points,
    Rig,
    exposed_at_snr,
    measured,
    rig,
    rms,
)

pytestmark = pytest.mark.slow

COLUMNS = 140
SNR = 40.0


def narrow_rig() -> Rig:
    """The rig of the stripe limit with a narrower projector, whose light ends inside the view on both sides."""
    whole = rig(PLANE, size_px=(240, 90), blur_px=SHARP_PX)
    lamp = ProjectorOptions.model_validate(whole.projector.model_dump() | {"size_px": [COLUMNS, 384]})
    scene = Scene.model_validate({"object": [{**PLANE, "albedo": 0.8}]})
    stage = Stage(surface_of(scene, Path()), lamp.pinhole(), working_distance_mm=600.0)
    view = View(
        whole.camera.pinhole(), stage, blur_px=SHARP_PX, ambient=0.01, samples_per_axis=3, jitter=False, seed=1,
        workers=2,
    )  # fmt: skip
    patterns = scan_patterns(
        lamp.size, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return dataclasses.replace(whole, projector=lamp, stage=stage, view=view, sequence=encode(patterns, lamp.size))


@pytest.fixture(scope="module")
def points() -> tuple[Points, FloatArray]:
    """The points of some captures, and the distance of each one's line from the nearer border's, columns."""
    bench = narrow_rig()
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
    # The light of all line frames can better a single frame's bound, but not that of the few pixels that are read.
    assert 2 < points.pixels_worth < 30
    assert points.bias_rms_px < 0.01

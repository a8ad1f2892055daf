"""Live depth against formulas: its error, what it states of it, what moves, and frames that show something else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.devices import ProjectorInfo
from slrig.live.depth import DepthImage, LiveDecoder, LiveView, PixelState
from slrig.live.plan import LivePlan, live_plan
from slrig.live.server import depth_facts
from slrig.model import Axis, Black, Gray, LineShift, Region, White
from tests.unit.live.scene import EXPOSURE_S, FRAME_S, PROJECTOR, Photographer, Plane, bound_mm, calibration

_MEASURED, _MOVED = PixelState.MEASURED, PixelState.MOVED


def _plan(*, shades: bool = True) -> LivePlan:
    return live_plan(ProjectorInfo("p", "p", "1", PROJECTOR, False, 0.0, shades=shades), Axis.COLUMN)


def _decoder(plan: LivePlan, region: Region | None = None, *, step: int = 1) -> LiveDecoder:
    seen = LiveView(calibration(), "left", plan.axis, region)
    return LiveDecoder(plan, seen, step=step, clipped_at=255, full_scale=255)


def _last(
    plane: Plane, plan: LivePlan, *, gamma: float = 1.0, cycles: int = 4, decoder: LiveDecoder | None = None
) -> tuple[Photographer, DepthImage, float]:
    """Photographer, last depth image, and the time in the middle of its fine frames."""
    photographer, decoder = Photographer(plane, plan.patterns, gamma=gamma), decoder or _decoder(plan)
    count, image, part = len(plan.patterns), None, decoder.seen.part
    for number in range(cycles * count):
        t_s = number * FRAME_S
        frame = photographer.frame(number % count, t_s)[part.rows, part.columns]
        assert decoder.add(number % count, frame, t_s - EXPOSURE_S / 2, t_s + EXPOSURE_S / 2) is None
        image = decoder.depth()
    assert image is not None
    first = (cycles - 1) * count
    return photographer, image, float(np.mean([(first + index) * FRAME_S for index in plan.fine]))


@pytest.mark.parametrize(
    ("shades", "gamma", "most"), [(True, 1.0, 1.2), (True, 2.2, 1.2), (False, 1.0, 1.3)], ids=["sine", "gamma", "lines"]
)
def test_still_plane_is_measured_as_well_as_its_light_allows_and_its_sigma_says_so(
    *, shades: bool, gamma: float, most: float
) -> None:
    plan = _plan(shades=shades)
    photographer, image, t_s = _last(Plane(), plan, gamma=gamma)
    known = image.state == _MEASURED
    error = (image.depth_mm - photographer.plane.depth_mm(photographer.camera, 0.0))[known]
    assert known.mean() > 0.85
    assert 0.8 < np.quantile(np.abs(error) / image.sigma_mm[known], 0.68) < 1.25
    assert np.abs(error).max() < 12 * np.median(image.sigma_mm[known])
    if shades:
        bound = bound_mm(photographer, plan.fine, t_s)[known]
        assert np.sqrt(np.mean((error / bound) ** 2)) < most


@pytest.mark.parametrize("speed_mm_s", [10.0, 50.0, 200.0])
def test_depth_that_motion_spoils_is_marked_and_what_stands_still_is_not(speed_mm_s: float) -> None:
    photographer, image, t_s = _last(Plane(speed_mm_s=speed_mm_s, still_share=0.4), _plan(), gamma=1.8)
    wrong = np.abs(image.depth_mm - photographer.plane.depth_mm(photographer.camera, t_s)) > 3 * image.sigma_mm
    still = np.s_[:, : round(0.4 * image.state.shape[1]) - 5]
    moving = np.s_[:, round(0.4 * image.state.shape[1]) + 5 :]
    assert (image.state[moving] == _MOVED).mean() > 0.4
    if wrong[moving].any():
        assert (image.state[moving] == _MOVED)[wrong[moving]].mean() >= 0.95
    assert (image.state[still] == _MOVED).mean() <= 0.02
    assert (image.state[still] == _MEASURED).mean() > 0.8


def _stale(number: int, rng: np.random.Generator) -> int:
    return number - 1 if number and rng.random() < 0.05 else number


def _swapped(number: int, _rng: np.random.Generator) -> int:
    # Both of a pair, so that each shows the other's pattern.
    pair = np.random.default_rng(number // 2)
    return number ^ 1 if pair.random() < 0.05 else number


def _late(number: int, _rng: np.random.Generator) -> int:
    # From here on each frame shows the pattern before.
    return number - 1 if number > 40 else number


@pytest.mark.parametrize("fault", [_stale, _swapped, _late])
@pytest.mark.parametrize("speed_mm_s", [0.0, 50.0])
def test_frames_of_another_pattern_make_no_wrong_depth(
    fault: Callable[[int, np.random.Generator], int], speed_mm_s: float
) -> None:
    plan, rng = _plan(), np.random.default_rng(7)
    plane = Plane(speed_mm_s=speed_mm_s, still_share=0.5)
    photographer, decoder = Photographer(plane, plan.patterns, gamma=1.8), _decoder(plan)
    count, shown, images = len(plan.patterns), 0, 0
    frames: dict[int, np.ndarray[tuple[int, ...], np.dtype[np.uint8]]] = {}
    half = np.s_[:, : round(0.5 * photographer.camera.size.width_px) - 5]
    truth = plane.depth_mm(photographer.camera, 0.0)[half]
    for number in range(12 * count):
        t_s = number * FRAME_S
        came = fault(number, rng)
        if came not in frames:
            frames[came] = photographer.frame(came % count, came * FRAME_S)
        decoder.add(number % count, frames[came], t_s - EXPOSURE_S / 2, t_s + EXPOSURE_S / 2)
        image = decoder.depth()
        if image is None:
            continue
        images += 1
        known = image.state[half] == _MEASURED
        wrong = np.abs(image.depth_mm[half] - truth) > 8 * image.sigma_mm[half]
        assert (wrong & known).mean() < 5e-4, f"frame {number}"
        shown += known.mean() > 0.5
    assert shown > 0.5 * images or fault is _late


_NEAR = (200.0, 596.0)
_POLYGON = ((100.0, 60.0), (180.0, 60.0), (180.0, 120.0), (100.0, 120.0))
_BOX = ((-20.0, -15.0, -10.0), (15.0, 20.0, 10.0))
Held = Callable[[Any, Any], Any]


def _in_polygon(pixels: Any, _points: Any) -> Any:
    return ((pixels >= _POLYGON[0]) & (pixels <= _POLYGON[2])).all(axis=-1)


def _near(_pixels: Any, points: Any) -> Any:
    return points[..., 2] < _NEAR[1]


def _in_box(_pixels: Any, points: Any) -> Any:
    camera = calibration().cameras["left"]
    world = (points - camera.translation_mm) @ camera.rotation
    return ((world > _BOX[0]) & (world < _BOX[1])).all(axis=-1)


@pytest.mark.parametrize(
    ("region", "held"),
    [
        (Region(polygons_px={"left": _POLYGON}), _in_polygon),
        (Region(depth_mm=_NEAR), _near),
        (Region(box_mm=_BOX), _in_box),
    ],
    ids=["polygon", "depth", "box"],
)
def test_a_region_leaves_its_own_pixels_as_they_are_and_no_others(
    region: Region, held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slrig.reconstruction.image_part._LEAST_PX", 64)
    plan = _plan()
    photographer, whole, _ = _last(Plane(), plan)
    decoder = _decoder(plan, region)
    _, image, _ = _last(Plane(), plan, decoder=decoder)
    part = np.s_[decoder.seen.part.rows, decoder.seen.part.columns]
    z = photographer.plane.depth_mm(photographer.camera, 0.0)[part][..., None]
    directions = np.concatenate([decoder.table.directions, np.ones_like(z)], axis=-1)
    y, x = np.mgrid[part]
    within = held(np.stack([x, y], axis=-1), directions * z)
    # At the limits noise decides.
    clear, beyond = (cv2.erode(each.astype(np.uint8), np.ones((5, 5))) > 0 for each in (within, ~within))
    known = whole.state[part] == _MEASURED
    assert (image.state[beyond & known] == PixelState.OUTSIDE).all()
    assert np.isnan(image.depth_mm[beyond]).all()
    assert (clear & known).sum() > 2000
    assert (image.state[clear & known] == _MEASURED).mean() > 0.99
    apart = np.abs(image.depth_mm - whole.depth_mm[part])[clear & known]
    assert np.nanmax(apart) < 0.2 * np.nanmedian(whole.sigma_mm)
    assert image.state.size < 0.5 * whole.state.size or region.depth_mm
    shares = depth_facts(image, decoder)["shares"]
    assert abs(shares["outside"] - (image.state == PixelState.OUTSIDE).mean()) < 0.02
    assert abs(sum(shares.values()) - shares["outside"] - 1) < 1e-3


@pytest.mark.parametrize("limited", ["contrast", "sigma"])
def test_weak_and_uncertain_points_are_left_out_of_a_region(limited: str) -> None:
    plan = _plan()
    _, whole, _ = _last(Plane(), plan)
    known = whole.state == _MEASURED
    middle_mm = float(np.nanmedian(whole.sigma_mm))
    region = Region(min_contrast=0.5) if limited == "contrast" else Region(max_sigma_mm=middle_mm)
    _, image, _ = _last(Plane(), plan, decoder=_decoder(plan, region))
    kept = image.state == _MEASURED
    assert 0.2 * known.sum() < kept.sum() < 0.8 * known.sum()
    assert not (kept & ~known).any()


def test_a_black_and_white_projector_plays_lines_and_a_code_and_a_recording_what_it_has() -> None:
    lines = _plan(shades=False)
    assert {type(pattern) for pattern in lines.patterns} == {LineShift, Gray}
    recorded = ProjectorInfo("p", "p", "1", PROJECTOR, False, 0.0, recorded=(*lines.patterns[::-1], White(), Black()))
    assert set(live_plan(recorded, Axis.COLUMN).patterns) > set(lines.patterns)
    with pytest.raises(Exception, match="recording of 'p' has none"):
        live_plan(recorded, Axis.ROW)

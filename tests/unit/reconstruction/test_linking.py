"""Stripes of one code linked into one curve, as section 2 of the paper has it.

`tests/properties/test_linking.py` compares the procedure with the paper's pseudocode.
"""

from __future__ import annotations

import numpy as np
import pytest

from slrig.model import Axis, FloatArray
from slrig.reconstruction.identification import NumberedStripes, StripeEnsemble, link_stripes
from slrig.reconstruction.triangulation import triangulate_camera_projector
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR, opencv_pixels, opencv_rays, stripes_of


def linked(*stripes: FloatArray, position_px: list[float] | None = None) -> StripeEnsemble:
    return link_stripes(NumberedStripes(stripes_of(list(stripes)), np.array(position_px or [7.0] * len(stripes))))


def down(x: float, rows: range, *, lean: float = 0.0) -> FloatArray:
    """A stripe from top to bottom, leaning to the right."""
    return np.array([[x + lean * (row - rows[0]), float(row)] for row in rows])


def points_between(ensemble: StripeEnsemble) -> list[tuple[list[float], list[float]]]:
    """The two ends of each bridge."""
    at = np.flatnonzero(ensemble.bridge_after)
    return [(ensemble.points_px[i].tolist(), ensemble.points_px[i + 1].tolist()) for i in at]


UPPER, LOWER = down(10.0, range(0, 20)), down(10.0, range(30, 45))


COLUMN = 150.0


def lit_plate(depth_mm: float, rows: FloatArray) -> FloatArray:
    """(n, 2): pixels of one projector column on a plate at a depth, from top to bottom."""
    pixels = np.column_stack([np.full(len(rows), COLUMN), rows])
    rays = opencv_rays(PROJECTOR, pixels)
    reach = (depth_mm - PROJECTOR.centre_mm[2]) / rays[:, 2]
    return opencv_pixels(CAMERA, PROJECTOR.centre_mm + reach[:, None] * rays)


@pytest.mark.parametrize("step_mm", [-15.0, -5.0, 5.0, 15.0, 60.0])
@pytest.mark.parametrize("turned", [(), (0,), (1,), (0, 1)])
def test_one_light_on_a_step_makes_two_stripes_and_one_curve_along_its_sheet(
    step_mm: float, turned: tuple[int, ...]
) -> None:
    # Figure 2: the plane of light meets two surfaces; in the image the stripes lie beside one another.
    above, below = lit_plate(0.0, np.arange(20.0, 110.0, 0.4)), lit_plate(step_mm, np.arange(112.0, 230.0, 0.4))
    sideways = abs(below[0, 0] - above[-1, 0])
    assert sideways > 0.07 * abs(step_mm)
    stripes = [stripe[::-1].copy() if k in turned else stripe for k, stripe in enumerate((above, below))]
    ensemble = linked(*stripes, position_px=[COLUMN, COLUMN])
    np.testing.assert_array_equal(ensemble.points_px, np.concatenate([above, below]))
    assert np.flatnonzero(ensemble.bridge_after).tolist() == [len(above) - 1]
    # In space the curve runs down the sheet: every point at its own row of the projector, in order.
    sheet, _ = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    assert len(sheet.points_mm) == len(ensemble.points_px)
    assert (np.diff(sheet.along_px) > 0).all()
    assert np.flatnonzero(sheet.bridge_after).tolist() == [len(above) - 1]


def test_a_cliff_can_mislead_the_papers_rule_but_not_the_light_sheet() -> None:
    # The lower stripe lies so far aside that a line to its far end turns less than one to its near end.
    above, below = lit_plate(0.0, np.arange(20.0, 110.0, 0.4)), lit_plate(-60.0, np.arange(112.0, 230.0, 0.4))
    ensemble = linked(above, below, position_px=[COLUMN, COLUMN])
    assert points_between(ensemble) == [(above[-1].tolist(), below[-1].tolist())]
    sheet, _ = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    np.testing.assert_array_equal(sheet.pixels_px, np.concatenate([above, below]))
    assert np.flatnonzero(sheet.bridge_after).tolist() == [len(above) - 1]


def test_adjacent_pixels_of_two_stripes_may_be_far_apart_in_space_and_are_joined_by_a_bridge() -> None:
    # Figure 2 (b, c): the far plate's stripe ends beside the near one's; neighbours in the image, 60 mm apart in depth.
    near, far = lit_plate(-60.0, np.arange(20.0, 110.0, 0.4)), lit_plate(0.0, np.arange(110.4, 200.0, 0.4))
    sheet, _ = triangulate_camera_projector(linked(near, far, position_px=[COLUMN] * 2), CAMERA, PROJECTOR, Axis.COLUMN)
    (at,) = np.flatnonzero(sheet.bridge_after)
    assert np.linalg.norm(sheet.points_mm[at + 1] - sheet.points_mm[at]) > 59


def test_codes_are_linked_apart_and_come_in_rising_order() -> None:
    stripes = [down(30.0, range(0, 10)), down(10.0, range(20, 30)), down(10.0, range(0, 10)), down(50.0, range(0, 5))]
    ensemble = linked(*stripes, position_px=[11.5, 3.5, 3.5, 19.5])
    assert ensemble.position_px.tolist() == [3.5, 11.5, 19.5]
    assert ensemble.offsets.tolist() == [0, 20, 30, 35]
    assert np.flatnonzero(ensemble.bridge_after).tolist() == [9]
    assert ensemble.stripe.tolist() == [2] * 10 + [1] * 10 + [0] * 10 + [3] * 5


def test_points_keep_their_normals_and_deviations() -> None:
    chains = [LOWER[::-1].copy(), UPPER]
    angles = np.linspace(0, 1, 35)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    stripes = stripes_of(chains, normals=[normals[:15], normals[15:]])
    ensemble = link_stripes(NumberedStripes(stripes, np.array([7.0, 7.0])))
    for point, normal, sigma in zip(ensemble.points_px, ensemble.normals, ensemble.sigma_px, strict=True):
        (source,) = np.flatnonzero((stripes.points_px == point).all(axis=1))
        np.testing.assert_array_equal(normal, stripes.normals[source])
        assert sigma == stripes.sigma_px[source]


def test_nothing_links_to_nothing() -> None:
    ensemble = link_stripes(NumberedStripes(stripes_of([]), np.zeros(0)))
    assert ensemble.offsets.tolist() == [0]
    assert len(ensemble.position_px) == len(ensemble.points_px) == 0

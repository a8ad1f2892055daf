"""Points of stripes at their best places: where the light of all line frames puts them, if it was the same in all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray
from slrig.reconstruction.blur import told_blur
from slrig.reconstruction.centroid import at_pixel_centres, third_order_px
from slrig.reconstruction.coded import Coded, cell_width_px
from slrig.reconstruction.curvature import freed_of_curvature
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.edges import beside_steps_px, near_edges, near_shadows_of, near_steps
from slrig.reconstruction.identification import with_refused_pixels
from slrig.reconstruction.limits import CodeTables, Limits
from slrig.reconstruction.phase import line_step_px, position_map
from slrig.reconstruction.refinement import refined
from slrig.reconstruction.stripes import LinePoints


@dataclass(frozen=True, slots=True)
class Placed:
    """Points of each line frame, or of each bit, at their best places, and the code with the causes of those left out.

    near_shadow, near_step : (H, W) bool, where no point counts; refined, disagreement_px : as of `camera.CameraCurves`.
    """

    points: list[LinePoints]
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    near_step: NDArray[np.bool_]
    refined: bool
    disagreement_px: FloatArray


def placed(
    coded: Coded, found: list[LinePoints], stripe_blur_px: float, tables: CodeTables, limits: Limits,
    lines_used: Callable[[], None], *, sampled: bool,
) -> Placed:  # fmt: skip
    """Put the points that were found where the light of all frames puts them, if it was the same in all.

    found : is given away. stripe_blur_px : the blur that the stripes' width tells, the projector's included.
    lines_used : is called when the images of lines are needed no more, before what takes most memory begins.
    sampled : as of `refinement.refined`.
    """
    frames, code, disagreement_px, points = coded.frames, coded.code, np.zeros(0), found
    seen = position_map(frames, coded.position_noise, code, tables.cell_position)
    resolution_px = cell_width_px(coded)
    step_px = line_step_px(frames.line_patterns)
    if step_px is not None:
        resolution_px = 0.0
        period_px = frames.line_patterns[0].period_px
        blur_px, by_lines = told_blur(frames, seen, ~coded.near_shadow, limits.camera_blur_px)
        near_shadow = near_shadows_of(blur_px, coded.near_shadow, coded.unlit, limits.edges)
        prints = None if by_lines else ~near_shadow
        centred = at_pixel_centres(seen, frames.contrast, coded.contrast_deviation, blur_px, clear=prints)
        near_step = near_steps(centred, resolution_px, limits.edges)
        usable = np.isfinite(centred.position) & ~near_shadow & ~near_step
        beyond_px = third_order_px(seen, centred, usable, blur_px, period_px)
        seen = freed_of_curvature(centred, usable, blur_px**2, period_px)
        displaced_px = np.hypot(beside_steps_px(near_step), beyond_px)
        del centred, beyond_px
        known = with_refused_pixels(code, frames, seen.position, tables.position_of, near_shadow, near_step)
        refinement = refined(
            found, seen, usable, code, tables.position_of, step_px, displaced_px=displaced_px,
            largest_disagreement_px=limits.largest_disagreement_px, sampled=sampled, steady=lines_used,
        )  # fmt: skip
        points, disagreement_px = refinement.points, refinement.disagreement_px
        if refinement.moved:
            return Placed(points, known, near_shadow, near_step, True, disagreement_px)
    # A fit to pixels leaves out those of mixed light; a filter's window has to be clear of them.
    near_shadow, near_step = near_edges(seen, coded.unlit, resolution_px, limits.edges.for_filters(stripe_blur_px))
    return Placed(points, code, near_shadow, near_step, False, disagreement_px)

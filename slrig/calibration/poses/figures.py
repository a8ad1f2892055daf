"""Figures of one pose of the board in one camera: what a judgement is made from, beside the corners themselves."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """How well one camera saw the board in one pose. NaN where a figure could not be measured.

    moved_px : greatest rms distance of the corners from where the first frame has them; inf where the board is lost.
    saturated : share of the board's pixels that are clipped in the white frame.
    contrast : of the board's light squares, white minus black (the projector's light), median, as a share of full
    scale; where no projector was used, light squares minus dark ones.
    sharpness_px : standard deviation of the blur across the edges of the board's squares, in camera pixels.
    decoded : share of the board's lit pixels whose light was decoded along both axes; NaN without a projector.
    """

    moved_px: float
    saturated: float
    contrast: float
    sharpness_px: float
    decoded: float

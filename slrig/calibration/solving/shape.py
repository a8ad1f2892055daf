"""The board's own shape: whether held-out poses are better with a bent board, and how far out of flat it is.

All poses are of one board, so that what its shape takes off the residuals of some poses it takes off those of others,
too: a shape is kept as a lens term is (`slrig.calibration.solving.held_out`). There are three, each a special case of
the next: flat and as printed; bent; bent with every corner off its printed place. Lens and shape can be confused where
the board always stands at one place of the image; how far is in the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slrig.calibration.board import Board, BoardShape
from slrig.calibration.solution import Bow
from slrig.calibration.solving.adjustment import Prior, adjusted, kept_of
from slrig.calibration.solving.deviations import deviations_of
from slrig.calibration.solving.held_out import TRIAL_STEPS, folds_of, held_out, loss_of
from slrig.calibration.solving.parameters import Geometry
from slrig.calibration.solving.problem import Fit, Problem, Terms, fitted, free_of, with_terms
from slrig.calibration.solving.projection import BEND
from slrig.model import FloatArray

BEND_SIGMA = 0.01
"""Standard deviation of each number of a board's bend over half its extent: paper glued to a board bends less."""
OFFSET_SIGMA_MM = 0.2
"""The same of a corner's offset along either axis: what printers and paper are off by within a page."""

_WORTH = (0, BEND, 2 * BEND)
"""How many terms each shape counts as. Offsets are many, and each is held near 0 by what is known of printers."""


def shapes_of(board: Board, asked: BoardShape) -> tuple[Prior | None, ...]:
    """The shapes that may be chosen, the simplest first; None is flat."""
    bend = bend_of(board, asked)
    if bend is None:
        return (None,)
    bent = (bend, replace(bend, offset_sigma_mm=OFFSET_SIGMA_MM))
    return bent if asked is BoardShape.BOWED else (None, *bent)


def bend_of(board: Board, asked: BoardShape) -> Prior | None:
    """What is known beforehand of a board's bend; None where a person said that it is flat."""
    if asked is BoardShape.FLAT:
        return None
    return Prior(BEND_SIGMA * float(np.ptp(board.points_mm[:, :2], axis=0).max()) / 2)


def chosen_shape(
    problem: Problem, fit: Fit, terms: Terms, shapes: Sequence[Prior | None], /, *, margin: float, folds: int
) -> Prior | None:
    """The shape that poses are better with by more than `margin` per term, in squared deviations: both those that it is
    fitted to and those held out. The simplest where none can be held out.

    shapes : the simplest first. terms : lens terms of each device, the same for every shape.
    """
    dealt = folds_of(problem, folds)
    if len(shapes) == 1 or not dealt:
        return shapes[0]
    richest = fitted(
        replace(problem, prior=shapes[-1]), fit.geometry, terms, rounds=2, correlated=True, noise=fit.noise
    )
    sigma = deviations_of(problem.measurements, richest.noise, problem.with_projector)
    kept = kept_of(richest.residuals, sigma)
    losses: list[float] = []
    seen: list[float] = []
    best = 0
    for rung, shape in enumerate(shapes):
        trial = replace(problem, prior=shape)
        start = with_terms(richest.geometry, trial, terms)
        free = free_of(trial, start, terms)
        tried = adjusted(start, problem.measurements, free, sigma, prior=shape, kept=kept, most_steps=TRIAL_STEPS)
        seen.append(loss_of(tried.residuals, sigma, kept))
        losses.append(sum(held_out(trial, tried.geometry, terms, richest.noise, dealt, kept).loss.values()))
        # Of few poses, those held out lie far from what the others determine, and their loss is a matter of luck: a
        # shape that is there is seen by the poses that it is fitted to as well.
        enough = margin * (_WORTH[rung] - _WORTH[best])
        if min(losses[best] - losses[rung], seen[best] - seen[rung]) > enough:
            best = rung
    return shapes[best]


def bow_of(geometry: Geometry, covariance: FloatArray, /, *, solved: bool) -> Bow:
    """How far the corners lie out of the plane that fits them best: from the lowest to the highest.

    covariance : (7, 7) float64, of the bend, mm².
    """
    basis = geometry.bend_basis()
    plane = np.column_stack([np.ones(len(basis)), geometry.points - geometry.frame[:2]])
    basis = basis - plane @ np.linalg.lstsq(plane, basis, rcond=None)[0]
    height = basis @ geometry.bend
    across = basis[int(np.argmax(height))] - basis[int(np.argmin(height))]
    return Bow(float(np.ptp(height)), float(np.sqrt(max(across @ covariance @ across, 0.0))), solved)

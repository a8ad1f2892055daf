"""Whether a print is wider or higher than it says, as the poses tell it: its stretch.

Printers feed paper along one axis and move ink along the other, and paper grows more across its grain: width and height
are off by shares of their own, s_x and s_y. Their mean is a larger or smaller board, which looks as a nearer or further
one does, and no pose tells it. Their difference d = s_x - s_y is told: a corner at (x, y) lies at (x (1 + d/2),
y (1 - d/2)), and a board that is tilted and turned fits no camera with it.

The normal equations of all other numbers θ, H = Jᵀ W J, are bordered by the column h = Jᵀ W j of the corners'
derivatives j by d. With a prior deviation σ of d, its information is jᵀ W j - hᵀ H⁻¹ h + 1/σ², and per unit of d the
others move by -H⁻¹ h (the Schur complement of a least squares problem).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.solution import BoardSize
from slrig.calibration.solving.adjustment import corner_terms, kept_of, normal_equations, solved, weights_of
from slrig.calibration.solving.measurements import groups
from slrig.calibration.solving.parameters import Geometry
from slrig.calibration.solving.problem import Fit, Problem, fitted, free_of
from slrig.calibration.solving.projection import DEVICE, POSE
from slrig.model import FloatArray

_SETTLED = 0.1  # of its own deviation
_MOST_TURNS = 4


@dataclass(frozen=True, slots=True)
class Stretch:
    """Of a print: value and deviation sigma, shares; by_device : (15 d,) float64, by how much one unit more of it would
    move the devices.
    """

    value: float
    sigma: float
    by_device: FloatArray

    def mode(self) -> FloatArray:
        """(15 d,) float64: by how much one deviation of it moves the devices."""
        return self.sigma * self.by_device


def stretched(geometry: Geometry, board: Board, stretch: float, /) -> Geometry:
    """The geometry with the corners of a board that is stretched so much."""
    return replace(geometry, points=board.points_mm[:, :2] * [1 + stretch / 2, 1 - stretch / 2])


def with_stretch(
    problem: Problem, fit: Fit, board: Board, value: float = 0.0, /, *, correlated: bool = False
) -> tuple[Fit, Stretch]:
    """The fit with the board stretched as its poses tell, and that stretch. value : the one that the fit has.

    Each round is one step of Gauss and Newton in the stretch and a whole fit of all else.
    """
    sigma = float(np.sqrt(2)) * board.square_sigma
    for _ in range(_MOST_TURNS):
        found = _told(problem, fit, value, sigma)
        if abs(found.value - value) <= _SETTLED * found.sigma:
            break
        value = found.value
        moved = stretched(fit.geometry, board, value)
        fit = fitted(problem, moved, rounds=2, correlated=correlated, noise=fit.noise)
    return fit, replace(found, value=value)


def size_of(board: Board, stretch: Stretch, /) -> BoardSize:
    """What is known of the size of a board whose stretch was found.

    Width and height are each off by `square_sigma`, which leaves their mean 1/√2 of it. Where they differ by more than
    that, the print is worse than was said, and its mean as unsure as half their difference.
    """
    scale = max(board.square_sigma / float(np.sqrt(2)), abs(stretch.value) / 2)
    return BoardSize(scale, stretch.value, stretch.sigma)


def _told(problem: Problem, fit: Fit, value: float, prior_sigma: float) -> Stretch:
    geometry, m, layout = fit.geometry, problem.measurements, fit.geometry.layout
    deviations = problem.deviations(fit.noise)
    weights = weights_of(fit.residuals, deviations, kept_of(fit.residuals, deviations))
    matrix, gradient = normal_equations(geometry, m, weights, prior=problem.prior)
    residual, rows = corner_terms(geometry, m, jacobian=True)
    corner = m.corner_where[:, 2]
    # By the corner's x and y, and so by d.
    by_corner = rows[:, :, DEVICE + POSE : DEVICE + POSE + 2]
    by_stretch = np.einsum("nkc,nc->nk", by_corner, geometry.points[corner] * [0.5, -0.5])
    weight = weights[0]
    column = np.zeros(layout.count)
    for run in groups(m.corner_where, columns=2):
        device, pose = m.corner_where[run.start, :2]
        shares = np.einsum("nki,nk,n->i", rows[run], by_stretch[run], weight[run])
        column[DEVICE * device : DEVICE * (device + 1)] += shares[:DEVICE]
        first = layout.first_pose + POSE * pose
        column[first : first + POSE] += shares[DEVICE : DEVICE + POSE]
        column[layout.first_bend :] += shares[DEVICE + POSE + 2 :]
    own = np.einsum("nki,nk,n->ni", by_corner, by_stretch, weight)
    np.add.at(column, layout.first_offset + 2 * corner[:, None] + np.arange(2), own)
    free = free_of(problem, geometry) & (np.diagonal(matrix) > 0)
    diagonal = np.sqrt(np.diagonal(matrix)[free])
    scaled = matrix[np.ix_(free, free)] / np.outer(diagonal, diagonal)
    by_free = solved(scaled, column[free] / diagonal) / diagonal
    moved = np.zeros(layout.count)
    moved[free] = -by_free
    information = float(weight @ (by_stretch**2).sum(axis=1)) - float(column[free] @ by_free) + 1 / prior_sigma**2
    pull = float(np.einsum("nk,nk,n->", by_stretch, np.nan_to_num(residual), weight)) - float(gradient[free] @ by_free)
    pull += value / prior_sigma**2
    return Stretch(value - pull / information, 1 / float(np.sqrt(information)), moved[: layout.first_pose])

"""Error of code edges, by the disagreement of the bits.

Edges of the bits alternate along a surface, so that each bit is measured between the edges of others. Light that
spreads to one side (a translucent surface, coma), or something that moved between two frames, displaces the edges of
one bit from those of the others. In blocks of the image a small surface is fitted to the positions of all edges, with a
displacement of each of the finest bits. A displacement of all bits alike is not visible.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from slrig.model import FloatArray, IntArray
from slrig.reconstruction.identification import NumberedStripes
from slrig.reconstruction.redundancy import DEVIATIONS_PER_MEDIAN

_BLOCK_PX = 32  # a surface is nearly quadratic over such a block
_NEIGHBOURS = 5  # blocks along each side, over which displacements are averaged: what causes them is smooth
_FINEST = 3  # bits with seven eighths of all edges
_MIN_POINTS, _MAX_POINTS = 20, 400  # of a bit in a block; of a block
_CORRELATED_POINTS = 5  # whose errors a filter correlates along the stripe
_MAX_SCATTER_CELLS = 0.25  # about the surface of a block; more is another surface
_SIGNIFICANT = 4.0  # standard deviations of a displacement
_MIN_DISPLACED_PX = 0.03  # less is within the stated deviation
_ROUNDS = 3


class BitAgreement(NamedTuple):
    """Displacement of each bit's edges from those of the others.

    displaced_px : (bits,) float64, median of the displacements of each bit where it is displaced, 0 without any.
    sigma_px : (n,) float64, the resulting standard deviation of each point, along its normal.
    """

    displaced_px: FloatArray
    sigma_px: FloatArray


def bit_agreement(numbered: NumberedStripes, bits: int, cell_px: float, /) -> BitAgreement:
    """Compare the edges of the code's bits, whose frames come last. cell_px : width of a cell of the code.

    If bits are displaced independently, the variance of their mean is that of one over their number, as for lines in
    `refinement`.
    """
    stripes = numbered.stripes
    lengths = np.diff(stripes.offsets)
    position, frame = np.repeat(numbered.position_px, lengths), np.repeat(stripes.frame, lengths)
    if len(frame) == 0:
        return BitAgreement(np.zeros(bits), np.zeros(0))
    first = max(int(frame.max()) + 1 - bits, 0)
    column, row = (stripes.points_px // _BLOCK_PX).astype(np.intp).T
    sums, weights = np.zeros((2, bits, row.max() + 1, column.max() + 1))
    block = row * weights.shape[2] + column
    order = np.argsort(block, kind="stable")
    for every in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
        step = max(1, len(every) // _MAX_POINTS)
        index, here = every[::step], (row[every[0]], column[every[0]])
        for each, px, variance in _displacements(
            stripes.points_px[index], position[index], frame[index], first, _MAX_SCATTER_CELLS * cell_px
        ):
            weight = 1 / (variance * max(1.0, _CORRELATED_POINTS / step))
            sums[(each - first, *here)], weights[(each - first, *here)] = weight * px, weight
    for each in (*sums, *weights):
        side = (_NEIGHBOURS, _NEIGHBOURS)
        each[:] = cv2.boxFilter(each, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
    known = weights > 0
    spread = 1 / np.where(known, weights, np.inf)
    square = (sums * spread) ** 2
    displaced = known & (square > np.maximum(_SIGNIFICANT**2 * spread, _MIN_DISPLACED_PX**2))
    moved = np.sqrt(np.where(displaced, square - spread, 0))
    count = known.sum(axis=0) + 1
    shared = np.sqrt((moved**2).sum(axis=0) / np.maximum((count - 1) * count, 1))
    own = np.where(frame >= first, moved[np.maximum(frame - first, 0), row, column], 0)
    medians = [float(np.median(each[each > 0])) if each.any() else 0.0 for each in moved]
    return BitAgreement(np.array(medians), np.hypot(own, shared[row, column]))


def _displacements(
    points_px: FloatArray, position: FloatArray, frame: IntArray, first: int, most: float
) -> list[tuple[int, float, float]]:
    """Displacement of each of the finest bits of a block: its frame, camera px, and the variance by scatter.

    most : scatter about the surface, projector px, beyond which a block shows more than one surface.
    """
    frames, counts = np.unique(frame, return_counts=True)
    free = frames[(counts >= _MIN_POINTS) & (frames >= first)][-_FINEST:]
    if len(free) and np.count_nonzero(~np.isin(frame, free)) < _MIN_POINTS:
        free = free[1:]
    if not len(free):
        return []
    x, y = ((points_px - points_px.mean(axis=0)) / (_BLOCK_PX / 2)).T
    terms = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, frame[:, None] == free])
    weight = np.ones(len(x))
    for _ in range(_ROUNDS):
        inverse = np.linalg.pinv(terms.T @ (weight[:, None] * terms))
        solved = inverse @ (terms.T @ (weight * position))
        off = np.abs(position - terms @ solved)
        scatter = DEVIATIONS_PER_MEDIAN * float(np.median(off))
        weight = 1 / np.maximum(off / max(2 * scatter, 1e-9), 1)
    slope = float(np.hypot(solved[1], solved[2])) / (_BLOCK_PX / 2)
    if scatter > most or slope == 0:
        return []
    moved, variance = solved[6:] / slope, np.diagonal(inverse)[6:] * (max(scatter, 1e-4) / slope) ** 2
    return [(int(a), float(b), float(c)) for a, b, c in zip(free, moved, variance, strict=True)]

"""How much larger the errors of poses are than those of matches that err one by one.

Neighbouring points err alike, and one vertex has matches with several views, so that the inverse of the information is
too small. What the matches of a block of the surface pull at the poses, its gradient g_b, tells by how much: were they
independent, the mean of g_bᵀ A⁻¹ g_b over all of them would be tr(A⁻¹ A_b) - tr((A⁻¹ A_b)²), with the information A of
all and A_b of the block; the second part is what the fit has taken out of the residuals. So

    f² = Σ g_bᵀ A⁻¹ g_b / Σ (tr(A⁻¹ A_b) - tr((A⁻¹ A_b)²))

(the clustered covariance of Liang and Zeger 1986, corrected for leverage as by Bell and McCaffrey 2002, pooled over all
parameters). Blocks cut what correlates across their borders, a share in proportion to 1 / size of the block: f at
blocks of a size and of half of it is extrapolated to none. Errors that bend a whole view, as a wrong calibration does,
are not to be seen in this way.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slrig.model import FloatArray, IntArray
from slrig.views.matching import Matches, Terms, assembled, terms_of

_COARSE, _FINE = 2, 4
"""Blocks in the object's radius. Of eight views with errors of 4 µm that are alike over 2, 4 and 8 mm of an object of
35 mm, these leave 1.1, 1.3 and 2.2 of squared errors over stated ones; blocks of one size 1.2, 1.6 and 3.2."""


def inflation(
    matches: Mapping[tuple[int, int], Matches],
    count: int,
    middle_mm: FloatArray,
    radius_mm: float,
    covariance: FloatArray,
) -> float:
    """The factor f of standard deviations, at least 1. matches : of pairs of the `count` views, where they are placed.

    covariance : (p, p), the inverse of the information of all, in mm², 0 along directions that are held.
    """
    coarse, fine = (
        _at_blocks(matches, count, middle_mm, radius_mm, radius_mm / parts, covariance) for parts in (_COARSE, _FINE)
    )
    return max(2 * coarse - fine, coarse, 1.0)


def _at_blocks(
    matches: Mapping[tuple[int, int], Matches],
    count: int,
    middle_mm: FloatArray,
    radius_mm: float,
    size_mm: float,
    covariance: FloatArray,
) -> float:
    blocks = _by_block(matches, count, middle_mm, radius_mm, size_mm)
    found = np.einsum("bi,ij,bj->", blocks.gradient, covariance, blocks.gradient)
    share = covariance @ blocks.information
    expected = np.einsum("bii->", share) - np.einsum("bij,bji->", share, share)
    return float(np.sqrt(found / expected)) if expected > 0 else 1.0


def _by_block(
    matches: Mapping[tuple[int, int], Matches], count: int, middle_mm: FloatArray, radius_mm: float, size_mm: float
) -> Terms:
    """The terms of each cube of the model's space that matches lie in: all pairs together, whose errors are shared."""
    cubes = [np.floor((each.at_mm - middle_mm) / size_mm).astype(np.int32) for each in matches.values()]
    numbers = np.unique(np.concatenate(cubes), axis=0, return_inverse=True)[1].ravel().astype(np.int32)
    blocks: list[IntArray] = np.split(numbers, np.cumsum([len(each) for each in cubes])[:-1])
    number = int(numbers.max()) + 1
    return assembled(
        (
            (pair, terms_of(each, middle_mm, radius_mm, places=(mine, number)))
            for (pair, each), mine in zip(matches.items(), blocks, strict=True)
        ),
        count,
    )

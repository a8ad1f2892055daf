"""A projector's refresh, from the instants at which its patterns became visible.

A display changes at its refreshes only, so those instants lie on a grid. With f the grid's frequency all phases
2π f t agree: R = |Σ exp(2πi f t)|/n is near 1, for multiples of f too, and far below for other frequencies when the
patterns were asked for at random moments. The true one has the highest R: an error of the instants weighs more in its
multiples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LOWEST_HZ, HIGHEST_HZ = 22.0, 260.0

_AGREE = 0.8
_FINE = 16
_NEARLY = 0.97


def refresh_hz(t_visible_ns: Sequence[int]) -> float | None:
    """Return the refresh rate that 20 or more instants tell, None where they lie on no grid.

    >>> rng = np.random.default_rng(0)
    >>> on_a_grid = np.cumsum(rng.integers(1, 9, 40)) * 1e9 / 59.94
    >>> round(refresh_hz([round(t) for t in on_a_grid]), 2)
    59.94
    >>> refresh_hz([round(t) for t in np.cumsum(rng.uniform(0.01, 0.08, 40)) * 1e9]) is None
    True
    """
    t_s = (np.array(t_visible_ns, np.float64) - t_visible_ns[0]) / 1e9
    span_s = float(np.ptp(t_s))
    if span_s <= 0:
        return None
    frequencies = np.arange(LOWEST_HZ, HIGHEST_HZ, 1 / (_FINE * span_s))
    agreement = np.abs(np.exp(2j * np.pi * np.outer(frequencies, t_s)).mean(axis=1))
    highest = float(agreement.max())
    if highest < _AGREE:
        return None
    # Multiples agree as well where the instants are exact: the lowest of them is meant.
    first = int(np.argmax(agreement > _NEARLY * highest))
    near = slice(max(first - _FINE, 0), first + _FINE)
    top_hz = float(frequencies[near][np.argmax(agreement[near])])
    finer = np.linspace(top_hz - 1 / (_FINE * span_s), top_hz + 1 / (_FINE * span_s), 4 * _FINE + 1)
    return float(finer[np.argmax(np.abs(np.exp(2j * np.pi * np.outer(finer, t_s)).mean(axis=1)))])

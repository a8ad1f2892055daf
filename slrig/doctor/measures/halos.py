"""Halos beside edges: does the camera sharpen its pictures?

Light adds up, and lenses only spread it, so across an edge of a projected bar the picture rises from dark to bright
and never beyond either. Sharpening does go beyond: it subtracts a blurred copy, so the bright side of an edge gets
brighter than white and the dark side darker than black, some pixels beside the edge. With d the frame of a Gray bit
less that of its inverse, over white less black, d goes from −1 to 1 at an edge of bars that are wide enough; what it
exceeds the level farther away by is the overshoot. White less black takes the albedo out, and since it is compared with
the level of the same bar, neither stray light, which lowers d, nor a lamp that changed between frames adds to it. A
curve between light and grey levels changes no order of levels, so it makes no halo.

The median over many profiles across edges of both directions is taken: noise and print on the object cancel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray

_REACH_PX = 14
_LEVEL_FROM_PX = 9.0
_FINE = 4  # places per pixel
_FEWEST_PROFILES = 100
_MOST_PROFILES = 20_000


@dataclass(frozen=True, slots=True)
class Halo:
    """overshoot ± error : by how much pictures exceed the level beside an edge, a share of the step there; standard
    error. reach_px : how far from the edge the most of it lies. slope_per_px : of the edge, a share of the step per
    pixel. profiles : how many were looked at.
    """

    overshoot: float
    error: float
    reach_px: float
    slope_per_px: float
    profiles: int

    @property
    def shift_px(self) -> float:
        """How far it moves a stripe beside print that changes the brightness threefold, at the worst place, at least.

        A halo moves another edge of the same step by overshoot over slope. Beside print, where white less black has a
        halo of its own, computed images of one dimension (lens blur 0.7 to 1.2 px, unsharp masks of 1 to 3 px and 0.5
        to 1.5 times) have 1.8 to 4.9 times that.
        """
        return 1.8 * self.overshoot / self.slope_per_px


def halo(signals: Iterable[FloatArray], usable: NDArray[np.bool_]) -> Halo | None:
    """Return the halo of bars' edges; None where too few of them stand far enough from others.

    signals : (H, W) float64 each, d of the module of one bit; edges are looked for along rows and along columns.
    usable : (H, W) bool, pixels that are lit and not saturated.
    """
    found = [_profiles(turned, mask) for each in signals for turned, mask in ((each, usable), (each.T, usable.T))]
    profiles = np.concatenate([each for each in found if len(each)] or [np.zeros((0, 2 * _REACH_PX * _FINE + 1))])
    if len(profiles) < _FEWEST_PROFILES:
        return None
    profiles = profiles[np.random.default_rng(0).permutation(len(profiles))[:_MOST_PROFILES]]
    # What the two sides have in common is odd: a halo that is clipped on one side counts by half.
    middle = np.median(profiles, axis=0)
    rise = 0.5 * (middle - middle[::-1])
    along = np.linspace(-_REACH_PX, _REACH_PX, len(rise))
    far = along >= _LEVEL_FROM_PX
    level = float(rise[far].mean())
    near = (along > 0) & ~far
    top = int(np.argmax(np.where(near, rise, -np.inf)))
    # Of a median, were the profiles' noise normal.
    error = 1.25 * float(profiles[:, top].std()) / len(profiles) ** 0.5
    slope = float(np.gradient(rise, along)[len(rise) // 2])
    if level <= 0 or slope <= 0:
        return None
    overshoot = max(float(rise[top]) / level - 1, 0.0) / 2
    return Halo(overshoot, error / level / 2, float(along[top]), slope / level / 2, len(profiles))


def _profiles(signal: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    """(n, k) float64: the signal along rows around each place where it changes its sign, rising, once in its reach."""
    width = signal.shape[1]
    changed = (signal[:, :-1] * signal[:, 1:] < 0) & usable[:, :-1] & usable[:, 1:]
    rows, left = np.nonzero(changed)
    inside = (left >= _REACH_PX + 1) & (left < width - _REACH_PX - 2)
    rows, left = rows[inside], left[inside]
    if not len(rows):
        return np.zeros((0, 2 * _REACH_PX * _FINE + 1))
    window = left[:, None] + np.arange(-_REACH_PX - 1, _REACH_PX + 3)
    alone = usable[rows[:, None], window].all(axis=1) & (changed[rows[:, None], window[:, :-1]].sum(axis=1) == 1)
    rows, left, window = rows[alone], left[alone], window[alone]
    values = signal[rows[:, None], window]
    before, after = signal[rows, left], signal[rows, left + 1]
    part = before / (before - after)
    # Linear between pixels: it flattens a halo a little, and makes none.
    places = _REACH_PX + 1 + part[:, None] + np.linspace(-_REACH_PX, _REACH_PX, 2 * _REACH_PX * _FINE + 1)
    whole = np.clip(np.floor(places).astype(int), 0, values.shape[1] - 2)
    share = places - whole
    at = np.arange(len(values))[:, None]
    sampled = values[at, whole] * (1 - share) + values[at, whole + 1] * share
    return np.asarray(sampled * np.sign(after)[:, None], np.float64)

"""How often light swings, and how often a display refreshes.

Light that swings, found in the brightness of short exposures at uneven instants.

An exposure of e seconds passes a swing of f hertz by the factor sinc(f·e) = sin(π f e)/(π f e): long ones average it
out, whole periods cancel it. The spectrum is that of Lomb and Scargle with a floating mean (M. Zechmeister and
M. Kürster, A&A 496, 2009), which takes samples at any instants: uneven ones have no aliases. A camera that runs by
itself samples evenly, unless the rows of a rolling shutter tell the time between its frames; what it cannot tell apart
is said. Swings are taken out one by one, the strongest first.

A projector's refresh, from the instants at which its patterns became visible.

A display changes at its refreshes only, so those instants lie on a grid. With f the grid's frequency all phases
2π f t agree: R = |Σ exp(2πi f t)|/n is near 1, for multiples of f too, and far below for other frequencies when the
patterns were asked for at random moments. The true one has the highest R: an error of the instants weighs more in its
multiples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.model import FloatArray

_LOWEST_HZ, _HIGHEST_HZ = 20.0, 400.0
_REFRESHES_HZ = (22.0, 260.0)
_AGREE = 0.8
_FINER = 16
_NEARLY = 0.97
_MOST_SWINGS = 4
_CHANCE = 1e-6
_FINE = 5
_ALIAS = 0.9
_FEWEST = 16
_LEAST_PASSED = 0.1


@dataclass(frozen=True, slots=True)
class Swing:
    """Light that swings. amplitude : from mean to peak, in the unit of the samples, before any exposure averaged it.

    power : share of what the samples vary by that it explains. aliases_hz : frequencies that explain them as well.
    """

    frequency_hz: float
    amplitude: float
    power: float
    aliases_hz: tuple[float, ...] = ()


def passed(frequency_hz: float, exposure_s: float) -> float:
    """How much of a swing is left in an exposure, 0 to 1.

    >>> round(passed(100.0, 0.01), 6), round(passed(100.0, 0.005), 4)
    (0.0, 0.6366)
    """
    return abs(float(np.sinc(frequency_hz * exposure_s)))


def swings(t_s: FloatArray, samples: FloatArray, *, exposure_s: float) -> tuple[Swing, ...]:
    """Return the swings that samples of light show beyond doubt, the strongest first.

    t_s : (n,) float64, the middle of each sample's exposure, which is `exposure_s` long. samples : (n,) float64,
    brightness; 16 or more are needed to find anything.
    """
    # Half a second to import: whoever measures no flicker is spared it.
    from scipy.signal import lombscargle

    if len(t_s) < _FEWEST:
        return ()
    span_s = float(np.ptp(t_s))
    frequencies = np.arange(_LOWEST_HZ, _HIGHEST_HZ, 1 / (_FINE * span_s))
    rest, found = samples - samples.mean(), []
    for _ in range(_MOST_SWINGS):
        if not np.ptp(rest) > 0:
            break
        power = np.nan_to_num(lombscargle(t_s, rest, 2 * np.pi * frequencies, normalize=True, floating_mean=True))
        top = int(np.argmax(power))
        if _by_chance(float(power[top]), len(t_s), span_s) > _CHANCE:
            break
        refined_hz = _refined(t_s, rest, float(frequencies[top]), span_s)
        found.append((refined_hz, float(power[top]), _aliases(frequencies, power, top, span_s)))
        rest = samples - _fitted(t_s, samples, [frequency for frequency, _, _ in found])[0]
    _, amplitudes = _fitted(t_s, samples, [frequency for frequency, _, _ in found])
    return tuple(
        Swing(frequency, amplitude / max(passed(frequency, exposure_s), _LEAST_PASSED), power, aliases)
        for (frequency, power, aliases), amplitude in zip(found, amplitudes, strict=True)
    )


def _refined(t_s: FloatArray, samples: FloatArray, frequency_hz: float, span_s: float) -> float:
    """The top of a peak: a sine that is off by a fraction of its width would leave a part of itself behind."""
    from scipy.optimize import minimize_scalar

    def left(candidate_hz: float) -> float:
        return float(np.sum((samples - _fitted(t_s, samples, [candidate_hz])[0]) ** 2))

    half_hz = 1 / (_FINE * span_s)
    limits = (frequency_hz - half_hz, frequency_hz + half_hz)
    return float(minimize_scalar(left, bounds=limits, method="bounded", options={"xatol": half_hz / 1000}).x)


def _by_chance(power: float, samples: int, span_s: float) -> float:
    """How likely noise alone gives such a peak somewhere in the spectrum."""
    independent = span_s * (_HIGHEST_HZ - _LOWEST_HZ)
    return independent * math.exp(0.5 * (samples - 3) * math.log(max(1 - power, 1e-300)))


def _aliases(frequencies: FloatArray, power: FloatArray, top: int, span_s: float) -> tuple[float, ...]:
    """Other peaks that are hardly lower."""
    inner = power[1:-1]
    peak = (inner >= power[:-2]) & (inner >= power[2:]) & (inner > _ALIAS * power[top])
    at = frequencies[1:-1][peak]
    return tuple(float(each) for each in at[np.abs(at - frequencies[top]) > 2 / span_s])


def _fitted(t_s: FloatArray, samples: FloatArray, frequencies: list[float]) -> tuple[FloatArray, list[float]]:
    """Least squares by a constant and one sine per frequency: (n,) values, and the amplitudes."""
    turns = [2 * np.pi * frequency * t_s for frequency in frequencies]
    base = np.column_stack([np.ones_like(t_s), *(wave(turn) for turn in turns for wave in (np.cos, np.sin))])
    weights = np.linalg.lstsq(base, samples, rcond=None)[0]
    amplitudes = [float(np.hypot(*weights[1 + 2 * i : 3 + 2 * i])) for i in range(len(frequencies))]
    return np.asarray(base @ weights, np.float64), amplitudes


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
    frequencies = np.arange(*_REFRESHES_HZ, 1 / (_FINER * span_s))
    agreement = np.abs(np.exp(2j * np.pi * np.outer(frequencies, t_s)).mean(axis=1))
    highest = float(agreement.max())
    if highest < _AGREE:
        return None
    # Multiples agree as well where the instants are exact: the lowest of them is meant.
    first = int(np.argmax(agreement > _NEARLY * highest))
    near = slice(max(first - _FINER, 0), first + _FINER)
    top_hz = float(frequencies[near][np.argmax(agreement[near])])
    finer = np.linspace(top_hz - 1 / (_FINER * span_s), top_hz + 1 / (_FINER * span_s), 4 * _FINER + 1)
    return float(finer[np.argmax(np.abs(np.exp(2j * np.pi * np.outer(finer, t_s)).mean(axis=1)))])

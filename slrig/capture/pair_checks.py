"""What sampled pixels say about a bit and its inverse, and about frames of patterns as fine as one another.

Vectors as in `slrig.capture.checks`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slrig.capture.checks import (
    BAND_SAMPLES,
    BANDS,
    Chosen,
    Reference,
    Samples,
    contrast_words,
    noise_dn,
    rows_of,
    worst_judged,
)

_EDGE_PX = 8.0
"""Breadth of an edge that a scaler blurred, projector pixels: from end to end of a Gaussian of 2 px, ± 2 deviations."""

_EVEN = 0.08
"""Spread of what an even change of light leaves, by noise: damage and other patterns leave light and dark."""

_ROUGHER, _ROUGH = 1.25, 0.15
"""Bytes that are anything differ from pixel to pixel by a third of the full scale on average. A projector that was
found to dither differed by 0.18 of white where all was lit."""

_NOISE_ROUGHNESS = 1.5
"""Two samples of normal noise differ by 1.13 of its standard deviation on average."""

_STEEPEST_GAMMA = 2.4
"""Of displays: ITU-R BT.1886."""


def pair_fault(bit: Samples, inverse: Samples, ref: Reference, *, noise: float, run_px: int) -> str | None:
    """Light is additive: a bit and its inverse add up to white and black.

    Limits leave room for noise; for a camera that is not linear, whose blurred edges add up to more than white; and for
    a projector behind a scaler. That blurs the pattern's values before gamma makes light of them, and then both frames
    are dark at an edge. There a pair may fall short by as much as its own swing explains (`_least_sum`). How much of
    the image lies at edges follows from run_px, the length of the bit's runs of equal pixels in the projector.
    """
    u, v = ref.relative(bit), ref.relative(inverse)
    excess = u + v - 1
    slack = np.clip(8 * max(noise, noise_dn(bit, inverse, ref)) / ref.contrast[ref.judged], 0.2, 0.5)
    above = excess > 0.8
    at_edges = min(1.0, _EDGE_PX / run_px)
    dark = _in_dark_bands(u, v, ref)
    for one, other in ((bit, inverse), (inverse, bit)):
        rough = rougher(one, [other], ref, noise=noise)
        if rough is not None:
            return rough
    worst = worst_judged(above | dark | (u + v < _least_sum(np.abs(u - v)) - slack), ref, whole=0.1)
    if worst is None and at_edges < 1.0:
        wrong = above | (excess < -slack)
        worst = worst_judged(wrong, ref, whole=0.1 + at_edges, quarter=0.25 + at_edges)
    if worst is None:
        return None
    apart = float(np.median(np.abs((bit - inverse)[ref.judged]) / ref.contrast[ref.judged]))
    if apart < 0.25:
        return f"the frame and its inverse show the same on {worst}: one of them is stale; scan again"
    together = float(np.median(u + v))
    if float(np.median(np.abs(u + v - together))) < _EVEN * together:
        return (
            f"the frame and its inverse have {together:.0%} of the light of white and black, evenly on all of the "
            "image: the exposure or the lamp changed since: switch off automatic exposure and gain, dynamic contrast "
            "and power saving, and scan again"
        )
    return (
        f"the frame and its inverse do not add up to white and black on {worst}: one of them shows another pattern or "
        f"was damaged, or something moved, or {contrast_words(ref)}; scan again"
    )


def _in_dark_bands(u: Samples, v: Samples, ref: Reference) -> Chosen:
    """Which pixels lie in bands where one frame of a pair has hardly any light and the other does not make up for it.

    What a scaler takes from the edges it takes from both.
    """
    band = ref.band[ref.judged]
    counts = np.bincount(band, minlength=BANDS)
    means = np.stack([np.bincount(band, weights=each, minlength=BANDS) for each in (u, v)]) / np.maximum(counts, 1)
    dark = (means.sum(axis=0) < 0.8) & (means.min(axis=0) < 0.3 * means.max(axis=0))
    return np.asarray(dark[band], dtype=np.bool_)


_SIGNAL = np.linspace(0.5, 1.0, 257)
_SWING = _SIGNAL**_STEEPEST_GAMMA - (1 - _SIGNAL) ** _STEEPEST_GAMMA
_SUM = _SIGNAL**_STEEPEST_GAMMA + (1 - _SIGNAL) ** _STEEPEST_GAMMA


def _least_sum(swing: Samples) -> Samples:
    """What a bit and its inverse add up to, at least, where they differ by `swing`; all on the scale of `u`.

    A blurred bit has the value s where its inverse has 1 - s: they differ by s^g - (1 - s)^g and add up to
    s^g + (1 - s)^g, least for the steepest gamma g.
    """
    return np.asarray(np.interp(swing, _SWING, _SUM), dtype=np.float32)


def rougher(frame: Samples, others: Sequence[Samples], ref: Reference, *, noise: float) -> str | None:
    """Words for a band in which a frame is rougher than frames of patterns as fine as its own: it was damaged there.

    Roughness is the mean difference of pixels that lie beside each other. A bit and its inverse have the same, and so
    have line frames among themselves, whatever camera and projector make of light. What is lit may be rougher than what
    is dark: by its noise, and where white itself was not shown evenly.
    """
    here, light = _roughness(frame, ref)
    usual = np.median([_roughness(each, ref)[0] for each in others], axis=0)
    hidden = _NOISE_ROUGHNESS * noise / float(np.median(ref.contrast[ref.judged]))
    over = here - _ROUGHER * usual - _ROUGH * (1 + np.clip(light, 0, 1)) - hidden
    worst = int(np.nanargmax(np.append(over, 0.0)))
    if worst == BANDS:
        return None
    return (
        f"in {rows_of(ref, worst)} pixels beside each other differ by {here[worst]:.0%} of white, and by "
        f"{usual[worst]:.0%} in frames of patterns as fine: the frame was damaged in transfer; check the cable, and "
        "scan again"
    )


def _roughness(frame: Samples, ref: Reference) -> tuple[Samples, Samples]:
    """(BANDS,) float32 each: the mean difference of pixels beside each other, and the mean light, NaN where few are
    judged.
    """
    light, beside = ((frame - ref.black) / ref.contrast).reshape(2, -1)
    both = ref.judged.reshape(2, -1).all(axis=0)
    band = ref.band.reshape(2, -1)[0][both]
    counts = np.bincount(band, minlength=BANDS).astype(np.float32)
    counts[counts < BAND_SAMPLES // 8] = np.nan
    rough, mean = (
        np.bincount(band, weights=each[both], minlength=BANDS) / counts
        for each in (np.abs(light - beside), (light + beside) / 2)
    )
    return rough.astype(np.float32), mean.astype(np.float32)

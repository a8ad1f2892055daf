"""Test pictures under white and black light at a few exposures, and the exposures that they propose for a scan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from statistics import geometric_mean, median

import numpy as np
from numpy.typing import NDArray

from slrig.capture import (
    MIN_CONTRAST_DN,
    MIN_CONTRAST_TO_NOISE,
    NEAR_SATURATION,
    Evidence,
    SampleMask,
    Sampler,
    Samples,
    round_to_refresh_s,
)
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Rig
from slrig.errors import ConfigError, RigBusyError, UnsupportedByDeviceError
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder
from slrig.model import Black, NoiseModel, Shot, White, fit_noise
from slrig.patterns import encode
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan, rig_sequence

DECODED_CLEAR = 7.0
"""Noises that white lies above black where a pixel is decoded. On dark and mixed rendered reliefs, at nine exposures,
the share of pixels beyond it and that of the surface that the mesh covers to 0.3 mm differ by 0.08 at most.
"""
WELL_CLEAR = 2 * MIN_CONTRAST_TO_NOISE
"""Noises where an exposure covers well: twice what one of a bracket has to show to count."""

_MOST_EXPOSURES = 4  # six are allowed; of what is measured here more than four gained nothing
_LEAST_STEP = 1.1  # as a bracket has it
_ENOUGH_COMPLETE = 0.01  # of the lit pixels that may be given up for time,
_ENOUGH_WELL = 0.02  # and of the way to covering all of them well
_WORTH_A_WORD = _ENOUGH_COMPLETE
_FAINT = 0.025
"""Of the middle lit pixel: less is glow, which carries no pattern; rubber beside white paper is twice that."""
_MEDIAN_OF_SQUARE = 0.4549  # of a normal deviate, over its variance


@dataclass(frozen=True, slots=True)
class Look:
    """Two frames of white and two of black at one exposure: (2, n) float32 each, DN, at the pixels of a `Sampler`."""

    exposure_s: float
    white: Samples
    black: Samples


@dataclass(frozen=True, slots=True)
class SeenObject:
    """What one camera saw in its looks, from short to long.

    noise : of single frames. dark_dn : the value without light. lit : (n,) bool, pixels that some look shows lit.
    """

    looks: tuple[Look, ...]
    full_scale: int
    noise: NoiseModel
    dark_dn: float
    lit: SampleMask

    def at(self, exposure_s: float) -> tuple[Samples, Samples, SampleMask]:
        """White and black (n,) as they would be at an exposure, and which pixels white saturates."""
        shape = self.lit.shape
        white, black, known = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        # The nearest look that is not saturated knows best.
        for look in sorted(self.looks, key=lambda look: abs(math.log(exposure_s / look.exposure_s))):
            use = ~known & (look.white.max(axis=0) < NEAR_SATURATION * self.full_scale)
            gain = np.float32(exposure_s / look.exposure_s)
            for seen, frames in ((white, look.white), (black, look.black)):
                seen[use] = self.dark_dn + gain * (frames.mean(axis=0)[use] - self.dark_dn)
            known |= use
        return white, black, ~known | (white >= NEAR_SATURATION * self.full_scale)

    def clearness(self, exposure_s: float) -> tuple[NDArray[np.float32], SampleMask]:
        """(n,) how many of its own noises white lies above black at an exposure, 0 where it is saturated or rounding
        hides it; and which pixels are saturated.
        """
        white, black, saturated = self.at(exposure_s)
        contrast = white - black
        clear = contrast / np.sqrt(self.noise.variance(white) + self.noise.variance(black))
        return np.where(saturated | (contrast < MIN_CONTRAST_DN), np.float32(0), clear), saturated


def seen_object(looks: Sequence[Look], full_scale: int) -> SeenObject:
    """Sum up the looks of one camera, one at least, in any order."""
    rising = tuple(sorted(looks, key=lambda look: look.exposure_s))
    noise = fit_noise(_noise_samples(look, full_scale) for look in rising)
    shape, full = rising[0].white.shape[1], NEAR_SATURATION * full_scale
    # DN per second; of what every look saturates so much is known.
    lit, rate = np.zeros(shape, np.bool_), np.full(shape, full / rising[0].exposure_s)
    for look in rising:
        white, black = look.white.mean(axis=0), look.black.mean(axis=0)
        # Two of each were taken.
        spread = np.sqrt((noise.variance(white) + noise.variance(black)) / 2)
        lit |= (white - black > np.maximum(MIN_CONTRAST_DN, 6 * spread)) | ((white >= full) & (black < full))
        np.divide(white - black, look.exposure_s, out=rate, where=white < full)
    if lit.any():
        lit &= rate >= _FAINT * np.median(rate[lit])
    return SeenObject(rising, full_scale, noise, _dark_dn(rising, full_scale), lit)


def _noise_samples(look: Look, full_scale: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Levels and variances of single samples, as `fit_noise` wants them: from what differs in two frames alike. The
    level is that of the pixel beside it (`Sampler`): its own, of whole numbers, tells whether the two frames differ.
    """
    levels, variances = [], []
    for first, second in (look.white, look.black):
        level = (first + second) / 2
        beside = np.roll(level, len(level) // 2)
        inside = (np.minimum(first, second) > 0) & (np.maximum(level, beside) < NEAR_SATURATION * full_scale)
        # Whole numbers have a coarse median; spread over the interval that each stands for, they have a fine one.
        change = (first - second)[inside]
        change += np.random.default_rng(0).uniform(-0.5, 0.5, len(change)).astype(np.float32)
        levels.append(beside[inside])
        variances.append(np.maximum(change**2 / (2 * _MEDIAN_OF_SQUARE) - np.float32(1 / 24), 0))
    return np.concatenate(levels), np.concatenate(variances)


def _dark_dn(rising: Sequence[Look], full_scale: int) -> float:
    """The value without light: where the black frames of two exposures lead at none. 0 where one look was taken."""
    if len(rising) < 2:
        return 0.0
    short, long = rising[0], rising[-1]
    inside = long.black.max(axis=0) < NEAR_SATURATION * full_scale
    if not inside.any():
        return 0.0
    slope = (long.black - short.black).mean(axis=0)[inside] / (long.exposure_s - short.exposure_s)
    return max(float(np.median(short.black.mean(axis=0)[inside] - slope * short.exposure_s)), 0.0)


@dataclass(frozen=True, slots=True)
class ExposureCover:
    """What one exposure does for the lit pixels, as shares of them: white is well clear of black; clear enough to be
    decoded; too dark for that; saturated.
    """

    exposure_s: float
    well: float
    decoded: float
    too_dark: float
    saturated: float


@dataclass(frozen=True, slots=True)
class Proposal:
    """Exposures for an object, and what they would come to.

    exposures : those proposed, from short to long; others : the rest of what was considered. completeness : share of
    the lit pixels that one of them at least decodes; well : the same for well. too_dark, saturated : what remains of
    them, at the longest and at the shortest. lit : share of the cameras' pixels. seconds : of capture.
    """

    exposures: tuple[ExposureCover, ...]
    others: tuple[ExposureCover, ...]
    completeness: float
    well: float
    too_dark: float
    saturated: float
    lit: float
    seconds: float

    @property
    def notes(self) -> list[str]:
        """What remains uncovered and why, one sentence each."""
        notes = []
        if self.saturated > _WORTH_A_WORD:
            notes.append(
                f"{self.saturated:.1%} of what is lit is saturated even at {self.exposures[0].exposure_s:.4g} s: "
                "turn the object so that it does not mirror the projector, or dull it"
            )
        if self.too_dark > _WORTH_A_WORD:
            notes.append(
                f"{self.too_dark:.1%} of what is lit is too dark even at {self.exposures[-1].exposure_s:.4g} s: allow "
                "more time if there is a budget, open the aperture, or raise the gain"
            )
        if self.well < self.completeness - 0.1:
            notes.append(
                f"{self.well:.0%} of what is lit stands out well; elsewhere noise is felt. Longer exposures measure it "
                "better"
            )
        return notes


def proposal(
    seen: Mapping[str, SeenObject],
    candidates_s: Sequence[float],
    *,
    frames: int,
    overhead_s: float,
    budget_s: float | None = None,
) -> Proposal:
    """Choose one to four exposures for all cameras: within the budget those that leave least undecoded, of these those
    that come nearest to covering all of it well, and of these the fastest; a hundredth, and two, may be given up.

    frames : of a sequence at one exposure; each takes the exposure and overhead_s. budget_s : the most that all may
    take; None for as long as it takes.

    Raises
    ------
    ConfigError
        The budget is too small for any, or nothing is lit.
    """
    lit = np.concatenate([each.lit for each in seen.values()])
    if not lit.any():
        message = (
            f"exposure: at {_times(candidates_s)} the cameras see nothing that the projector lights; see that the lamp "
            "is on, the lens caps are off, and the cameras look at what the projector lights. slrig doctor tells more"
        )
        raise ConfigError(message)
    rising_s = sorted(candidates_s)
    clear, saturated = (
        np.array([np.concatenate(each)[lit] for each in parts])
        for parts in zip(
            *(zip(*(camera.clearness(each) for camera in seen.values()), strict=True) for each in rising_s), strict=True
        )
    )
    seconds = [frames * (each + overhead_s) for each in rising_s]
    decoded, well = clear >= DECODED_CLEAR, clear >= WELL_CLEAR
    # More than well is not asked for, and towards it everything helps.
    towards = np.minimum(clear / np.float32(WELL_CLEAR), 1)
    sets = [
        (chosen, float(decoded[chosen, :].any(axis=0).mean()), float(towards[chosen, :].max(axis=0).mean()), total)
        for count in range(1, _MOST_EXPOSURES + 1)
        for chosen in map(list, combinations(range(len(rising_s)), count))
        if (total := sum(seconds[index] for index in chosen)) <= (math.inf if budget_s is None else budget_s)
        and all(rising_s[b] >= _LEAST_STEP * rising_s[a] for a, b in pairwise(chosen))
    ]
    if not sets:
        message = (
            f"budget_s: found {budget_s:g} s; the shortest exposure that was considered, {rising_s[0]:.4g} s, takes "
            f"{seconds[0]:.3g} s of {frames} frames. Allow more time, or ask for fewer patterns"
        )
        raise ConfigError(message)
    sets = [each for each in sets if each[1] >= max(other[1] for other in sets) - _ENOUGH_COMPLETE]
    sets = [each for each in sets if each[2] >= max(other[2] for other in sets) - _ENOUGH_WELL]
    chosen, completeness, _, total = min(sets, key=lambda each: each[3])
    left = ~decoded[chosen, :].any(axis=0)
    covers = [
        ExposureCover(
            each, float(well[i].mean()), float(decoded[i].mean()),
            float((~decoded[i] & ~saturated[i]).mean()), float(saturated[i].mean()),
        )
        for i, each in enumerate(rising_s)
    ]  # fmt: skip
    return Proposal(
        exposures=tuple(covers[i] for i in chosen),
        others=tuple(cover for i, cover in enumerate(covers) if i not in chosen),
        completeness=completeness,
        well=float(well[chosen, :].any(axis=0).mean()),
        too_dark=float((left & ~saturated[chosen[-1]]).mean()),
        saturated=float((left & saturated[chosen[0]]).mean()),
        lit=float(lit.mean()),
        seconds=total,
    )


def _times(exposures_s: Sequence[float]) -> str:
    return ", ".join(f"{each:.3g} s" for each in sorted(exposures_s))


LONGEST_S = 1.0
"""No look exposes longer; a scan of thirty frames would take half a minute."""

_STEP = 4.0  # from look to look: two exposures so far apart share two thirds of the range of 8 bits
_SOME = 0.002  # of the lit pixels: less is a highlight or two
_PATTERNS = (White(), Black(), White(), Black())


class _Unjudged(Evidence):
    """Takes frames as they are: at an exposure that is far off, white and black prove nothing, and tell what to try."""

    def add_shot(self, shot: Shot) -> tuple[()]:  # noqa: ARG002 - as it is called
        return ()


class Looking:
    """Looks through all cameras of an open rig. overheads_s : what a frame takes beside its exposure, of each look."""

    def __init__(self, rig: Rig, listener: Listener = SILENT) -> None:
        self._rig = rig
        self._listener = listener
        self._samplers = {name: Sampler.from_size(camera.info.format.size) for name, camera in rig.cameras.items()}
        self._looks: dict[float, Mapping[str, Look]] = {}
        self._refused_shorter = False
        self.overheads_s: list[float] = []

    def seen(self) -> Mapping[str, SeenObject]:
        """What each camera has seen so far."""
        return {
            name: seen_object([look[name] for look in self._looks.values()], camera.info.format.full_scale)
            for name, camera in self._rig.cameras.items()
        }

    def look(self) -> None:
        """Look at the rig's own exposure, at shorter ones while something is saturated, and at longer ones while
        something is not clear.
        """
        own_s = self._fitting(geometric_mean(each.exposure_s for each in self._rig.settings.values()))
        self._take(own_s)
        for step, wanted in ((1 / _STEP, _saturated), (_STEP, _unclear)):
            exposure_s = own_s
            while wanted(self.seen(), exposure_s):
                next_s = self._fitting(exposure_s * step)
                if next_s in self._looks:
                    break
                try:
                    self._take(next_s)
                except UnsupportedByDeviceError:
                    # Between two that it can use, or beyond what the projector can.
                    self._refused_shorter |= step < 1
                    break
                exposure_s = next_s

    def candidates_s(self) -> list[float]:
        """The exposures that were looked at, those in the middle between them, and one shorter by half a step, for
        little time. None is longer than what was looked at, nor shorter where that was refused: a projector may not do
        it, and only a look tells.
        """
        around = (each * factor for each in self._looks for factor in (_STEP**-0.5, 1.0, _STEP**0.5))
        least_s = min(self._looks) if self._refused_shorter else 0.0
        rising = sorted(each for each in set(map(self._fitting, around)) if least_s <= each <= max(self._looks))
        return [each for before, each in pairwise([0.0, *rising]) if each > 1.05 * before]

    def _fitting(self, exposure_s: float) -> float:
        """The nearest exposure that all cameras can do and the projector's light is steady over."""
        ranges_s = [camera.info.exposure_range_s for camera in self._rig.cameras.values()]
        least_s, most_s = max(low for low, _ in ranges_s), min(LONGEST_S, *(high for _, high in ranges_s))
        within_s = min(max(exposure_s, least_s), most_s)
        return round_to_refresh_s(within_s, self._rig.projector.info.refresh_s, ranges_s)

    def _take(self, exposure_s: float) -> None:
        rig, size = self._rig, self._rig.projector.info.size
        settings = {
            name: replace(rig.settings.get(name, CameraSettings(exposure_s)), exposure_s=exposure_s)
            for name in rig.cameras
        }
        unjudged = _Unjudged(_PATTERNS, {name: camera.info.format for name, camera in rig.cameras.items()})
        shots = {
            (shot.pattern, shot.camera): shot
            for shot in capture(
                replace(rig, settings=settings),
                encode(_PATTERNS, size),
                cancelled=self._listener.cancelled,
                evidence=unjudged,
            )
        }
        taken = {}
        for name, sampler in self._samplers.items():
            white, black = (
                np.array([sampler.take(shots[index, name].image) for index in pair]) for pair in ((0, 2), (1, 3))
            )
            taken[name] = Look(exposure_s, white, black)
            times_s = [time_s for i in range(4) if (time_s := shots[i, name].time_s) is not None]
            self.overheads_s += [max(after - before - exposure_s, 0.0) for before, after in pairwise(times_s)]
        self._looks[exposure_s] = taken


def _saturated(seen: Mapping[str, SeenObject], exposure_s: float) -> bool:
    return any(
        float(each.clearness(exposure_s)[1][each.lit].mean()) > _SOME for each in seen.values() if each.lit.any()
    )


def _unclear(seen: Mapping[str, SeenObject], exposure_s: float) -> bool:
    """Whether a camera sees little at this exposure, or not all of it well, although it is not all saturated."""
    for each in seen.values():
        clear, saturated = each.clearness(exposure_s)
        if not each.lit.any() or float(np.mean(each.lit & ~saturated & (clear < WELL_CLEAR))) > _SOME:
            return True
    return False


def proposed_exposures(manager: JobManager, plan: ScanPlan, *, budget_s: float | None) -> Proposal:
    """Take the rig for some seconds, look, and propose exposures for a scan of a plan's patterns.

    Raises
    ------
    RigBusyError
        Somebody has the rig: it is looked at at once, or not at all.
    ConfigError
        See `proposal`.
    DeviceError, ScanInterruptedError
        As a scan does.
    """

    def look(held: RigSession, listener: Listener) -> tuple[Looking, int]:
        rig = held.open()
        frames = len(rig_sequence(plan, rig))
        looking = Looking(rig, listener)
        looking.look()
        return looking, frames

    try:
        looking, frames = manager.lend(Holder("exposure", "a look at exposures, which takes seconds", None), look)
    except RigBusyError as error:
        message = (
            f"The rig is held by {error.holder} since {error.since}, and an object is looked at at once or not at all. "
            "Ask again when the rig is free"
        )
        raise RigBusyError(message, holder=error.holder, since=error.since) from error
    # The rig is free again.
    return proposal(
        looking.seen(), looking.candidates_s(), frames=frames, overhead_s=median(looking.overheads_s),
        budget_s=budget_s,
    )  # fmt: skip

"""Good, watch or stale: what several verifications of a rig since its calibration say together.

One verification may be bad luck: a lamp was switched on, someone leaned on the table. So the trend is judged, the
median of the last three verifications; but a verification that is far beyond chance counts at once
(`Thresholds.jump_evidence`): a device that was knocked stays knocked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import stdtr

from slrig.calibration.health.devices import device_words
from slrig.calibration.health.verification import PairFigures, Verification


class HealthState(StrEnum):
    """What a rig's calibration is."""

    UNKNOWN = "unknown"
    GOOD = "good"
    WATCH = "watch"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class Thresholds:
    """From where on a rig is to be watched, and from where its calibration is stale.

    mean : of a pair's spare equation, px. rms_ratio : of its rms over that after the calibration. error_ratio : of the
    expected error over the stated one, of a change with watch_evidence. sure_error_ratio : from which it is stale if
    the change is certain too, by sure_sigmas. watch_evidence : of a change that is too small to matter yet (6 is 20
    times likelier than none). trend_chance : below which the measured size of the board, or a pair's mean, has not
    crept by chance since the first verifications. jump_evidence : of one verification that counts at once (100 is 10
    σ), jump_mean_sigmas the same of a pair's mean.
    """

    watch_mean_px: float = 0.1
    stale_mean_px: float = 0.3
    watch_rms_ratio: float = 2.0
    stale_rms_ratio: float = 4.0
    watch_error_ratio: float = 1.4
    stale_error_ratio: float = 3.0
    sure_error_ratio: float = 2.0
    sure_sigmas: float = 4.5
    watch_evidence: float = 6.0
    trend_chance: float = 4e-4
    jump_evidence: float = 100.0
    jump_mean_sigmas: float = 10.0


THRESHOLDS = Thresholds()
_TREND = 3
_CHANCE = 4.0
_AVERAGED = 8  # verifications at the beginning, and at the end, that a trend is judged by
_FEWEST_AVERAGED = 4
_CREPT_PX = 0.02


@dataclass(frozen=True, slots=True)
class Health:
    """The verdict: the state, and why, in words; what to do about it, None where nothing need be."""

    state: HealthState
    reasons: tuple[str, ...]
    remedy: str | None = None


def judged(verifications: Sequence[Verification], /, *, thresholds: Thresholds = THRESHOLDS) -> Health:
    """Judge a rig by every verification since its calibration, oldest first."""
    if not verifications:
        return Health(
            HealthState.UNKNOWN, ("nothing was verified since the calibration",), "shoot a verification of the board"
        )
    latest = verifications[-1]
    told: list[tuple[HealthState, str]] = []
    told += _of_error(verifications, thresholds)
    told += _of_means(verifications, thresholds)
    told += _of_rms(verifications, thresholds)
    told += _of_change(verifications, thresholds)
    told += _of_trend(verifications, thresholds)
    state = HealthState.GOOD
    for found, _ in told:
        state = found if found is HealthState.STALE or state is HealthState.GOOD else state
    reasons = tuple(words for found, words in sorted(told, key=lambda each: each[0] is not HealthState.STALE))
    if state is HealthState.GOOD:
        return Health(state, (_good_words(latest),))
    measured = [verification for verification in verifications if verification.kind == "board"]
    named = measured[-1] if measured else latest
    if named.drifts:
        reasons = (*reasons, named.drifts[0].words, *([named.open] if named.open else []))
    reasons = (*reasons, *_unseen_words(named))
    if state is HealthState.STALE:
        remedy = named.remedy or "shoot a verification of the board to learn which device changed, and calibrate again"
    else:
        remedy = "verify again soon; calibrate again before it gets worse"
    return Health(state, reasons, remedy)


def _of_error(verifications: Sequence[Verification], at: Thresholds) -> list[tuple[HealthState, str]]:
    known = [
        verification
        for verification in verifications
        if verification.expected_mm is not None and verification.stated_mm
    ]
    if not known:
        return []
    ratio, jumped = _trend(known, _error_ratio, lambda verification: verification.evidence > at.jump_evidence)
    evidence = (
        known[-1].evidence if jumped else float(np.median([verification.evidence for verification in known[-_TREND:]]))
    )
    sigmas = (
        known[-1].significance
        if jumped
        else float(np.median([verification.significance for verification in known[-_TREND:]]))
    )
    now, stated = known[-1].expected_mm, known[-1].stated_mm
    words = f"scans are now expected to be wrong by {now:.3g} mm, {ratio:.1f} times the {stated:.3g} mm that is stated"
    sure = sigmas > at.sure_sigmas
    likely = evidence > at.watch_evidence
    if (ratio > at.stale_error_ratio and likely) or (ratio > at.sure_error_ratio and sure):
        return [(HealthState.STALE, words)]
    # A ratio alone may come of explanations none of which is likelier than that nothing changed.
    changed = evidence > 0 or ratio > at.sure_error_ratio
    return [(HealthState.WATCH, words)] if ratio > at.watch_error_ratio and changed else []


def _of_means(verifications: Sequence[Verification], at: Thresholds) -> list[tuple[HealthState, str]]:
    told = []
    for first, second in _pairs(verifications):
        known = [verification for verification in verifications if _pair(verification, first, second) is not None]

        def mean(verification: Verification, first: str = first, second: str = second) -> float:
            found = _pair(verification, first, second)
            return abs(found.mean_px) if found is not None else 0.0

        def jump(verification: Verification, first: str = first, second: str = second) -> bool:
            found = _pair(verification, first, second)
            return found is not None and abs(found.mean_px) > at.jump_mean_sigmas * found.mean_sigma_px

        value, _ = _trend(known, mean, jump)
        last = _pair(known[-1], first, second)
        sigma = 0.0 if last is None else last.mean_sigma_px
        if value > max(at.watch_mean_px, _CHANCE * sigma):
            state = HealthState.STALE if value > at.stale_mean_px else HealthState.WATCH
            told.append((state, f"'{first}' and '{second}' disagree by {value:.2f} px in the mean, expected about 0"))
    return told


def _of_rms(verifications: Sequence[Verification], at: Thresholds) -> list[tuple[HealthState, str]]:
    told = []
    for first, second in _pairs(verifications):
        found = [pair for verification in verifications if (pair := _pair(verification, first, second)) is not None]
        after = max(found[0].predicted_px, min(pair.rms_px for pair in found[:_TREND]))
        value = float(np.median([pair.rms_px for pair in found[-_TREND:]]))
        if value > at.watch_rms_ratio * after:
            state = HealthState.STALE if value > at.stale_rms_ratio * after else HealthState.WATCH
            words = f"'{first}' and '{second}' disagree by {value:.2f} px rms, {after:.2f} px after the calibration"
            told.append((state, words))
    return told


def _of_change(verifications: Sequence[Verification], at: Thresholds) -> list[tuple[HealthState, str]]:
    board = [verification for verification in verifications if verification.kind == "board"][-_TREND:]
    if len(board) < _TREND or float(np.median([verification.evidence for verification in board])) < at.watch_evidence:
        return []
    return [(HealthState.WATCH, "the last verifications agree that a device changed")]


def _of_trend(verifications: Sequence[Verification], at: Thresholds) -> list[tuple[HealthState, str]]:
    told = []
    sizes = [verification.scale_percent for verification in verifications if verification.scale_percent is not None]
    crept, chance = _crept(sizes)
    if chance < at.trend_chance:
        words = (
            f"the board's measured size has crept by {crept:+.3f} % since the first verifications, and not by chance"
        )
        told.append((HealthState.WATCH, words))
    for first, second in _pairs(verifications):
        means = [
            pair.mean_px for verification in verifications if (pair := _pair(verification, first, second)) is not None
        ]
        crept, chance = _crept(means)
        if chance < at.trend_chance and abs(crept) > _CREPT_PX:
            words = (
                f"'{first}' and '{second}' have crept apart by {crept:+.3f} px since the first verifications, and not "
                "by chance"
            )
            told.append((HealthState.WATCH, words))
    return told


def _crept(values: Sequence[float]) -> tuple[float, float]:
    """The mean of the last verifications less that of the first ones, and the probability of as much by chance.

    The deviation is that of the verifications' own scatter, from the differences of neighbours (von Neumann 1941): a
    slow trend is not in it. Its square has about two thirds as many degrees of freedom as there are differences.
    """
    count = min(len(values) // 2, _AVERAGED)
    if count < _FEWEST_AVERAGED:
        return 0.0, 1.0
    found = np.asarray(values, dtype=np.float64)
    scatter = float(np.sqrt((np.diff(found) ** 2).mean() / 2))
    crept = float(found[-count:].mean() - found[:count].mean())
    size = abs(crept) / max(scatter * np.sqrt(2 / count), 1e-12)
    return crept, float(2 * stdtr(2 * (len(values) - 1) / 3, -size))


def _trend(
    verifications: Sequence[Verification], value: Callable[[Verification], float], jumps: Callable[[Verification], bool]
) -> tuple[float, bool]:
    """The median of the last three, or the last alone where it is beyond chance; and whether it was that."""
    last = value(verifications[-1])
    middle = float(np.median([value(verification) for verification in verifications[-_TREND:]]))
    return (last, True) if last > middle and jumps(verifications[-1]) else (middle, False)


def _error_ratio(verification: Verification) -> float:
    return (
        verification.expected_mm / verification.stated_mm
        if verification.expected_mm is not None and verification.stated_mm
        else 0.0
    )


def _pair(verification: Verification, first: str, second: str) -> PairFigures | None:
    return next((pair for pair in verification.pairs if (pair.first, pair.second) == (first, second)), None)


def _pairs(verifications: Sequence[Verification]) -> list[tuple[str, str]]:
    return list(
        dict.fromkeys(
            (pair.first, pair.second) for verification in verifications[-_TREND:] for pair in verification.pairs
        )
    )


def _good_words(verification: Verification) -> str:
    worst = max((abs(pair.mean_px) for pair in verification.pairs), default=float("nan"))
    words = f"devices agree within {worst:.2f} px in the mean"
    if verification.expected_mm is not None and verification.stated_mm:
        words = f"expected error {verification.expected_mm:.3g} mm, stated {verification.stated_mm:.3g} mm"
    return f"the calibration holds: {words}{''.join(f'; {each}' for each in _unseen_words(verification))}"


def _unseen_words(verification: Verification) -> list[str]:
    return [
        f"{device_words(name)} did not take part in the last verification, which says nothing of it"
        for name in verification.unseen
    ]

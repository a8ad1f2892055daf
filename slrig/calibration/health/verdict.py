"""Good, watch or stale: what several verifications of a rig since its calibration say together.

One verification may be bad luck: a lamp was switched on, someone leaned on the table. So the trend is judged, the
median of the last three verifications; but a verification that is far beyond chance counts at once
(`Thresholds.jump_evidence`): a device that was knocked stays knocked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slrig.calibration.health.verification import PairFigures, Verification
from slrig.calibration.solution import device_title


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


_Told = list[tuple[HealthState, str]]


def judged(verifications: Sequence[Verification], /) -> Health:
    """Judge a rig by every verification since its calibration, oldest first."""
    if not verifications:
        return Health(
            HealthState.UNKNOWN, ("nothing was verified since the calibration",), "shoot a verification of the board"
        )
    told = _of_error(verifications)
    pairs = {}
    for key in _pairs(verifications):
        pairs[key] = [pair for each in verifications for pair in each.pairs if (pair.first, pair.second) == key]
    told += [found for each in pairs.values() for found in _of_mean(each)]
    told += [found for each in pairs.values() for found in _of_rms(each)]
    board = [each for each in verifications if each.kind == "board"]
    if len(board) >= _TREND and _middle([each.evidence for each in board]) >= THRESHOLDS.watch_evidence:
        told.append((HealthState.WATCH, "the last verifications agree that a device changed"))
    told += _of_trend([each.scale_percent for each in verifications if each.scale_percent is not None], pairs)
    if not told:
        return Health(HealthState.GOOD, (_good_words(verifications[-1]),))
    told.sort(key=lambda each: each[0] is not HealthState.STALE)
    state, reasons = told[0][0], [words for _, words in told]
    named = board[-1] if board else verifications[-1]
    if named.drifts:
        reasons += [named.drifts[0].words, *([named.open] if named.open else [])]
    reasons += _unseen_words(named)
    if state is HealthState.STALE:
        remedy = named.remedy or "shoot a verification of the board to learn which device changed, and calibrate again"
    else:
        remedy = "verify again soon; calibrate again before it gets worse"
    return Health(state, tuple(reasons), remedy)


def _of_error(verifications: Sequence[Verification]) -> _Told:
    at, known = THRESHOLDS, [each for each in verifications if each.expected_mm is not None and each.stated_mm]
    if not known:
        return []
    ratio, jumped = _trend([_error_ratio(each) for each in known], jumps=known[-1].evidence > at.jump_evidence)
    counted = known[-1:] if jumped else known
    evidence, sigmas = _middle([each.evidence for each in counted]), _middle([each.significance for each in counted])
    now, stated = known[-1].expected_mm, known[-1].stated_mm
    words = f"scans are now expected to be wrong by {now:.3g} mm, {ratio:.1f} times the {stated:.3g} mm that is stated"
    likely, sure = evidence > at.watch_evidence, sigmas > at.sure_sigmas
    if (ratio > at.stale_error_ratio and likely) or (ratio > at.sure_error_ratio and sure):
        return [(HealthState.STALE, words)]
    # A ratio alone may come of explanations none of which is likelier than that nothing changed.
    changed = evidence > 0 or ratio > at.sure_error_ratio
    return [(HealthState.WATCH, words)] if ratio > at.watch_error_ratio and changed else []


def _of_mean(found: Sequence[PairFigures]) -> _Told:
    at, last = THRESHOLDS, found[-1]
    jumps = abs(last.mean_px) > at.jump_mean_sigmas * last.mean_sigma_px
    value, _ = _trend([abs(pair.mean_px) for pair in found], jumps=jumps)
    if value <= max(at.watch_mean_px, _CHANCE * last.mean_sigma_px):
        return []
    state = HealthState.STALE if value > at.stale_mean_px else HealthState.WATCH
    return [(state, f"'{last.first}' and '{last.second}' disagree by {value:.2f} px in the mean, expected about 0")]


def _of_rms(found: Sequence[PairFigures]) -> _Told:
    at, last = THRESHOLDS, found[-1]
    after = max(found[0].predicted_px, min(pair.rms_px for pair in found[:_TREND]))
    value = _middle([pair.rms_px for pair in found])
    if value <= at.watch_rms_ratio * after:
        return []
    words = f"'{last.first}' and '{last.second}' disagree by {value:.2f} px rms, {after:.2f} px after the calibration"
    return [(HealthState.STALE if value > at.stale_rms_ratio * after else HealthState.WATCH, words)]


def _of_trend(sizes: Sequence[float], pairs: Mapping[tuple[str, str], Sequence[PairFigures]]) -> _Told:
    told = []
    crept, chance = _crept(sizes)
    if chance < THRESHOLDS.trend_chance:
        told.append(f"the board's measured size has crept by {crept:+.3f} %")
    for (first, second), found in pairs.items():
        crept, chance = _crept([pair.mean_px for pair in found])
        if chance < THRESHOLDS.trend_chance and abs(crept) > _CREPT_PX:
            told.append(f"'{first}' and '{second}' have crept apart by {crept:+.3f} px")
    return [(HealthState.WATCH, f"{each} since the first verifications, and not by chance") for each in told]


def _crept(values: Sequence[float]) -> tuple[float, float]:
    """The mean of the last verifications less that of the first ones, and the probability of as much by chance.

    The deviation is that of the verifications' own scatter, from the differences of neighbours (von Neumann 1941): a
    slow trend is not in it. Its square has about two thirds as many degrees of freedom as there are differences.
    """
    # Here: the service judges few times in its life, and scipy takes a tenth of its start to load.
    from scipy.special import stdtr

    count = min(len(values) // 2, _AVERAGED)
    if count < _FEWEST_AVERAGED:
        return 0.0, 1.0
    found = np.asarray(values, dtype=np.float64)
    scatter = float(np.sqrt((np.diff(found) ** 2).mean() / 2))
    crept = float(found[-count:].mean() - found[:count].mean())
    size = abs(crept) / max(scatter * np.sqrt(2 / count), 1e-12)
    return crept, float(2 * stdtr(2 * (len(values) - 1) / 3, -size))


def _middle(values: Sequence[float]) -> float:
    """The median of the last three."""
    return float(np.median(values[-_TREND:]))


def _trend(values: Sequence[float], *, jumps: bool) -> tuple[float, bool]:
    """The median of the last three, or the last alone where it is beyond chance; and whether it was that."""
    middle = _middle(values)
    return (values[-1], True) if values[-1] > middle and jumps else (middle, False)


def _error_ratio(verification: Verification) -> float:
    now, stated = verification.expected_mm, verification.stated_mm
    return now / stated if now is not None and stated else 0.0


def _pairs(verifications: Sequence[Verification]) -> dict[tuple[str, str], None]:
    """The pairs of the last three verifications, in order."""
    return dict.fromkeys((pair.first, pair.second) for each in verifications[-_TREND:] for pair in each.pairs)


def _good_words(verification: Verification) -> str:
    worst = max((abs(pair.mean_px) for pair in verification.pairs), default=float("nan"))
    words = f"devices agree within {worst:.2f} px in the mean"
    if verification.expected_mm is not None and verification.stated_mm:
        words = f"expected error {verification.expected_mm:.3g} mm, stated {verification.stated_mm:.3g} mm"
    return f"the calibration holds: {words}{''.join(f'; {each}' for each in _unseen_words(verification))}"


def _unseen_words(verification: Verification) -> list[str]:
    return [
        f"{device_title(name)} did not take part in the last verification, which says nothing of it"
        for name in verification.unseen
    ]

"""Verification of a calibration by one view of a board: residuals, figures, and the verdict on its health."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slrig.calibration.board import COLUMN, ROW, Board, Correspondences, PoseObservation
from slrig.calibration.health.drift import (
    MIN_EVIDENCE_GAP,
    Change,
    Hypothesis,
    describe_alternatives,
    describe_change,
    describe_remedy,
    equally_likely,
    estimate_board_growth,
    linearise,
    rank_hypotheses,
)
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    cell_centres,
    covariance_modes,
    device_covariance,
    device_title,
    devices_by_name,
    point_sensitivity,
    project_out_rigid_motion,
)
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray, IntArray, Pinhole, Size


@dataclass(frozen=True, slots=True)
class PairFigures:
    """A pair's spare equation in numbers, px of `second`'s image. predicted_px : the rms that noise and the
    calibration's covariance predict; mean_sigma_px : of the mean. Maps are (6, 6) rows over `first`'s image, None where
    nothing was seen.
    """

    first: str
    second: str
    count: int
    mean_px: float
    rms_px: float
    predicted_px: float
    mean_sigma_px: float
    map_mean_px: Sequence[Sequence[float | None]] = ()
    map_rms_px: Sequence[Sequence[float | None]] = ()
    map_count: Sequence[Sequence[int]] = ()


@dataclass(frozen=True, slots=True)
class DriftEstimate:
    """One explanation of what is seen. evidence : 2 ln over that of no change; significance : in σ; weight : its
    probability; words : the change with its size.
    """

    device: str
    kind: str
    evidence: float
    significance: float
    weight: float
    words: str


@dataclass(frozen=True, slots=True)
class Verification:
    """What one verification found: numbers and words, JSON values throughout; NaN is None.

    scale_percent, scale_mm : by how much the board measures larger than it is, and that over its diagonal; None of a
    scan. expected_mm : of a point along the viewing ray, now; stated_mm : the same as the calibration states it.
    drift_mm : the change's own part. drifts : likeliest first, nothing where nothing changed. open : what the geometry
    leaves open. remedy : what to do about the first. unseen : devices that nothing was learned of: cameras that did not
    see the board, and the projector if no camera saw its light there.
    """

    kind: str
    pairs: Sequence[PairFigures]
    scale_percent: float | None = None
    scale_sigma_percent: float | None = None
    scale_mm: float | None = None
    expected_mm: float | None = None
    stated_mm: float | None = None
    drift_mm: float | None = None
    significance: float = 0.0
    evidence: float = 0.0
    drifts: Sequence[DriftEstimate] = ()
    open: str | None = None
    remedy: str | None = None
    unseen: Sequence[str] = ()

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def verification_from_document(document: Mapping[str, Any], /) -> Verification:
    """The verification that `Verification.document` gave."""
    given = dict(document)
    given["pairs"] = tuple(PairFigures(**each) for each in given["pairs"])
    given["drifts"] = tuple(DriftEstimate(**each) for each in given["drifts"])
    # Looks on record from before it was told have none.
    given["unseen"] = tuple(given.get("unseen", ()))
    return Verification(**given)


def verification_from_scan(pairs: Sequence[Mapping[str, Any]], /) -> Verification | None:
    """Judge by the redundancy of a scan: `residual_px` of that section of its report; None where it has no pair.

    The spare equation of two cameras tells that a calibration does not hold, and neither which device changed nor by
    how many millimetres a scan is off: the figures for those are None.
    """
    found = tuple(
        PairFigures(
            first=str(pair["reference"]), second=str(pair["camera"]), count=int(pair["pairs"]),
            mean_px=float(pair["mean"]), rms_px=float(pair["rms"]), predicted_px=float(pair["stated_rms"]),
            mean_sigma_px=float(pair["stated_rms"]) / math.sqrt(int(pair["pairs"])),
            map_mean_px=pair["map"]["mean"], map_rms_px=pair["map"]["rms"], map_count=pair["map"]["pairs"],
        )
        for pair in pairs
        if pair["pairs"]
    )  # fmt: skip
    return Verification(kind="scan", pairs=found) if found else None


_MAX_LISTED = 5
_STEPS = 7
_MIN_POINTS = 30
_MIN_WEIGHT = 1e-4


def verify_by_board(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Verification:
    """Judge a calibration by one or more poses of a board, shot after it.

    Raises
    ------
    CalibrationError
        None of the calibration's cameras sees the board, or it is of one camera alone.
    """
    if not calibration.can_triangulate:
        message = (
            "expected a calibration of two devices, which a verification holds against each other, found one of camera "
            f"'{next(iter(calibration.cameras))}' alone: calibrate it again, and see what changed with slrig calibrate "
            "compare"
        )
        raise CalibrationError(message)
    found = linearise(poses, board, calibration)
    ranked = rank_hypotheses(found, calibration)
    best = ranked[0]
    growth = 0.0
    if best.moved:
        share, evidence = estimate_board_growth(found, calibration)
        growth = share if evidence > best.evidence - MIN_EVIDENCE_GAP else 0.0
    scale = estimate_board_scale(poses, board, calibration, found.standing)
    now_mm, stated_mm, drift_mm = _expected_errors_mm(
        ranked, calibration, _working_volume(calibration, board, found.standing)
    )
    judged = Verification(
        kind="board",
        pairs=pair_residuals(poses, board, calibration, found.standing),
        scale_percent=None if scale is None else 100 * scale[0],
        scale_sigma_percent=None if scale is None else 100 * scale[1],
        scale_mm=None if scale is None else scale[0] * float(np.linalg.norm(np.ptp(board.points_mm, axis=0))),
        expected_mm=now_mm,
        stated_mm=None if calibration.solved is None else stated_mm,
        drift_mm=drift_mm,
        significance=best.significance,
        evidence=best.evidence,
        unseen=_unseen_devices(poses, calibration),
    )
    if best.kind is Change.NONE:
        return judged
    listed = [each for each in ranked if each.kind is not Change.NONE and each.evidence > 0][:_MAX_LISTED]
    drifts = tuple(
        DriftEstimate(each.device, str(each.kind), each.evidence, each.significance, each.weight, describe_change(each))
        for each in listed
    )
    left_open = describe_alternatives(best, equally_likely(ranked), calibration, growth)
    return replace(judged, drifts=drifts, open=left_open, remedy=describe_remedy(best))


def _unseen_devices(poses: Sequence[PoseObservation], calibration: Calibration) -> tuple[str, ...]:
    """The devices that no pose says anything of."""
    seen = {name for pose in poses for name in pose.views}
    if any(len(light.axis) for pose in poses for light in pose.correspondences.values()):
        seen.add(PROJECTOR)
    return tuple(name for name in devices_by_name(calibration) if name not in seen)


def _working_volume(calibration: Calibration, board: Board, standing: Mapping[str, BoardPose]) -> FloatArray:
    """The calibration's volume; where it names none, a cube about the board as it stands now."""
    if calibration.solved is not None:
        return calibration.solved.volume_mm
    corners = np.concatenate([pose.to_world(board.points_mm) for pose in standing.values()])
    middle, half = corners.mean(axis=0), float(np.ptp(corners, axis=0).max()) / 2
    return np.stack([middle - half, middle + half])


def _expected_errors_mm(
    ranked: Sequence[Hypothesis], calibration: Calibration, volume_mm: FloatArray
) -> tuple[float | None, float | None, float | None]:
    """Expected error of a point along the first camera's ray, rms over a box (2, 3), mm, without noise: with what
    changed since; from the calibration alone; and what the likeliest change makes, 0 where none is likely. What the
    size of the board's squares is unsure by is in none of them: it is no change, and would cover one.

    None where the devices share too little of the box.
    """
    nodes = cell_centres(np.sort(volume_mm, axis=0), [_STEPS] * 3)
    cameras = list(calibration.cameras.values())
    moved = point_sensitivity(cameras, calibration.projector, nodes)
    seen = moved.visible & np.isfinite(moved.by_parameter).all(axis=(1, 2))
    if calibration.projector is not None and len(cameras) > 1:
        seen &= point_sensitivity(cameras[:1], calibration.projector, nodes).visible
    if seen.sum() < _MIN_POINTS:
        return None, None, None
    places, by_parameter = nodes[seen], moved.by_parameter[seen]
    ray = places - cameras[0].centre_mm
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def rms(changes: FloatArray) -> float:
        fields = project_out_rigid_motion(places, by_parameter @ changes.reshape(len(changes), -1))
        return float(np.sqrt((np.einsum("ni,nik->nk", ray, fields) ** 2).sum(axis=1).mean()))

    likely = [each for each in ranked if each.weight > _MIN_WEIGHT and (each.evidence > 0 or each.kind is Change.NONE)]
    square = sum(each.weight * (rms(each.mean) ** 2 + rms(each.modes) ** 2) for each in likely)
    square /= sum(each.weight for each in likely)
    drift_mm = 0.0 if ranked[0].kind is Change.NONE else rms(ranked[0].change)
    return float(np.sqrt(square)), rms(covariance_modes(device_covariance(calibration, board=False))), drift_mm


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
_RECENT = 3
_CHANCE_SIGMAS = 4.0
_AVERAGED = 8  # verifications at the beginning, and at the end, that a trend is judged by
_MIN_AVERAGED = 4
_MIN_CREEP_PX = 0.02


@dataclass(frozen=True, slots=True)
class Health:
    """The verdict: the state, and why, in words; what to do about it, None where nothing need be."""

    state: HealthState
    reasons: tuple[str, ...]
    remedy: str | None = None


_Reasons = list[tuple[HealthState, str]]


def judge_health(verifications: Sequence[Verification], /) -> Health:
    """Judge a rig by every verification since its calibration, oldest first."""
    if not verifications:
        return Health(
            HealthState.UNKNOWN, ("nothing was verified since the calibration",), "shoot a verification of the board"
        )
    told = _error_reasons(verifications)
    pairs = {}
    for key in _recent_pairs(verifications):
        pairs[key] = [pair for each in verifications for pair in each.pairs if (pair.first, pair.second) == key]
    told += [found for each in pairs.values() for found in _mean_reasons(each)]
    told += [found for each in pairs.values() for found in _rms_reasons(each)]
    board = [each for each in verifications if each.kind == "board"]
    if len(board) >= _RECENT and _recent_median([each.evidence for each in board]) >= THRESHOLDS.watch_evidence:
        told.append((HealthState.WATCH, "the last verifications agree that a device changed"))
    told += _trend_reasons([each.scale_percent for each in verifications if each.scale_percent is not None], pairs)
    if not told:
        return Health(HealthState.GOOD, (_describe_good(verifications[-1]),))
    told.sort(key=lambda each: each[0] is not HealthState.STALE)
    state, reasons = told[0][0], [words for _, words in told]
    named = board[-1] if board else verifications[-1]
    if named.drifts:
        reasons += [named.drifts[0].words, *([named.open] if named.open else [])]
    reasons += _describe_unseen(named)
    if state is HealthState.STALE:
        remedy = named.remedy or "shoot a verification of the board to learn which device changed, and calibrate again"
    else:
        remedy = "verify again soon; calibrate again before it gets worse"
    return Health(state, tuple(reasons), remedy)


def _error_reasons(verifications: Sequence[Verification]) -> _Reasons:
    at, known = THRESHOLDS, [each for each in verifications if each.expected_mm is not None and each.stated_mm]
    if not known:
        return []
    ratio, jumped = _recent_value([_error_ratio(each) for each in known], jumps=known[-1].evidence > at.jump_evidence)
    counted = known[-1:] if jumped else known
    evidence, sigmas = (
        _recent_median([each.evidence for each in counted]),
        _recent_median([each.significance for each in counted]),
    )
    now, stated = known[-1].expected_mm, known[-1].stated_mm
    words = f"scans are now expected to be wrong by {now:.3g} mm, {ratio:.1f} times the {stated:.3g} mm that is stated"
    likely, sure = evidence > at.watch_evidence, sigmas > at.sure_sigmas
    if (ratio > at.stale_error_ratio and likely) or (ratio > at.sure_error_ratio and sure):
        return [(HealthState.STALE, words)]
    # A ratio alone may come of explanations none of which is likelier than that nothing changed.
    changed = evidence > 0 or ratio > at.sure_error_ratio
    return [(HealthState.WATCH, words)] if ratio > at.watch_error_ratio and changed else []


def _mean_reasons(found: Sequence[PairFigures]) -> _Reasons:
    at, last = THRESHOLDS, found[-1]
    jumps = abs(last.mean_px) > at.jump_mean_sigmas * last.mean_sigma_px
    value, _ = _recent_value([abs(pair.mean_px) for pair in found], jumps=jumps)
    if value <= max(at.watch_mean_px, _CHANCE_SIGMAS * last.mean_sigma_px):
        return []
    state = HealthState.STALE if value > at.stale_mean_px else HealthState.WATCH
    return [(state, f"'{last.first}' and '{last.second}' disagree by {value:.2f} px in the mean, expected about 0")]


def _rms_reasons(found: Sequence[PairFigures]) -> _Reasons:
    at, last = THRESHOLDS, found[-1]
    after = max(found[0].predicted_px, min(pair.rms_px for pair in found[:_RECENT]))
    value = _recent_median([pair.rms_px for pair in found])
    if value <= at.watch_rms_ratio * after:
        return []
    words = f"'{last.first}' and '{last.second}' disagree by {value:.2f} px rms, {after:.2f} px after the calibration"
    return [(HealthState.STALE if value > at.stale_rms_ratio * after else HealthState.WATCH, words)]


def _trend_reasons(sizes: Sequence[float], pairs: Mapping[tuple[str, str], Sequence[PairFigures]]) -> _Reasons:
    told = []
    crept, chance = _estimate_creep(sizes)
    if chance < THRESHOLDS.trend_chance:
        told.append(f"the board's measured size has crept by {crept:+.3f} %")
    for (first, second), found in pairs.items():
        crept, chance = _estimate_creep([pair.mean_px for pair in found])
        if chance < THRESHOLDS.trend_chance and abs(crept) > _MIN_CREEP_PX:
            told.append(f"'{first}' and '{second}' have crept apart by {crept:+.3f} px")
    return [(HealthState.WATCH, f"{each} since the first verifications, and not by chance") for each in told]


def _estimate_creep(values: Sequence[float]) -> tuple[float, float]:
    """The mean of the last verifications less that of the first ones, and the probability of as much by chance.

    The deviation is that of the verifications' own scatter, from the differences of neighbours (von Neumann 1941): a
    slow trend is not in it. Its square has about two thirds as many degrees of freedom as there are differences.
    """
    # Here: the service judges few times in its life, and scipy takes a tenth of its start to load.
    from scipy.special import stdtr

    count = min(len(values) // 2, _AVERAGED)
    if count < _MIN_AVERAGED:
        return 0.0, 1.0
    found = np.asarray(values, dtype=np.float64)
    scatter = float(np.sqrt((np.diff(found) ** 2).mean() / 2))
    crept = float(found[-count:].mean() - found[:count].mean())
    size = abs(crept) / max(scatter * np.sqrt(2 / count), 1e-12)
    return crept, float(2 * stdtr(2 * (len(values) - 1) / 3, -size))


def _recent_median(values: Sequence[float]) -> float:
    """The median of the last three."""
    return float(np.median(values[-_RECENT:]))


def _recent_value(values: Sequence[float], *, jumps: bool) -> tuple[float, bool]:
    """The median of the last three, or the last alone where it is beyond chance; and whether it was that."""
    middle = _recent_median(values)
    return (values[-1], True) if values[-1] > middle and jumps else (middle, False)


def _error_ratio(verification: Verification) -> float:
    now, stated = verification.expected_mm, verification.stated_mm
    return now / stated if now is not None and stated else 0.0


def _recent_pairs(verifications: Sequence[Verification]) -> dict[tuple[str, str], None]:
    """The pairs of the last three verifications, in order."""
    return dict.fromkeys((pair.first, pair.second) for each in verifications[-_RECENT:] for pair in each.pairs)


def _describe_good(verification: Verification) -> str:
    worst = max((abs(pair.mean_px) for pair in verification.pairs), default=float("nan"))
    words = f"devices agree within {worst:.2f} px in the mean"
    if verification.expected_mm is not None and verification.stated_mm:
        words = f"expected error {verification.expected_mm:.3g} mm, stated {verification.stated_mm:.3g} mm"
    return f"the calibration holds: {words}{''.join(f'; {each}' for each in _describe_unseen(verification))}"


def _describe_unseen(verification: Verification) -> list[str]:
    return [
        f"{device_title(name)} did not take part in the last verification, which says nothing of it"
        for name in verification.unseen
    ]


_OUTLIER_SIGMAS = 6.0
_SIGMA_PER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MAX_COVARIANCE_POINTS = 160  # points that the calibration's share is evaluated at
_MIN_RESIDUALS = 12
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-13)
_STEP_MM = 0.05
_INTERSECTION_STEPS = 4
_DERIVATIVE_STEPS = np.array([1e-2] * 4 + [1e-4] * 5 + [1e-6] * 3 + [1e-3] * 3)
"""Steps of a device's parameters for derivatives: px, lens terms, rad, mm."""


class _MatchedPoints(NamedTuple):
    """Points that two devices both measured: (n, 2) pixels each, and (n, 2) standard deviations in the second.

    first_sigma_px : (n,) of the pixel in the first device. start_mm : (n, 3), about where they are.
    """

    first_px: FloatArray
    second_px: FloatArray
    second_sigma_px: FloatArray
    first_sigma_px: FloatArray
    start_mm: FloatArray


class _EpipolarResiduals(NamedTuple):
    """residual_px : (n,) float64, measured minus the epipolar line, across it, px of the second device.

    across : (n, 2) float64, the unit vector across the line. points_mm : (n, 3) float64, on the first device's ray.
    """

    residual_px: FloatArray
    across: FloatArray
    points_mm: FloatArray


def pair_residuals(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[PairFigures, ...]:
    """The spare equation of each camera with the projector, and of each two cameras, over all poses.

    standing : where the board stands in each pose, as `slrig.calibration.health.drift` finds it.
    """
    found = []
    for first, second in _pair_indices(calibration):
        parts = [_match_points(pose, board, calibration, standing[pose.name], first, second) for pose in poses]
        kept = [part for part in parts if part is not None]
        if kept:
            joined = _MatchedPoints(*(np.concatenate(column) for column in zip(*kept, strict=True)))
            found.append(_pair_figures(joined, calibration, first, second))
    return tuple(found)


def estimate_board_scale(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, standing: Mapping[str, BoardPose], /
) -> tuple[float, float] | None:
    """By which share of it the board measures larger than it is, and the deviation of that from noise and covariance.

    As the pair of devices measures it that is surest; None where none sees enough corners.
    """
    found = []
    for first, second in _pair_indices(calibration):
        parts = [_match_corners(pose, board, standing[pose.name], first, second) for pose in poses]
        kept = [part for part in parts if part is not None]
        if kept:
            found.append(_measure_scale(kept, board, calibration, first, second))
    return min(found, key=lambda each: each[1], default=None)


def _pair_indices(calibration: Calibration) -> list[tuple[str, str]]:
    cameras = list(calibration.cameras)
    lit = [(name, PROJECTOR) for name in cameras] if calibration.projector is not None else []
    return [*lit, *combinations(cameras, 2)]


def _match_points(
    pose: PoseObservation, board: Board, calibration: Calibration, stands: BoardPose, first: str, second: str
) -> _MatchedPoints | None:
    if second != PROJECTOR:
        corners = _match_corners(pose, board, stands, first, second)
        return None if corners is None else corners[1]
    light = pose.correspondences.get(first)
    if light is None:
        return None
    pixels, position, sigma = _join_axes(light)
    if len(pixels) < _MIN_RESIDUALS:
        return None
    # Where the pixels' rays meet the board's plane.
    device = calibration.cameras[first]
    ahead, normal = _rays(device, pixels), stands.rotation[:, 2]
    depth = ((stands.translation_mm - device.centre_mm) @ normal) / (ahead @ normal)
    return _MatchedPoints(pixels, position, sigma, np.zeros(len(pixels)), device.centre_mm + depth[:, None] * ahead)


def _join_axes(light: Correspondences) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2) of which both projector coordinates are known, those (n, 2), and their deviations (n, 2)."""
    column, row = np.flatnonzero(light.axis == COLUMN), np.flatnonzero(light.axis == ROW)
    keys = [np.round(light.pixels_px[rows] * 8).astype(np.int64) @ (1 << 24, 1) for rows in (column, row)]
    _, mine, theirs = np.intersect1d(keys[0], keys[1], return_indices=True)
    both = np.column_stack([column[mine], row[theirs]])
    return light.pixels_px[both[:, 0]], light.position_px[both], light.sigma_px[both]


def _match_corners(
    pose: PoseObservation, board: Board, stands: BoardPose, first: str, second: str
) -> tuple[IntArray, _MatchedPoints] | None:
    """The corners that both measure: in the projector's picture by the light around them."""
    view = pose.views.get(first)
    if view is None:
        return None
    if second == PROJECTOR:
        light = pose.correspondences.get(first)
        if light is None:
            return None
        at, sigma = _interpolate_light(view.points_px, light, _corner_spacing_px(view.points_px, view.corner, board))
        mine = np.flatnonzero(np.isfinite(at).all(axis=1))
        number, at, sigma = view.corner[mine], at[mine], sigma[mine]
    else:
        other = pose.views.get(second)
        if other is None:
            return None
        number, mine, theirs = np.intersect1d(view.corner, other.corner, return_indices=True)
        at, sigma = other.points_px[theirs], np.repeat(other.sigma_px[theirs][:, None], 2, axis=1)
    if len(number) < _MIN_RESIDUALS:
        return None
    return number, _MatchedPoints(
        view.points_px[mine], at, sigma, view.sigma_px[mine], stands.to_world(board.points_mm)[number]
    )


def _corner_spacing_px(points_px: FloatArray, corner: IntArray, board: Board) -> float:
    """How far around a corner its light is taken: the mean distance of neighbours along a row."""
    row, column = np.divmod(corner, board.columns)
    next_to = (np.diff(row) == 0) & (np.diff(column) == 1)
    lengths = np.linalg.norm(np.diff(points_px, axis=0), axis=1)[next_to]
    return float(np.median(lengths)) if len(lengths) else 20.0


def _interpolate_light(points_px: FloatArray, light: Correspondences, reach_px: float) -> tuple[FloatArray, FloatArray]:
    """The projector coordinates at points (n, 2) by a weighted quadratic surface, and deviations (n, 2)."""
    at, sigma = np.full((len(points_px), 2), np.nan), np.full((len(points_px), 2), np.nan)
    for axis in (COLUMN, ROW):
        rows = np.flatnonzero(light.axis == axis)
        if not len(rows):
            continue
        tree = cKDTree(light.pixels_px[rows])
        for number, place in enumerate(points_px):
            chosen = tree.query_ball_point(place, reach_px)
            if len(chosen) < _MIN_RESIDUALS:
                continue
            mine = rows[chosen]
            x, y = (light.pixels_px[mine] - points_px[number]).T / reach_px
            terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
            weight = 1 / light.sigma_px[mine]
            position = light.position_px[mine]
            for _ in range(2):
                solved = np.linalg.lstsq(terms * weight[:, None], position * weight, rcond=None)[0]
                left = (position - terms @ solved) * weight
                spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(left))) + 1e-9
                weight = np.where(np.abs(left) > 4 * spread, 0.0, weight)
            normal = np.linalg.pinv((terms * weight[:, None]).T @ (terms * weight[:, None]))
            at[number, axis] = solved[0]
            sigma[number, axis] = max(spread, 1.0) * np.sqrt(max(normal[0, 0], 0.0))
    return at, sigma


def _project(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: pixels of points (n, 3) in the world; NaN behind the device."""
    turned = points_mm @ device.rotation.T + device.translation_mm
    before = np.isfinite(turned).all(axis=1) & (turned[:, 2] > 0)
    safe = np.where(before[:, None], turned, (0.0, 0.0, 1.0))
    pixels, _ = cv2.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), device.matrix, device.distortion)
    return np.where(before[:, None], np.asarray(pixels, dtype=np.float64).reshape(-1, 2), np.nan)


def _rays(device: Pinhole, pixels_px: FloatArray) -> FloatArray:
    """(n, 3) float64: directions in the world of pixels (n, 2), of depth 1 in the device."""
    flat = cv2.undistortPoints(pixels_px[:, None], device.matrix, device.distortion, criteria=_CRITERIA)
    ahead = np.column_stack([np.asarray(flat, dtype=np.float64).reshape(-1, 2), np.ones(len(pixels_px))])
    return np.asarray(ahead @ device.rotation)


def _epipolar_residuals(first: Pinhole, second: Pinhole, found: _MatchedPoints) -> _EpipolarResiduals:
    """Meet the rays of the first device's pixels with what the second one measured.

    The point on the ray is that whose image is nearest.
    """
    origin, ahead = first.centre_mm, _rays(first, found.first_px)
    depth = (found.start_mm - origin) @ first.rotation[2]
    for _ in range(_INTERSECTION_STEPS):
        at = _project(second, origin + depth[:, None] * ahead)
        along = (_project(second, origin + (depth + _STEP_MM)[:, None] * ahead) - at) / _STEP_MM
        depth = depth + ((found.second_px - at) * along).sum(axis=1) / (along**2).sum(axis=1)
    points = origin + depth[:, None] * ahead
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    return _EpipolarResiduals(((found.second_px - _project(second, points)) * across).sum(axis=1), across, points)


def _pair_figures(found: _MatchedPoints, calibration: Calibration, first: str, second: str) -> PairFigures:
    devices = devices_by_name(calibration)
    one, other = devices[first], devices[second]
    spare = _epipolar_residuals(one, other, found)
    residual = spare.residual_px
    finite = np.isfinite(residual)
    middle = float(np.median(residual[finite]))
    spread = _SIGMA_PER_MEDIAN * float(np.median(np.abs(residual[finite] - middle))) + 1e-9
    good = finite & (np.abs(residual - middle) <= _OUTLIER_SIGMAS * spread)
    sigma = np.hypot(
        np.sqrt(((found.second_sigma_px * spare.across) ** 2).sum(axis=1)),
        _first_pixel_sigma_px(one, other, found, spare),
    )
    kept = residual[good]
    chosen = np.flatnonzero(good)[
        np.unique(np.linspace(0, good.sum() - 1, min(_MAX_COVARIANCE_POINTS, good.sum())).astype(int))
    ]
    some = _MatchedPoints(*(column[chosen] for column in found))
    slopes = _derivatives(lambda a, b: _epipolar_residuals(a, b, some).residual_px, one, other)
    covariance = device_covariance(calibration, first, second)
    shares = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    noise_variance, mean = float((sigma[good] ** 2).mean()), slopes.mean(axis=0)
    mean_variance = float(mean @ covariance @ mean) + noise_variance / len(kept)
    mean_map, rms_map, count_map = _residual_maps(found.first_px[good], kept, one.size)
    return PairFigures(
        first, second, len(kept), float(kept.mean()), float(np.sqrt((kept**2).mean())),
        float(np.hypot(np.sqrt(noise_variance), np.sqrt(shares.mean()))), float(np.sqrt(max(mean_variance, 0.0))),
        mean_map, rms_map, count_map,
    )  # fmt: skip


def _first_pixel_sigma_px(one: Pinhole, other: Pinhole, found: _MatchedPoints, spare: _EpipolarResiduals) -> FloatArray:
    """(n,): the deviation of the first device's pixel, px across the line in the second."""
    if not found.first_sigma_px.any():
        return np.zeros(len(found.first_px))
    moves = []
    for axis in np.eye(2):
        moved = found._replace(first_px=found.first_px + 0.1 * axis)
        moves.append((_epipolar_residuals(one, other, moved).residual_px - spare.residual_px) / 0.1)
    return np.asarray(found.first_sigma_px * np.hypot(moves[0], moves[1]))


def _derivatives(value: Callable[[Pinhole, Pinhole], FloatArray | float], one: Pinhole, other: Pinhole) -> FloatArray:
    """(..., 30): derivatives of what a function gives by the parameters of both devices, in the order of PARAMETERS."""
    columns = []
    for which in (0, 1):
        for number, step in enumerate(_DERIVATIVE_STEPS):
            change = np.zeros((2, len(PARAMETERS)))
            change[which, number] = step
            high, low = (value(_change_device(one, by[0]), _change_device(other, by[1])) for by in (change, -change))
            columns.append((high - low) / (2 * step))
    return np.stack(columns, axis=-1)


def _change_device(device: Pinhole, change: FloatArray) -> Pinhole:
    """The device with its 15 parameters changed, in the order of PARAMETERS."""
    matrix = device.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change[:4]
    turn = np.asarray(cv2.Rodrigues(np.asarray(change[9:12], dtype=np.float64))[0], dtype=np.float64)
    return replace(
        device, matrix=matrix, distortion=device.distortion + change[4:9], rotation=turn @ device.rotation,
        translation_mm=device.translation_mm + change[12:],
    )  # fmt: skip


def _residual_maps(
    pixels_px: FloatArray, residual: FloatArray, size: Size
) -> tuple[list[list[float | None]], list[list[float | None]], list[list[int]]]:
    """Mean, rms and count by cell, (6, 6) over the image; None where nothing was seen."""
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip(((pixels_px + 0.5) / extent * CELLS).astype(int), 0, CELLS - 1)
    key = cell[:, 1] * CELLS + cell[:, 0]
    count = np.bincount(key, minlength=CELLS**2).reshape(CELLS, CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(key, residual, CELLS**2).reshape(CELLS, CELLS) / count
        rms = np.sqrt(np.bincount(key, residual**2, CELLS**2).reshape(CELLS, CELLS) / count)
    rows = [[[None if np.isnan(v) else round(float(v), 4) for v in row] for row in values] for values in (mean, rms)]
    return rows[0], rows[1], count.tolist()


def _measure_scale(
    parts: Sequence[tuple[IntArray, _MatchedPoints]], board: Board, calibration: Calibration, first: str, second: str
) -> tuple[float, float]:
    """The board's size as two devices measure it, as a share of it less 1, and the deviation of that."""
    devices = devices_by_name(calibration)
    one, other = devices[first], devices[second]

    def share(one: Pinhole, other: Pinhole) -> tuple[float, float]:
        """The scale less 1, and its variance from what is left over."""
        total, weight, left = 0.0, 0.0, 0.0
        for number, found in parts:
            scale, extent, rest = _fit_similarity(
                _epipolar_residuals(one, other, found).points_mm, board.points_mm[number]
            )
            total, weight, left = total + extent * (scale - 1), weight + extent, left + rest
        count = sum(len(number) for number, _ in parts)
        return total / weight, left / (3 * count - 7 * len(parts)) / weight

    value, noise = share(one, other)
    slopes = _derivatives(lambda a, b: share(a, b)[0], one, other)
    variance = noise + float(slopes @ device_covariance(calibration, first, second) @ slopes)
    return value, float(np.sqrt(variance))


def _fit_similarity(found_mm: FloatArray, true_mm: FloatArray) -> tuple[float, float, float]:
    """Scale from true to found points (Umeyama 1991), the true ones' sum of squares, and that of what is left."""
    found, true = found_mm - found_mm.mean(axis=0), true_mm - true_mm.mean(axis=0)
    u, values, vt = np.linalg.svd(found.T @ true)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    extent = float((true**2).sum())
    scale = float((values * sign).sum()) / extent
    left = found - scale * true @ ((u * sign) @ vt).T
    return scale, extent, float((left**2).sum())

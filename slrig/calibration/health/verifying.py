"""One verification by a board that is left in view: what it says of the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.health.devices import devices_of
from slrig.calibration.health.drift import ALIKE, Change, Hypothesis, board_growth, hypotheses, rivals
from slrig.calibration.health.equations import equations
from slrig.calibration.health.error import ErrorNow, error_now
from slrig.calibration.health.residuals import BoardScale, PairResidual, board_scales, pair_residuals
from slrig.calibration.health.verification import Drift, PairFigures, Verification
from slrig.calibration.health.words import change_words, remedy_words, rival_words
from slrig.calibration.observations import PoseObservation
from slrig.calibration.solution import PROJECTOR, BoardPose
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray

_LISTED = 5


def verify_by_board(poses: Sequence[PoseObservation], board: Board, calibration: Calibration, /) -> Verification:
    """Judge a calibration by one or more poses of a board, shot after it.

    Raises
    ------
    CalibrationError
        None of the calibration's cameras sees the board, or it is of one camera alone.
    """
    if not calibration.triangulates:
        message = (
            "expected a calibration of two devices, which a verification holds against each other, found one of camera "
            f"'{next(iter(calibration.cameras))}' alone: calibrate it again, and see what changed with slrig calibrate "
            "compare"
        )
        raise CalibrationError(message)
    found = equations(poses, board, calibration)
    pairs = pair_residuals(poses, board, calibration, found.standing)
    scales = board_scales(poses, board, calibration, found.standing)
    ranked = hypotheses(found, calibration)
    volume_mm = _volume(calibration, board, found.standing)
    error = error_now(ranked, calibration, volume_mm)
    best = ranked[0]
    changed = best.kind is not Change.NONE
    growth = 0.0
    if changed and best.kind in (Change.MOVED, Change.BUMPED):
        share, evidence = board_growth(found, calibration)
        growth = share if evidence > best.evidence - ALIKE else 0.0
    listed = (
        [each for each in ranked if each.kind is not Change.NONE and each.evidence > 0][:_LISTED] if changed else []
    )
    return Verification(
        kind="board",
        pairs=tuple(_figures(pair) for pair in pairs),
        **_of_scale(scales),
        **_of_error(error, calibration),
        significance=best.significance,
        evidence=best.evidence,
        drifts=tuple(_drift(each) for each in listed),
        open=rival_words(best, rivals(ranked), calibration, growth) if changed else None,
        remedy=remedy_words(best) if changed else None,
        unseen=_unseen(poses, calibration),
    )


def _unseen(poses: Sequence[PoseObservation], calibration: Calibration) -> tuple[str, ...]:
    """The devices that no pose says anything of."""
    seen = {name for pose in poses for name in pose.views}
    if any(len(light.axis) for pose in poses for light in pose.correspondences.values()):
        seen.add(PROJECTOR)
    return tuple(name for name in devices_of(calibration) if name not in seen)


def _volume(calibration: Calibration, board: Board, standing: Mapping[str, BoardPose]) -> FloatArray:
    """The calibration's volume; where it names none, a cube about the board as it stands now."""
    if calibration.solved is not None:
        return calibration.solved.volume_mm
    corners = np.concatenate([board.points_mm @ pose.rotation.T + pose.translation_mm for pose in standing.values()])
    middle, half = corners.mean(axis=0), float(np.ptp(corners, axis=0).max()) / 2
    return np.stack([middle - half, middle + half])


def _of_scale(scales: Sequence[BoardScale]) -> dict[str, Any]:
    if not scales:
        return {}
    best = scales[0]
    return {
        "scale_percent": 100 * best.share, "scale_sigma_percent": 100 * best.sigma_share, "scale_mm": best.error_mm
    }  # fmt: skip


def _of_error(error: ErrorNow, calibration: Calibration) -> dict[str, Any]:
    stated = error.stated_mm if calibration.solved is not None else float("nan")
    return {
        "expected_mm": _number(error.now_mm), "stated_mm": _number(stated), "drift_mm": _number(error.drift_mm)
    }  # fmt: skip


def _figures(pair: PairResidual) -> PairFigures:
    return PairFigures(
        first=pair.first, second=pair.second, count=pair.count, mean_px=pair.mean_px, rms_px=pair.rms_px,
        predicted_px=float(np.hypot(pair.noise_px, pair.calibration_px)), mean_sigma_px=pair.mean_sigma_px,
        map_mean_px=_rows(pair.map_mean_px), map_rms_px=_rows(pair.map_rms_px), map_count=pair.map_count.tolist(),
    )  # fmt: skip


def _drift(each: Hypothesis) -> Drift:
    return Drift(each.device, str(each.kind), each.evidence, each.significance, each.weight, change_words(each))


def _rows(values: FloatArray) -> list[list[float | None]]:
    return [[None if np.isnan(value) else round(float(value), 4) for value in row] for row in values]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

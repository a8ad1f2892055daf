"""One verification by a board that is left in view: what it says of the calibration, and of the error of a scan now.

Each hypothesis h of what changed (`slrig.calibration.health.drift`) gives the parameters' deviation from the
calibration a mean m_h and modes P_h. With F what they do to a point along the first camera's ray, the rigid motion
nearest to it taken out, the expected square of the error is Σ_h w_h mean((F m_h)² + Σ_k (F P_h)_k²) over places in the
volume. A calibration that nothing changed gives what it stated of itself, less what the verification by the board has
taught.

Only hypotheses that what was seen makes likelier than no change count. Of a device that the verification did not see
each is as likely as before, and would bring in all that may ever happen to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.displacement import cell_centres, modes_of, moved_points, rigid_free
from slrig.calibration.health.drift import (
    ALIKE,
    Change,
    Hypothesis,
    board_growth,
    change_words,
    hypotheses,
    remedy_words,
    rival_words,
    rivals,
)
from slrig.calibration.health.equations import equations
from slrig.calibration.health.residuals import board_scale, pair_residuals
from slrig.calibration.health.verification import Drift, Verification
from slrig.calibration.observations import PoseObservation
from slrig.calibration.solution import PROJECTOR, BoardPose, covariance_of, devices_of
from slrig.errors import CalibrationError
from slrig.model import Calibration, FloatArray

_LISTED = 5
_STEPS = 7
_FEWEST = 30
_LIKELY = 1e-4


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
    ranked = hypotheses(found, calibration)
    best = ranked[0]
    growth = 0.0
    if best.moved:
        share, evidence = board_growth(found, calibration)
        growth = share if evidence > best.evidence - ALIKE else 0.0
    scale = board_scale(poses, board, calibration, found.standing)
    now_mm, stated_mm, drift_mm = _errors_mm(ranked, calibration, _volume(calibration, board, found.standing))
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
        unseen=_unseen(poses, calibration),
    )
    if best.kind is Change.NONE:
        return judged
    listed = [each for each in ranked if each.kind is not Change.NONE and each.evidence > 0][:_LISTED]
    drifts = tuple(
        Drift(each.device, str(each.kind), each.evidence, each.significance, each.weight, change_words(each))
        for each in listed
    )
    left_open = rival_words(best, rivals(ranked), calibration, growth)
    return replace(judged, drifts=drifts, open=left_open, remedy=remedy_words(best))


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
    corners = np.concatenate([pose.placed(board.points_mm) for pose in standing.values()])
    middle, half = corners.mean(axis=0), float(np.ptp(corners, axis=0).max()) / 2
    return np.stack([middle - half, middle + half])


def _errors_mm(
    ranked: Sequence[Hypothesis], calibration: Calibration, volume_mm: FloatArray
) -> tuple[float | None, float | None, float | None]:
    """Expected error of a point along the first camera's ray, rms over a box (2, 3), mm, without noise: with what
    changed since; from the calibration alone; and what the likeliest change makes, 0 where none is likely. What the
    size of the board's squares is unsure by is in none of them: it is no change, and would cover one.

    None where the devices share too little of the box.
    """
    nodes = cell_centres(np.sort(volume_mm, axis=0), [_STEPS] * 3)
    cameras = list(calibration.cameras.values())
    moved = moved_points(cameras, calibration.projector, nodes)
    seen = moved.seen & np.isfinite(moved.by_parameter).all(axis=(1, 2))
    if calibration.projector is not None and len(cameras) > 1:
        seen &= moved_points(cameras[:1], calibration.projector, nodes).seen
    if seen.sum() < _FEWEST:
        return None, None, None
    places, by_parameter = nodes[seen], moved.by_parameter[seen]
    ray = places - cameras[0].centre_mm
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def rms(changes: FloatArray) -> float:
        fields = rigid_free(places, by_parameter @ changes.reshape(len(changes), -1))
        return float(np.sqrt((np.einsum("ni,nik->nk", ray, fields) ** 2).sum(axis=1).mean()))

    likely = [each for each in ranked if each.weight > _LIKELY and (each.evidence > 0 or each.kind is Change.NONE)]
    square = sum(each.weight * (rms(each.mean) ** 2 + rms(each.modes) ** 2) for each in likely)
    square /= sum(each.weight for each in likely)
    drift_mm = 0.0 if ranked[0].kind is Change.NONE else rms(ranked[0].change)
    return float(np.sqrt(square)), rms(modes_of(covariance_of(calibration, board=False))), drift_mm

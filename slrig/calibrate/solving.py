"""From the poses of a board to a calibration with its error and its verdict: where the rooms of calibration meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from uuid import uuid4

from slrig.calibration import (
    PROJECTOR,
    Board,
    BoardShape,
    ExpectedError,
    Observations,
    PoseObservation,
    Solution,
    ViewQuality,
)
from slrig.calibration.accuracy import OddEven, compare_halves
from slrig.calibration.judgement import Verdict, check_scale, judge_calibration
from slrig.calibration.poses import Coverage, coverage
from slrig.errors import CalibrationError, SolveRefusedError
from slrig.jobs.records import utc_now
from slrig.model import Calibration, Size, SolveRecord
from slrig.scan.plan import ProgressCallback

_SOLVE_SHARE = 0.95


@dataclass(frozen=True, slots=True)
class ReadPose:
    """One pose, as it was read: its observation, and how well each camera saw it."""

    observation: PoseObservation
    figures: Mapping[str, ViewQuality]


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A solved calibration with all that is told of it.

    calibration : carries its own error (`solved`). odd_even : what the odd and the even poses differ by, solved apart,
    against what is stated for that; None where there are too few.
    """

    solution: Solution
    calibration: Calibration
    expected: ExpectedError
    verdict: Verdict
    coverage: Coverage
    odd_even: OddEven | None = None


def solve_poses(
    board: Board,
    cameras: Mapping[str, Size],
    projector: Size | None,
    poses: Sequence[ReadPose],
    /,
    *,
    progress: ProgressCallback = lambda _stage, _fraction, _detail: None,
    earlier: Calibration | None = None,
    board_shape: BoardShape = BoardShape.AUTO,
    tolerance_mm: float | None = None,
) -> CalibrationResult:
    """Solve the poses, say how far the result may be trusted, and give it an identity.

    cameras : the first one's frame becomes the world; one is enough, also without a projector. projector : None where
    no light was captured. earlier : a calibration of the same devices, to compare the scale with. board_shape : whether
    the board may be bowed. tolerance_mm : what a point of a scan may be wrong by in 95 of 100 places; None goes by the
    volume.

    Raises
    ------
    SolveRefusedError
        The poses determine no calibration, or do not span a volume to state an error for.
    """
    # Late: the service knows these values, and loads no compiled kernel before somebody solves.
    from slrig.calibration.accuracy import expected_error
    from slrig.calibration.solving import solve

    observed = tuple(pose.observation for pose in poses)
    observations = Observations(board, cameras, projector, observed)
    solution = solve(
        observations,
        progress=lambda stage, fraction, detail: progress(stage, _SOLVE_SHARE * fraction, detail),
        board_shape=board_shape,
    )
    progress("expected error", _SOLVE_SHARE, "")
    try:
        expected = expected_error(solution, observations)
    except CalibrationError as error:
        raise SolveRefusedError(str(error)) from error
    checked = compare_halves(solution, expected.grid_mm)
    sizes = dict(cameras) if projector is None else {**cameras, PROJECTOR: projector}
    used = [pose for pose in observed if pose.name not in solution.outliers]
    covered = coverage(used, board, sizes)
    solved = SolveRecord(
        id=uuid4().hex[:12],
        solved_at=utc_now().isoformat(timespec="seconds"),
        covariance=solution.covariance,
        volume_mm=expected.volume_mm,
        expected_error_mm=expected.point_mm,
        scale_sigma=solution.size.scale_sigma,
    )
    progress("done", 1.0, "")
    scale = None if earlier is None else check_scale(solution, earlier, board)
    return CalibrationResult(
        solution=solution,
        calibration=replace(solution.calibration, solved=solved),
        expected=expected,
        verdict=judge_calibration(
            solution, expected, covered, checked, board=board, scale=scale, tolerance_mm=tolerance_mm
        ),
        coverage=covered,
        odd_even=checked,
    )

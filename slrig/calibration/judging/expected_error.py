"""What a scan with a solved calibration may be wrong by: the solve's covariance, carried to points in space.

The parameters' covariance C moves a triangulated point X by G(X) dθ (`slrig.calibration.displacement`), C = M Mᵀ. Each
column of M is one way, k, in which the devices may be wrong by one standard deviation, and F_k = G M_k the displacement
that it makes throughout the volume. The rigid motion nearest to F_k (least squares over the volume) is taken out, and
the variance of a point along its viewing ray r is Σ_k (r · F_k)².

One camera alone has no depth. There F_k moves the ray through the pixel of X at the distance of X, and the variance
across the ray is Σ_k |F_k - r (r · F_k)|². Noise of light and lengths between points are not known from one ray.

A length between two points p and q with direction e = (q - p)/L has the variance Σ_k (e · (F_k(q) - F_k(p)))²; a rigid
motion changes none. As mrcal does for projections, the uncertainty is stated where things are measured, not in the
image alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from slrig.calibration.displacement import Moved, cell_centres, modes_of, moved_points, rigid_free, stated_deviation
from slrig.calibration.observations import COLUMN, ROW, Observations
from slrig.calibration.solution import ExpectedError, Solution, scale_mode
from slrig.errors import CalibrationError
from slrig.model import Axis, Calibration, FloatArray, triangulated_axis

_PLACES = 1500  # wanted in the volume
_FEWEST_PLACES = 60
_MOST_NODES = 50_000
_MOST_STEPS = 150  # along the longest side
_LENGTHS = 4000
_PAPER = 0.05  # of the board's light comes from bright paper at the very least
_FITTED = 0.4675  # deviation of a quadratic surface, weighted by a Gaussian of 1.1 px, in the middle of 5 x 5 pixels
_LENGTH_TOLERANCE = 0.05
_MOST_PAIRED = 900  # places that are paired for lengths


def expected_error(
    solution: Solution, observations: Observations, /, *, noise_px: float | None = None
) -> ExpectedError:
    """Say what a scan with this calibration may be wrong by in the volume in which the board was held.

    noise_px : standard deviation of the light coordinate of one point of a scan: of its projector coordinate in
    projector pixels, or without a projector of its stripe's place across it in camera pixels. Unless it is given, it is
    that of the board's paper: of one pixel's light the 5 % quantile (ink is many times darker, and its light known as
    much worse), times 0.4675, because a scan finds a point by a small surface that it fits to 5 x 5 pixels. Where no
    light was observed, what rests on it is NaN; and for one camera alone, lengths too.

    Raises
    ------
    CalibrationError
        The board was not held in a volume that the devices see together.
    """
    calibration = solution.calibration
    volume_mm, places = volume_of(solution, observations)
    moved = _moved(calibration, places)
    fields = rigid_free(places, moved.by_parameter @ modes_of(solution.covariance))
    point_mm = stated_deviation(moved.stated, fields)
    if noise_px is None:
        noise_px = _light_sigma_px(observations, calibration)
    noise_mm = _rms(noise_px * stated_deviation(moved.stated, moved.by_noise))
    calibration_mm = _rms(point_mm)
    scale = solution.size.scale_sigma * scale_mode(calibration)
    board_mm = _rms(stated_deviation(moved.stated, rigid_free(places, moved.by_parameter @ scale[:, None])))
    diagonal_mm = float(np.linalg.norm(volume_mm[1] - volume_mm[0]))
    length_share = _length_share(places, fields, diagonal_mm) if calibration.triangulates else float("nan")
    return ExpectedError(
        volume_mm=volume_mm,
        point_mm=calibration_mm,
        noise_mm=noise_mm,
        total_mm=float(np.hypot(calibration_mm, noise_mm)),
        length_share=length_share,
        grid_mm=places,
        grid_point_mm=point_mm,
        across=not calibration.triangulates,
        board_mm=board_mm,
    )


def volume_of(solution: Solution, observations: Observations, /) -> tuple[FloatArray, FloatArray]:
    """The box of all corners of the board in the world, (2, 3) mm; and places in it, (n, 3), evenly spaced.

    The places lie in the convex hull of the corners, and where the first camera and the projector see them, or without
    a projector two cameras, or the one that there is.

    Raises CalibrationError where there is no such place, or the corners lie in one plane.
    """
    corners = _board_corners(solution, observations)
    volume_mm = np.stack([corners.min(axis=0), corners.max(axis=0)])
    extent = volume_mm[1] - volume_mm[0]
    try:
        hull = Delaunay(corners)
    except QhullError as cause:
        message = (
            f"expected the board in poses that span a volume, found all corners of {len(solution.poses)} poses in one "
            f"plane, in a box of {_words(extent)}; tilt the board, and hold it nearer and further away"
        )
        raise CalibrationError(message) from cause
    wanted = _PLACES
    while True:
        step = max(float(np.cbrt(extent.prod() / wanted)), float(extent.max()) / _MOST_STEPS)
        counts = np.maximum(np.ceil(extent / step).astype(int), 1)
        nodes = cell_centres(volume_mm, counts.tolist())
        nodes = nodes[hull.find_simplex(nodes) >= 0]
        places = nodes[_seen(solution.calibration, nodes)] if len(nodes) else nodes
        if len(places) >= _PLACES // 3 or wanted > _MOST_NODES:
            break
        wanted *= 4
    if len(places) < _FEWEST_PLACES:
        other = "the projector" if solution.calibration.projector else "another camera"
        whose = f" together with {other}" if solution.calibration.triangulates else ""
        message = (
            f"expected places in the box of {_words(extent)} in which the board was held that the first camera sees"
            f"{whose}, found {len(places)} of {counts.prod()}; hold the board where all of it is in view"
        )
        raise CalibrationError(message)
    return volume_mm, places


def _moved(calibration: Calibration, places: FloatArray) -> Moved:
    return moved_points(list(calibration.cameras.values()), calibration.projector, places)


def _seen(calibration: Calibration, nodes: FloatArray) -> NDArray[np.bool_]:
    seen = _moved(calibration, nodes).seen
    if calibration.projector is None:
        return seen
    first = next(iter(calibration.cameras.values()))
    return seen & _moved(Calibration({"first": first}, calibration.projector), nodes).seen


def _board_corners(solution: Solution, observations: Observations) -> FloatArray:
    """(n, 3) float64: every corner of the board in every pose that was used, in the world."""
    board = observations.board.points_mm
    if solution.board_shape_mm is not None:
        board = board + solution.board_shape_mm
    return np.concatenate([pose.placed(board) for pose in solution.poses.values()])


def _light_sigma_px(observations: Observations, calibration: Calibration) -> float:
    """What a scan makes of the light of the board's paper, along the axis that it triangulates by."""
    if calibration.projector is None:
        return float("nan")
    axis = triangulated_axis(list(calibration.cameras.values()), calibration.projector)
    wanted = COLUMN if axis is Axis.COLUMN else ROW
    found = [
        light.sigma_px[light.axis == wanted] for pose in observations.poses for light in pose.correspondences.values()
    ]
    sigma = np.concatenate([np.zeros(0), *found])
    return _FITTED * float(np.quantile(sigma, _PAPER)) if len(sigma) else float("nan")


def _length_share(places: FloatArray, fields: FloatArray, diagonal_mm: float) -> float:
    """Root mean square over many pairs of places, half a diagonal apart, of a length's deviation over that length."""
    paired = np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_PAIRED)).astype(int))
    first, second = (paired[index] for index in np.triu_indices(len(paired), 1))
    length = np.linalg.norm(places[second] - places[first], axis=1)
    right = np.abs(length / (diagonal_mm / 2) - 1) <= _LENGTH_TOLERANCE
    if not right.any():
        return float("nan")
    first, second, length = first[right], second[right], length[right]
    taken = np.unique(np.linspace(0, len(first) - 1, min(len(first), _LENGTHS)).astype(int))
    first, second, length = first[taken], second[taken], length[taken]
    direction = (places[second] - places[first]) / length[:, None]
    changes = np.einsum("ni,nik->nk", direction, fields[second] - fields[first])
    return _rms(np.sqrt((changes**2).sum(axis=1)) / length)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _words(extent: FloatArray) -> str:
    return " x ".join(f"{side:.0f}" for side in extent) + " mm"

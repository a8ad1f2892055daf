"""An independent check of a solve: its odd poses and its even ones, solved apart, against what is stated for them.

Neither half sees an observation of the other, so that what they differ by is an error that was measured, not derived.
Points in the volume move by G(X) (θ_odd - θ_even) from one half to the other (`slrig.calibration.displacement`), less
the rigid motion that is nearest to it, as the stated error is; mrcal compares two models of a camera in that way
(mrcal.secretsauce.net/differencing.html). The halves' covariances C state a variance for it, Σ rᵀ G C Gᵀ r along the
viewing ray r, of the mean square over the volume: E = Σ_k λ_k, with the eigenvalues λ_k of the mean of G C Gᵀ's part
along r. If C holds, the mean square is Σ_k λ_k z_k² with normal z, near E χ²_ν / ν with ν = (Σ λ)² / Σ λ²
(Satterthwaite 1946).

A half has half of the poses, and so about √2 times the error of the whole, and the difference of two of them twice.

What both halves share shows in neither: the size and the stretch of the board, a print that is off, what changes slowly
from the first pose to the last, and whatever the lens model leaves out everywhere alike. The halves' covariances leave
the board's size out, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slrig.calibration.displacement import RigidMotion, modes_of, moved_points, rigid_free, without_rigid_motion
from slrig.calibration.solution import Solution
from slrig.model import FloatArray

LEAST_CHANCE = 0.003
"""Of a difference that is put down to chance: what lies beyond three standard deviations of a normal error."""


@dataclass(frozen=True, slots=True)
class OddEven:
    """How far two halves of the poses, solved apart, put points in the volume from one another.

    poses : how many each half has. difference_mm : root mean square over the volume, along the first camera's viewing
    ray, of one camera alone across it. stated_mm : what the two halves state for it, one standard deviation. chance :
    of a difference at least as large, if what is stated holds. motion : the rigid motion that was taken out before.
    """

    poses: tuple[int, int]
    difference_mm: float
    stated_mm: float
    chance: float
    motion: RigidMotion

    @property
    def ratio(self) -> float:
        """The difference over what is stated for it: about 1 where stated errors hold."""
        return self.difference_mm / self.stated_mm

    @property
    def fits(self) -> bool:
        """Whether the difference may be chance."""
        return self.chance >= LEAST_CHANCE

    @property
    def words(self) -> str:
        """What was found, and what to do where it does not fit."""
        told = (
            f"odd and even poses, solved apart, differ by {self.difference_mm:.2g} mm at a point, "
            f"{self.ratio:.2g} × what is stated for two halves"
        )
        if self.fits:
            return f"{told} ({self.motion.words} taken out)"
        return (
            f"{told}, more than chance: reckon with {self.difference_mm / 2:.2g} mm for the error of a point, besides "
            "what the board's size makes of it; see that the board is stiff, and that devices, focus and temperature "
            "stay as they are from pose to pose; shoot more poses, all over the volume"
        )


def odd_even(solution: Solution, places_mm: FloatArray, /) -> OddEven | None:
    """Compare the halves of a solution at places (n, 3) in its volume; None where it has none."""
    if len(solution.halves) < 2:
        return None
    odd, even = solution.halves
    calibration = solution.calibration
    moved = moved_points(list(calibration.cameras.values()), calibration.projector, places_mm)
    moves = moved.by_parameter @ (odd.change - even.change)
    _, motion = without_rigid_motion(places_mm, places_mm + moves)
    modes = np.concatenate([modes_of(odd.covariance), modes_of(even.covariance)], axis=1)
    off, fields = (
        moved.stated @ rigid_free(places_mm, each) for each in (moves[:, :, None], moved.by_parameter @ modes)
    )
    # Of the mean square over the volume: Σ over places of the stated parts, as a quadratic form of independent modes.
    flat = fields.reshape(-1, fields.shape[2]) / np.sqrt(len(places_mm))
    form = flat.T @ flat
    square, variance = float((off**2).sum()) / len(places_mm), float(np.trace(form))
    freedom = variance**2 / float((form**2).sum())
    return OddEven(
        poses=(len(odd.poses), len(even.poses)),
        difference_mm=float(np.sqrt(square)),
        stated_mm=float(np.sqrt(variance)),
        chance=_beyond(freedom * square / variance, freedom),
        motion=motion,
    )


def _beyond(value: float, freedom: float) -> float:
    """The chance that χ² with this freedom is larger."""
    # Late: the service knows the values of this module, and computes none of them.
    from scipy.special import chdtrc

    return float(chdtrc(freedom, value))

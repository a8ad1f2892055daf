"""What a scan may be wrong by now: the change since the calibration and its own error, carried to points in space.

Each hypothesis h of what changed (`slrig.calibration.health.drift`) gives the parameters' deviation from the
calibration a mean m_h and modes P_h. With F what they do to a point along the first camera's ray, the rigid motion
nearest to it taken out, the expected square of the error is Σ_h w_h mean((F m_h)² + Σ_k (F P_h)_k²) over places in the
volume. A calibration that nothing changed gives what it stated of itself, less what the verification by the board has
taught.

Only hypotheses that what was seen makes likelier than no change count. Of a device that the verification did not see
each is as likely as before, and would bring in all that may ever happen to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.calibration.displacement import modes_of, moved_points, rigid_free
from slrig.calibration.health.devices import covariance_of
from slrig.calibration.health.drift import Change, Hypothesis
from slrig.model import Calibration, FloatArray

_STEPS = 7
_FEWEST = 30
_LIKELY = 1e-4


@dataclass(frozen=True, slots=True)
class ErrorNow:
    """Expected error of a point along the first camera's viewing ray, mm, rms over the volume, without noise.

    now_mm : with what changed since. stated_mm : from the calibration alone, over the same places. drift_mm : what the
    change itself makes, by the likeliest hypothesis that has one, 0 where none is likely.
    """

    now_mm: float
    stated_mm: float
    drift_mm: float


def error_now(ranked: Sequence[Hypothesis], calibration: Calibration, volume_mm: FloatArray, /) -> ErrorNow:
    """Carry what changed to the volume, (2, 3) mm, opposite corners of a box in the world.

    NaN where the devices share too little of it.
    """
    carry = carried(calibration, volume_mm)
    if carry is None:
        return ErrorNow(float("nan"), float("nan"), float("nan"))
    places, by_parameter, ray = carry

    def rms(changes: FloatArray) -> float:
        fields = rigid_free(places, by_parameter @ changes.reshape(len(changes), -1))
        return float(np.sqrt((np.einsum("ni,nik->nk", ray, fields) ** 2).sum(axis=1).mean()))

    likely = [each for each in ranked if each.weight > _LIKELY and (each.evidence > 0 or each.kind is Change.NONE)]
    square = sum(each.weight * (rms(each.mean) ** 2 + rms(each.modes) ** 2) for each in likely)
    square /= sum(each.weight for each in likely)
    best = ranked[0]
    return ErrorNow(
        now_mm=float(np.sqrt(square)),
        stated_mm=rms(modes_of(covariance_of(calibration))),
        drift_mm=0.0 if best.kind is Change.NONE else rms(best.change),
    )


def carried(calibration: Calibration, volume_mm: FloatArray, /) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Places (n, 3) in the box that the devices see, how the parameters move them (n, 3, 15 d), and rays (n, 3)."""
    least, most = np.sort(volume_mm, axis=0)
    axes = [low + (high - low) * (np.arange(_STEPS) + 0.5) / _STEPS for low, high in zip(least, most, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cameras = list(calibration.cameras.values())
    moved = moved_points(cameras, calibration.projector, nodes)
    seen = moved.seen & np.isfinite(moved.by_parameter).all(axis=(1, 2))
    if calibration.projector is not None and len(cameras) > 1:
        seen &= moved_points(cameras[:1], calibration.projector, nodes).seen
    if seen.sum() < _FEWEST:
        return None
    places = nodes[seen]
    ray = places - cameras[0].centre_mm
    return places, moved.by_parameter[seen], ray / np.linalg.norm(ray, axis=1, keepdims=True)

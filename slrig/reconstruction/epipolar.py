"""How the stripes in a camera's image lie to the epipolar lines of another camera."""

from __future__ import annotations

import numpy as np

from slrig.model import Pinhole
from slrig.reconstruction.linking import StripeEnsemble
from slrig.reconstruction.optics import project, rays

_MOST_POINTS = 20_000  # their median is known to a hundredth of their scatter
_STEP = 1e-3  # of the baseline: far above rounding, and an epipolar line is straight over so little of it


def stripe_crossing(ensemble: StripeEnsemble, camera: Pinhole, other: Pinhole, /) -> float:
    """0 to 1: the sine of the angle at which stripes of `camera` cross the epipolar lines, the median of its points.

    The epipolar line of a pixel is the image of the plane that its ray and the baseline span, so from a point of the
    ray a step along the baseline leads along it, through the lens's distortion as well. 1 without a point.
    """
    taken = slice(None, None, max(1, len(ensemble.points_px) // _MOST_POINTS))
    pixels, normals = ensemble.points_px[taken], ensemble.normals[taken]
    baseline = other.centre_mm - camera.centre_mm
    points = camera.centre_mm + np.linalg.norm(baseline) * rays(camera, pixels)
    along = project(camera, points + _STEP * baseline) - pixels
    length = np.linalg.norm(along, axis=1)
    seen = length > 0
    if not seen.any():
        return 1.0
    return float(np.median(np.abs(np.einsum("ni,ni->n", along[seen], normals[seen])) / length[seen]))


def runs_down(ensemble: StripeEnsemble, /) -> bool:
    """Whether the stripes run rather down the image than across it."""
    across, down = np.abs(ensemble.normals).sum(axis=0)
    return bool(across >= down)

"""The projector's light over its image, from a scan of a plain white board."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slrig.errors import CalibrationError
from slrig.model import AlbedoMark, Calibration, LightMap, light_map_coordinates
from slrig.scan.colouring import coloured, places_px
from slrig.scan.measured import Entered, measured

_CELLS = 24  # along each side of the image: light is smooth over one, and noise and paper's grain are not
_LEAST_POINTS = 10
_MOST_SATURATED, _MOST_BENT, _MOST_UNSEEN, _MOST_UNEVEN = 0.02, 0.02, 0.75, 0.02
_DEGREE = 4


def with_light_map(bundle: Path, entered: Entered) -> Calibration:
    """The calibration of a scan of a plain white board, with the projector's light as the board shows it.

    What the board sends back, over cosine and squared distance, is the light's share; its logarithm is fitted by a
    polynomial over the image, in each channel that the scan has. Between channels that makes the board white.

    Raises
    ------
    CalibrationError
        The scan has no calibrated projector, or is of no board: not flat, not even, overexposed, or it covers too
        little of the projector's image. Further as `measured`.
    """
    walked, found = measured(bundle, None, None, entered, axis=None)
    projector, curves = found.agreement.calibration.projector, found.merged.curves
    if projector is None:
        message = f"{bundle}: expected a scan by a calibrated projector, found none; calibrate the rig with it"
        raise CalibrationError(message)
    away = curves.points_mm - curves.points_mm.mean(axis=0)
    extents, axes = np.linalg.eigh(away.T @ away)
    normals = np.tile(axes[:, 0] * np.sign(axes[:, 0] @ (projector.centre_mm - curves.points_mm[0])), (len(away), 1))
    seen = coloured(found.cameras, found.merged, normals.astype(np.float32), projector, walked.axis)
    places = places_px(curves, walked.axis)
    value, good = seen.found.value, (seen.mark == AlbedoMark.NONE) & (seen.found.value > 0).all(axis=1)
    # Of each cell of the image: the mean place, and the mean logarithm of what the board sends back.
    column, row = (np.clip((light_map_coordinates(places[good], projector.size) + 1) / 2, 0, 0.9999) * _CELLS).astype(
        int
    )
    cell = row * _CELLS + column
    counts = np.bincount(cell, minlength=_CELLS**2)
    known = counts >= _LEAST_POINTS
    middles, logs = (
        np.stack([np.bincount(cell, each, _CELLS**2)[known] / counts[known] for each in values[good].T], axis=1)
        for values in (places, np.log(np.maximum(value, 1e-9)))
    )
    powers = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)])
    terms = np.prod(light_map_coordinates(middles, projector.size).T[:, None] ** powers, axis=2)
    fitted = np.linalg.lstsq(terms, logs, rcond=None)[0]
    uneven = float(np.sqrt(((logs - terms @ fitted) ** 2).mean())) if known.any() else np.inf
    saturated = float((seen.mark == AlbedoMark.SATURATED).mean())
    bent, unseen = float(np.sqrt(max(extents[0], 0) / extents[2])), 1 - float(known.mean())
    for much, most, words in (
        (saturated, _MOST_SATURATED, "is saturated: expose for less"),
        (bent, _MOST_BENT, "stands out of a plane: show a flat board alone"),
        (unseen, _MOST_UNSEEN, "of the projector's image shows no board: use a larger or a nearer one"),
        (uneven, _MOST_UNEVEN, "is left of a smooth fit: the board is stained, shines, or is not plain white"),
    ):
        if not much <= most:
            message = f"{bundle}: expected a plain white board, found that {much:.1%} {words}; {most:.0%} may"
            raise CalibrationError(message)
    coefficients = np.zeros((logs.shape[1], _DEGREE + 1, _DEGREE + 1))
    coefficients[:, powers[:, 0], powers[:, 1]] = fitted.T
    coefficients[:, 0, 0] -= logs.mean()
    light = LightMap(coefficients, np.array([middles.min(axis=0), middles.max(axis=0)]))
    return replace(walked.devices, light=light)

"""The devices of a calibration in the order of its covariance, and what a calibration says of its own error."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slrig.calibration.solution import PARAMETERS, PROJECTOR
from slrig.model import Calibration, FloatArray, Pinhole

EACH = len(PARAMETERS)


def devices_of(calibration: Calibration, /) -> Mapping[str, Pinhole]:
    """Cameras in order, then the projector where there is one."""
    light = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **light}


def covariance_of(calibration: Calibration, /) -> FloatArray:
    """(15 d, 15 d) float64; zeros where the calibration says nothing of its own error."""
    if calibration.solved is not None:
        return calibration.solved.covariance
    return np.zeros((EACH * len(devices_of(calibration)),) * 2)


def block(calibration: Calibration, names: tuple[str, ...], /) -> FloatArray:
    """(15 k, 15 k) float64: the covariance of k devices."""
    order = list(devices_of(calibration))
    rows = np.concatenate([np.arange(EACH * order.index(name), EACH * (order.index(name) + 1)) for name in names])
    return np.asarray(covariance_of(calibration)[np.ix_(rows, rows)], dtype=np.float64)


def device_words(name: str) -> str:
    """A device as the subject of a sentence."""
    return "the projector" if name == PROJECTOR else f"camera '{name}'"

"""The camera's sensor: electrons, shot noise, read noise, saturation, gain and quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import kernel
from slrig.model import Pixels


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A linear sensor, and the camera's own processing behind it, if there is any.

    value = pedestal_dn + gain * electrons * (full scale - pedestal_dn) / full_well_e, clipped; then
    full scale * (value / full scale) ^ response, rounded. response : 1 of machine vision cameras, about 0.45 of
    webcams, whose pictures are made for displays.

    saturation_s : the exposure at which a white diffuser, at the working distance and facing the projector, fills
    the well under a white pattern.
    """

    bit_depth: int
    full_well_e: float
    read_noise_e: float
    saturation_s: float
    pedestal_dn: float
    response: float = 1.0

    @property
    def full_scale(self) -> int:
        """The value of a saturated sample."""
        return int(2**self.bit_depth - 1)

    def dn_per_electron(self, gain: float) -> float:
        """Conversion gain: digital numbers per electron."""
        return gain * (self.full_scale - self.pedestal_dn) / self.full_well_e

    def electrons(self, radiance: NDArray[np.float32], exposure_s: float) -> NDArray[np.float32]:
        """Expected electrons, same shape as `radiance` (a white diffuser gives 1). Not clipped at the full well."""
        return np.asarray(radiance * np.float32(self.full_well_e * exposure_s / self.saturation_s), np.float32)

    def read_out(self, electrons: NDArray[np.float32], *, gain: float, rng: np.random.Generator) -> Pixels:
        """(H, W) uint8 or uint16: one noisy reading of expected electrons (H, W) float32.

        Shot noise is a Gaussian of the Poisson law's variance: read noise hides the difference at few electrons.
        """
        draws = rng.standard_normal(electrons.shape, dtype=np.float32)
        out = np.zeros(electrons.shape, np.uint8 if self.bit_depth <= 8 else np.uint16)
        _digitise(
            electrons,
            draws,
            np.float32(self.full_well_e),
            np.float32(self.read_noise_e**2),
            np.float32(self.dn_per_electron(gain)),
            np.float32(self.pedestal_dn),
            np.float32(self.full_scale),
            np.float32(self.response),
            out,
        )
        return out


@kernel(in_every_scan=False)
def _digitise(
    electrons: NDArray[np.float32],
    draws: NDArray[np.float32],
    full_well: np.float32,
    read_variance: np.float32,
    dn_per_electron: np.float32,
    pedestal: np.float32,
    full_scale: np.float32,
    response: np.float32,
    out: Pixels,
) -> None:
    for r in range(electrons.shape[0]):
        for c in range(electrons.shape[1]):
            # The well clips the electrons, shot noise included; read noise comes after it.
            mean = electrons[r, c]
            held = min(mean + np.sqrt(mean + read_variance) * draws[r, c], full_well)
            value = pedestal + dn_per_electron * held
            if response != np.float32(1):
                share = min(max(value, np.float32(0)), full_scale) / full_scale
                value = full_scale * share**response
            out[r, c] = int(min(max(value + np.float32(0.5), np.float32(0)), full_scale))

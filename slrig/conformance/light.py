"""How bright a camera sees the projector: white is 1, black is 0, whatever the room, the noise and the sensor are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.conformance.expectation import ExpectationError, Failure, expect
from slrig.model import Pixels

LIT = 0.8
"""From this level on, a frame shows white."""

DARK = 0.2
"""Up to this level, a frame shows black."""

_LEAST_PIXELS = 16
_LEAST_SHARE = 0.001
_LEAST_OF_FULL_SCALE = 0.01
_NOISES = 6.0


@dataclass(frozen=True, slots=True)
class Light:
    """What one camera sees of the projector, learnt from a white and a black frame.

    lit : (H, W) bool, pixels that the projector lights. white, black : their mean in DN.
    """

    lit: NDArray[np.bool_]
    white: float
    black: float

    def level(self, image: Pixels) -> float:
        """How much of the projector's white is in a frame: 0 for black, 1 for white.
        Raises ExpectationError: the frame has another shape than those before it.
        """
        expect(
            image.shape == self.lit.shape,
            asked=f"every frame of a camera has one shape, {self.lit.shape}",
            found=image.shape,
            do="deliver frames of the extent that info.format declares",
        )
        return (float(image[self.lit].mean()) - self.black) / (self.white - self.black)


def learn_light(white: list[Pixels], black: list[Pixels], *, full_scale: int) -> Light:
    """Find out which pixels the projector lights, from two or more frames of each; the last ones count.
    Raises ExpectationError: white is not brighter than black anywhere.
    """
    shapes = {image.shape for image in (*white, *black)}
    expect(
        len(shapes) == 1,
        asked="every frame of a camera has one shape",
        found=sorted(shapes),
        do="deliver frames of the extent that info.format declares",
    )
    difference = _signed(white[-1]) - _signed(black[-1])
    threshold = max(_NOISES * _noise(white[-2:]), _LEAST_OF_FULL_SCALE * full_scale, 2.0)
    lit = difference > threshold
    if np.count_nonzero(lit) < max(_LEAST_PIXELS, _LEAST_SHARE * lit.size):
        failure = Failure(
            "the white pattern makes the camera's image brighter than the black one",
            f"{np.count_nonzero(lit)} of {lit.size} pixels brighter by {threshold:.1f} DN of {full_scale}, means "
            f"{white[-1].mean():.1f} and {black[-1].mean():.1f} DN",
            "point the camera at what the projector lights, switch the lamp on, open the aperture, and shade the room; "
            "if the picture is right, the driver delivers frames of an earlier pattern",
        )
        raise ExpectationError(failure)
    return Light(lit, float(white[-1][lit].mean()), float(black[-1][lit].mean()))


def _signed(image: NDArray[Any]) -> NDArray[np.float32]:
    return image.astype(np.float32)


def _noise(images: list[Pixels]) -> float:
    """Standard deviation of one frame, DN, from two of the same pattern; robust against what moves."""
    off = _signed(images[-1]) - _signed(images[0])
    return 1.4826 * float(np.median(np.abs(off - np.median(off)))) / float(np.sqrt(2))

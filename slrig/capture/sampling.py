"""Which pixels of a camera are looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.capture.checks import Samples
from slrig.model import Pixels, Size

_SAMPLES = 12_000
_BESIDE_PX = 3  # along rows and along columns


@dataclass(frozen=True, slots=True)
class Sampler:
    """A choice of pixels: random ones, so that no stripe pattern can lie in step with them.

    flat, row : (n,) index into the flattened image, and its row. The second half lies beside the first, on the
    diagonal: pairs cross edges of columns and of rows.
    """

    flat: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def of(cls, size: Size, candidates: NDArray[np.intp] | None = None) -> Sampler:
        """Draw from the flat indices `candidates`, or from the whole image."""
        rng = np.random.default_rng(0)
        height, width = size.shape
        # Each pixel once: a small image has fewer than are drawn.
        drawn = np.unique(rng.integers(0, height * width if candidates is None else len(candidates), _SAMPLES))
        rows, columns = np.divmod(drawn if candidates is None else candidates[drawn], width)
        all_rows = np.concatenate([rows, np.minimum(rows + _BESIDE_PX, height - 1)])
        all_columns = np.concatenate([columns, np.minimum(columns + _BESIDE_PX, width - 1)])
        return cls(all_rows * width + all_columns, all_rows)

    def take(self, image: Pixels) -> Samples:
        """The sampled pixels of an image."""
        return np.asarray(image.reshape(-1)[self.flat], dtype=np.float32)

"""A scan's points in the grid of a camera: `points-CAMERA.npz` as arrays."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float32]
    Bytes: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True)
class Cloud:
    """What each pixel (row, column) of a camera measured. Where it has no point, numbers are NaN.

    points_mm : (H, W, 3) float32, in the axes of the mesh. normals : (H, W, 3) float32. sigma_mm : (H, W) float32,
    standard deviation along the normal. colour : (H, W, 3) uint8, sRGB. mark : (H, W) uint8, as albedo_mark of
    mesh.ply. cause : (H, W) uint8, why a pixel has no point, 0 where it has one. causes : the name of each cause, by
    its number.
    """

    camera: str
    points_mm: Floats
    normals: Floats
    sigma_mm: Floats
    colour: Bytes
    mark: Bytes
    cause: Bytes
    causes: tuple[str, ...]

    @classmethod
    def read(cls, npz: bytes) -> Self:
        """A cloud of the bytes of its file."""
        import numpy as np

        with np.load(io.BytesIO(npz), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in cls.__dataclass_fields__}
        camera, causes = str(arrays.pop("camera")), tuple(map(str, arrays.pop("causes")))
        return cls(camera=camera, causes=causes, **arrays)

    @cached_property
    def albedo(self) -> Floats:
        """(H, W, 3) float32: `colour` as light, 0 to 1 (IEC 61966-2-1), NaN where there is no point."""
        import numpy as np

        value = np.arange(256) / 255
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
        return np.where(self.cause[..., None] == 0, light[self.colour], np.float32(np.nan))

"""Views in one frame, as one mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slrig.model import FloatArray, Mesh
from slrig.views.matching import moved, turned


def put_together(views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray) -> Mesh:
    """All views where their poses (4, 4) take them, one after another: nothing is merged, and surfaces lie double."""
    first = np.cumsum([0, *(len(view.vertices_mm) for view in views)])[:-1]
    return Mesh(
        vertices_mm=np.concatenate(
            [moved(pose, view.vertices_mm).astype(np.float32) for view, pose in zip(views, poses, strict=True)]
        ),
        faces=np.concatenate([view.faces + np.int32(begin) for view, begin in zip(views, first, strict=True)]),
        normals=np.concatenate(
            [turned(pose, view.normals).astype(np.float32) for view, pose in zip(views, poses, strict=True)]
        ),
        colour=np.concatenate([view.colour for view in views]),
        mark=np.concatenate([view.mark for view in views]),
        sigma_mm=np.concatenate([view.sigma_mm for view in views]),
        stripe=np.concatenate([view.stripe for view in views]),
    )

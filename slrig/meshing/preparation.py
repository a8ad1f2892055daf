"""Compile the kernels of meshing in a separate process while another compiles those that read the frames.

`python -m slrig.meshing.preparation` meshes a small synthetic sheet, so that the compiled kernels are on the disk. It
ends with its standard input, and so with the process that started it.
"""

from __future__ import annotations

import os
import sys
import threading

import numpy as np

from slrig.kernels import rare_garbage_collection
from slrig.meshing.facing import Viewpoints
from slrig.meshing.quality import mesh_figures
from slrig.meshing.surface import MeshingLimits, build_surface
from slrig.model import FlipRule

_CURVES, _POINTS = 16, 40  # a few hundred points: compiling takes the time
_LIMITS = MeshingLimits(
    widest_step_px=1.0, depth_edge_ratio=6.0, keep_holes=False, flip_rule=FlipRule.CONSTRAINED, smooth_boundary=True
)


def mesh_sample() -> None:
    """Mesh a wavy, noisy sheet with a ragged border, in arrays of the same types as a scan's."""
    random = np.random.default_rng(0)
    ragged = random.integers(0, 8, (_CURVES, 2))
    lengths = _POINTS - ragged.sum(axis=1)
    offsets = np.concatenate(([0], np.cumsum(lengths))).astype(np.int32)
    curve = np.repeat(np.arange(_CURVES), lengths)
    along = np.arange(offsets[-1]) - offsets[curve] + ragged[curve, 0]
    # Noisy enough that a turn of flips is undone, as in some scans.
    depth = 400 + np.sin(curve / 3) * np.cos(along / 7) + 0.3 * random.standard_normal(len(curve))
    points = np.column_stack((curve, 0.5 * along, depth))
    bridge = np.zeros(len(points), dtype=np.bool_)
    camera = np.zeros(len(points), dtype=np.int32)
    views = Viewpoints(np.zeros((1, 3)), camera, camera, np.zeros_like(points))
    surface = build_surface(
        points, offsets, curve.astype(np.float64), bridge, np.ones(len(points)), views, _LIMITS,
        on_step=lambda _: None,
    )  # fmt: skip
    mesh_figures(points, surface.faces)


def _end_with_input() -> None:
    # Not sys.stdin: at exit Python takes its lock, and aborts the process if a thread holds it.
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    with rare_garbage_collection():
        mesh_sample()

"""Our own method, through its public pipeline, measured by the stages that it reports as it goes."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import trimesh

from slrig.bundle.truth import SURFACE, VISIBLE
from slrig.model import Surface
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.bench.peers.measuring import Meter, Phase

FILE_STAGES = frozenset({"read bundle", "write mesh", "pictures", "compare with truth", "write report", "done"})
_LAST_OF_POINTS = "triangulate"


def copied_without_truth(bundle: Path, folder: Path) -> Path:
    """Copy a bundle without the truth, so that comparing with it costs nothing; the copy."""
    shutil.copytree(bundle, folder, ignore=shutil.ignore_patterns(SURFACE, VISIBLE, "truth-*.npz"))
    return folder


def reconstruct(bundle: Path, output: Path, meter: Meter) -> None:
    """Reconstruct a bundle into `output`; what follows triangulation, up to the first file, is meshing."""
    meshing = False

    def stage_entered(stage: str, _fraction: float, _detail: str) -> None:
        nonlocal meshing
        if stage in FILE_STAGES:
            meter.enter(Phase.FILES)
        else:
            meter.enter(Phase.MESH if meshing else Phase.POINTS)
            meshing = meshing or stage == _LAST_OF_POINTS

    reconstruct_bundle(bundle, output, plan=ReconstructionPlan(), progress=stage_entered, cancelled=lambda: False)


def read_mesh(output: Path) -> Surface:
    """Return the mesh that a reconstruction left in `output`."""
    mesh = trimesh.load_mesh(output / "mesh.ply", process=False)
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))

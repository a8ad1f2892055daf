"""The planes of an empty turntable from the files of a scan. Run by the worker and by `slrig turntable planes`."""

from __future__ import annotations

from pathlib import Path

from slrig.combine.combining import read_mesh
from slrig.model import RotationAxis, TurntablePlane
from slrig.multiview import find_turntable_planes


def planes_in(mesh: Path, axis: RotationAxis | None) -> tuple[TurntablePlane, ...]:
    """The planes in a mesh.ply. Raises as `find_turntable_planes`, InvalidInputError, and StorageError."""
    return find_turntable_planes(read_mesh(mesh), axis)

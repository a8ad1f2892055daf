"""The points behind each capture of an acceptance test, on disk: FOLDER/points/POSITION-CAPTURE.npz."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from slrig.accept.evaluation import Evidence
from slrig.bundle.storage import refusals_of, write_file


def points_file(step: str, take: int) -> str:
    """Where the points of a capture lie below the folder of their test.

    >>> points_file("sphere-1", 0)
    'points/sphere-1-1.npz'
    """
    return f"points/{step}-{take + 1}.npz"


def keep_points(evidence: Evidence, folder: Path, step: str, take: int) -> None:
    """Write the points of a capture into the folder of its test. Raises StorageError."""
    packed = BytesIO()
    np.savez_compressed(
        packed,
        points_mm=evidence.points_mm.astype(np.float32),
        artefact=evidence.artefact,
        used=evidence.used,
        distances_mm=evidence.distances_mm,
        sigma_mm=evidence.sigma_mm.astype(np.float32),
    )
    path = folder / points_file(step, take)
    with refusals_of(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, packed.getvalue())


def kept_points(folder: Path, step: str, take: int) -> Evidence:
    """The points of a capture, coordinates and deviations to single precision. Raises StorageError."""
    path = folder / points_file(step, take)
    with refusals_of(path), np.load(path) as kept:
        return Evidence(
            kept["points_mm"].astype(np.float64),
            kept["artefact"],
            kept["used"],
            kept["distances_mm"],
            kept["sigma_mm"].astype(np.float64),
        )

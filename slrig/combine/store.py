"""Models on disk: DATA/models/ID/, each whole at every instant; see `slrig.combine.offered`.

What is being made lies in DATA/.incoming, and is renamed into place once. DATA/models/.ID is being deleted.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from slrig.combine.offered import REPORT
from slrig.errors import StorageError
from slrig.failure import disk_errors
from slrig.jobs.data_folder import DataFolder
from slrig.model import MeasuredAxis


class ModelStore:
    """The models of a data folder. One process uses it. Whatever writes raises StorageError when the disk refuses."""

    def __init__(self, folder: DataFolder) -> None:
        self._data = folder
        self._root = folder.root / "models"
        with disk_errors(self._root):
            self._root.mkdir(exist_ok=True)

    def place(self, model_id: UUID) -> Path:
        """Where the files of a model lie."""
        return self._root / str(model_id)

    def stage(self, model_id: UUID) -> Path:
        """Make a folder for the files of a model; what an attempt that was cut off has left there is removed."""
        self._data.discard(model_id)
        return self._data.stage(model_id)

    def commit(self, model_id: UUID) -> None:
        """Move a staged model into place, whole and durable."""
        self._data.put(model_id, self.place(model_id))

    def withdraw(self, model_id: UUID) -> None:
        """Take the files of a model out of place by one rename: the first half of a deletion. Idempotent."""
        if self.place(model_id).exists():
            with disk_errors(self._root):
                self.place(model_id).rename(self._withdrawn(model_id))

    def discard(self, model_id: UUID | str) -> None:
        """Remove what was withdrawn. Idempotent."""
        shutil.rmtree(self._withdrawn(model_id), ignore_errors=True)

    def withdrawn(self) -> Sequence[str]:
        """The ids of models whose deletion was cut off."""
        return [place.name.removeprefix(".") for place in self._root.iterdir() if place.name.startswith(".")]

    def put_aside(self, known: set[UUID]) -> Sequence[str]:
        """Move what is no model on record to DATA/.orphans; return the names."""
        names = set(map(str, known))
        strays = [place for place in self._root.iterdir() if place.name not in names]
        for stray in strays:
            self._data.orphans.mkdir(exist_ok=True)
            stray.rename(self._data.orphans / f"model-{stray.name}")
        return sorted(stray.name for stray in strays)

    def _withdrawn(self, model_id: UUID | str) -> Path:
        return self._root / f".{model_id}"


def summary(model: Path) -> dict[str, Any]:
    """What a list says of a model, of the report in its folder. sigma_mm : of its vertices, the middle one.

    pose_sigma_mm : of the view that is known least. free : views that may move without a residual. notes : if there are
    any. Raises StorageError.
    """
    with _report(model) as report:
        return {
            "views": len(report["views"]),
            "pairs": len(report["pairs"]),
            "free": len({each["view"] for each in report["free"]}),
            "pose_sigma_mm": max(view["sigma_mm"] for view in report["views"]),
            **({"notes": report["notes"]} if report.get("notes") else {}),
            **{name: report["model"][name] for name in ("vertices", "triangles", "voxel_mm", "sigma_mm")},
        }


def found_axis(model: Path) -> MeasuredAxis | None:
    """The axis that a stage was found to turn about; None without a stage, or where motions were left as the start had
    them, and the axis with them. Raises StorageError.
    """
    with _report(model) as report:
        axis = report.get("axis")
        if axis is None or report["free"]:
            return None
        return MeasuredAxis(*(np.array(axis[name]) for name in ("point_mm", "direction", "covariance")))


@contextmanager
def _report(model: Path) -> Iterator[dict[str, Any]]:
    """A model's report. Raises StorageError: it cannot be read, or lacks what is looked for within the block."""
    try:
        yield json.loads((model / REPORT).read_bytes())
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{model / REPORT} cannot be read ({error}). Make the model again."
        raise StorageError(message) from error

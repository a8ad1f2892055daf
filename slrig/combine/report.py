"""What the report of a model says, read from its folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slrig.combine.offered import REPORT
from slrig.errors import StorageError
from slrig.model import MeasuredAxis


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

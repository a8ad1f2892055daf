"""The files of a model, by name. One list for the service and the command line. Loads nothing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

MODEL, MODEL_GLB, PLACED, POSES, REPORT = "model.ply", "model.glb", "placed.ply", "poses.json", "report.json"
SIDES, VIEW, COARSE = "sides.png", "view.glb", "coarse.glb"

MEDIA_TYPES: Mapping[str, str] = {
    MODEL: "application/octet-stream",
    MODEL_GLB: "model/gltf-binary",
    PLACED: "application/octet-stream",
    POSES: "application/json",
    SIDES: "image/png",
    VIEW: "model/gltf-binary",
    COARSE: "model/gltf-binary",
    REPORT: "application/json",
}
"""What every model has that succeeded."""

REPORT_FORMAT = "slrig-model"
"""Of its report, which is not that of a scan: a model never takes the place of one."""


def missing_files(model: Path) -> list[str]:
    """What a model that succeeded must have, and is not in its folder. A link is no file and no folder of ours."""
    is_ours = not model.is_symlink()
    return [
        name for name in MEDIA_TYPES if not (is_ours and (model / name).is_file() and not (model / name).is_symlink())
    ]

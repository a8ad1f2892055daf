"""The files of a model, by name. One list for the service and the command line. Loads nothing."""

from __future__ import annotations

from collections.abc import Mapping

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

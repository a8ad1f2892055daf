"""The stage of a rig, as a client reaches it: see `slrig.client.endpoints`."""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from slrig.client.core import Json, W
from slrig.client.operations import Remote, endpoint


class RigStage(Remote[W]):
    """The stage that turns objects: its axis, and the planes that models are cut by."""

    @endpoint("GET /rig/stage")
    def look(self) -> Json:
        """The axis, how well it is known, the planes, and whether both still hold."""

    @endpoint("GET /rig/stage.svg")
    def plot(self) -> str:
        """How the axis has moved, as SVG."""

    @endpoint("POST /rig/stage/axis")
    def calibrate(
        self, calibration: str, *, poses: Sequence[int] | None = None, angles_deg: Sequence[float] | None = None
    ) -> Json:
        """The axis, from poses of a board that stood on the stage. angles_deg : as the stage says, pose by pose."""

    @endpoint("POST /rig/stage/planes")
    def find_planes(self, scan: str) -> Json:
        """Plate and backdrops, from a scan of the empty stage."""

    @endpoint("PUT /rig/stage", content="document")
    def put(self, document: Mapping[str, Any] | str | bytes) -> Json:
        """Put back a document that was kept, in place of all that is known."""

    @endpoint("DELETE /rig/stage")
    def forget(self) -> None:
        """Forget axis, planes and history."""

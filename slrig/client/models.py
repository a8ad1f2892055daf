"""Models in the service's interface: made of scans on record, or shot; see `slrig.client.endpoints`."""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from slrig.client.core import Core, Json, W
from slrig.client.endpoints import IfBusy, done_to, file_of, paged, told_of
from slrig.client.errors import ModelFailedError
from slrig.client.events import Event
from slrig.client.operations import Operation, Remote, endpoint, entry, stream


class Models(Remote[W]):
    """Models: several scans of one object, made one mesh."""

    @endpoint("POST /model", once=True)
    def start(
        self,
        scans: Sequence[str],
        *,
        poses: Literal["turntable", "markers", "unknown"] | Sequence[Sequence[Sequence[float]]] | None = None,
        dictionary: str | None = None,
        angles_deg: Sequence[float] | None = None,
        axis: Mapping[str, Any] | None = None,
        start_error_mm: float | None = None,
        voxel_mm: float | None = None,
        cut: bool | None = None,
        label: str | None = None,
    ) -> Json:
        """Have scans made one mesh, and return the model as it is on record; `wait` returns it when it is over."""

    @endpoint("POST /model/shoot", once=True)
    def shoot(
        self,
        *,
        views: int | None = None,
        scan: Mapping[str, Any] | None = None,
        by_hand: bool | None = None,
        poses: Literal["turntable", "markers", "unknown"] | Sequence[Sequence[Sequence[float]]] | None = None,
        dictionary: str | None = None,
        axis: Mapping[str, Any] | None = None,
        start_error_mm: float | None = None,
        voxel_mm: float | None = None,
        cut: bool | None = None,
        label: str | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Have an object shot from all sides and the views made one mesh. scan : how, as `scans.start` takes it."""

    @endpoint("POST /model/{model_id}/view", once=True)
    def view(self, model_id: str, /, *, again: bool | None = None, if_busy: IfBusy | None = None) -> Json:
        """Shoot the next view, of an object that was turned by hand; or the last one again, in its place."""

    combine = entry("POST /model/{model_id}/combine", told_of, "Make a model of the views that were shot by hand.")

    list = entry("GET /model", paged, "A page of models from new to old: `models`, and `next`.")
    look = entry("GET /model/{model_id}", told_of, "A model: its state, how far it is, and where its files are.")
    delete = entry("DELETE /model/{model_id}", done_to, "Delete a model that is over with all its files.")
    cancel = entry("POST /model/{model_id}/cancel", told_of, "Ask a model to stop.")
    file = entry("GET /model/{model_id}/{name}", file_of, "A file of a model, by its name.")

    @stream("GET /model/{model_id}/events", Core.follow)
    def follow(self, model_id: str) -> Event:
        """What happens to a model until it is over, from its beginning."""

    @Operation
    async def wait(self, model_id: str) -> Json:
        """The model once it is over. `Client.fetch` writes a file of its `links`.

        Raises
        ------
        ModelFailedError
            It did not succeed.
        """
        path = f"/model/{model_id}"
        async for _ in self.core.follow(f"{path}/events"):
            pass
        model: Json = await self.core.content("Json", "GET", path)
        if model["state"] != "succeeded":
            raise ModelFailedError(model)
        return model

"""/model/shoot: have the views of a model shot, by the rig's turntable or by hand, and the model made of them."""

from __future__ import annotations

from typing import Annotated, Literal
from uuid import UUID

from fastapi import APIRouter, Body, Response
from pydantic import Field

from slrig.api.idempotency import IdempotencyKey, once, started_once
from slrig.api.models import MadeRequest, ModelBody, model_body
from slrig.api.openapi import problems
from slrig.api.schemas import ShotRequest, scan_plan
from slrig.api.service import Serving
from slrig.bundle import Strict
from slrig.calibrate.verification import require_healthy
from slrig.combine.plan import MOST_VIEWS, ShootPlan
from slrig.jobs.records import JobKind

router = APIRouter(prefix="/model", tags=["model"])

IfBusy = Annotated[
    Literal["reject", "queue"], Field(description="what to do while the rig is held: answer 409, or wait in line")
]


class ModelShootRequest(MadeRequest):
    """A model whose views are to be shot, evenly around the object. Poses, if given, are of all views."""

    views: Annotated[int, Field(ge=2, le=MOST_VIEWS)] = Field(default=8, description="how many")
    scan: ShotRequest = Field(default_factory=ShotRequest, description="how each is shot")
    manual: bool = Field(
        default=False,
        description="false: the rig's turntable turns the object. true: a person does; the first view is shot at once, "
        "each of the others by POST /model/{id}/view, and `progress` says when and how far to turn",
    )
    if_busy: IfBusy = "reject"


class ViewRequest(Strict):
    """The object was turned by hand."""

    again: bool = Field(
        default=False, description="shoot the last view once more in its place; the object was not turned on"
    )
    if_busy: IfBusy = "reject"


@router.post("/shoot", status_code=202, responses=problems(404, 409, 429, 503, 507))
def shoot_model(
    service: Serving,
    response: Response,
    request: Annotated[ModelShootRequest, Body(default_factory=ModelShootRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ModelBody:
    """Shoot an object from all sides, and make one mesh of the views. The answer comes at once; follow `links.events`.

    `/scan/series/{id}`, by the id of the model, has the views. One that a device failed is shot again, twice at most;
    the model is made of those that succeed, and `notes` of its summary tell of the others.
    """
    preset = None if request.scan.preset is None else service.presets.get(request.scan.preset)
    shoot = ShootPlan(request.views, scan_plan(request.scan, service.scan_defaults, preset), request.manual)
    plan = request.plan((), shoot=shoot)

    def start(key: str | None) -> UUID:
        health, _, _ = service.health.health()
        require_healthy(health, refuse_when_stale=service.refuse_when_stale)
        return service.shooting.shoot(plan, label=request.label, wait=request.if_busy == "queue", key=key).id

    record = started_once(service.keys, service.store, idempotency_key, "/model/shoot", request, start)
    response.headers["Location"] = f"/model/{record.id}"
    return model_body(service, record)


@router.post("/{model_id}/view", status_code=202, responses=problems(404, 409, 429, 503, 507))
def shoot_view(
    service: Serving,
    model_id: UUID,
    request: Annotated[ViewRequest, Body(default_factory=ViewRequest)],
    idempotency_key: IdempotencyKey = None,
) -> ModelBody:
    """Shoot the next view of a model whose object was turned by hand. After the last one the model is made."""

    def start(key: str | None) -> UUID:
        wait = request.if_busy == "queue"
        return service.shooting.shoot_view(model_id, again=request.again, wait=wait, key=key).id

    once(service.keys, idempotency_key, f"/model/{model_id}/view", request, start)
    return model_body(service, service.store.get(model_id, JobKind.MODEL))


@router.post("/{model_id}/combine", status_code=202, responses=problems(409, 507))
def combine_views(service: Serving, model_id: UUID) -> ModelBody:
    """Make a model that is shot by hand of the views that there are."""
    return model_body(service, service.shooting.combine(model_id))

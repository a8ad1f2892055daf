"""/model: combine scans of one object from several sides into one mesh, or shoot its views; follow, fetch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal, Self
from uuid import UUID

from fastapi import APIRouter, Body, Response
from pydantic import BaseModel, Field, model_validator

from slrig.api.files import KnownTag, file_answers, kept_file, refuse_absent, require_whole
from slrig.api.problems import problems
from slrig.api.schemas import (
    AskedPlan,
    JobBody,
    JobLinks,
    ListedJob,
    NewName,
    ShotRequest,
    filled,
    listed_links,
    scan_plan,
)
from slrig.api.service import Cursor, IdempotencyKey, PageLength, Service, Serving, once, paged, started_once
from slrig.bundle import MAX_VIEWS, AxisEntry, FreeText, PoseEntry, SafeText, Strict, orthonormalise_pose
from slrig.calibrate.verification import require_healthy
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.model_jobs.plan import (
    MARKER_DICTIONARY,
    MEDIA_TYPES,
    MOST_VIEWS,
    SIDES,
    START_ERROR_MM,
    GivenPoses,
    MarkerPoses,
    ModelPlan,
    ShootPlan,
    StartingPoses,
    StatedAxis,
    TurntablePoses,
    UnknownPoses,
)

router = APIRouter(prefix="/model", tags=["model"])


class MadeRequest(Strict):
    """Options of a model from its scans, whether those are on record or still to be shot."""

    poses: Literal["turntable", "markers", "unknown"] | Annotated[list[PoseEntry], Field(max_length=MAX_VIEWS)] = Field(
        default="turntable",
        description='about where the scans belong. "turntable": a turntable turned the object. "markers": '
        'printed ones turn with it. "unknown": found from what they see, or refused, as of an object that is '
        "symmetric. Or of each scan a motion, 4 × 4, that takes its mm "
        "to a common frame",
    )
    dictionary: Annotated[SafeText, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description=f"OpenCV's name for that of the markers. Default: {MARKER_DICTIONARY}"
    )
    axis: AxisEntry | None = Field(
        default=None, description="of a turntable, in the scans' frame. Default: the turntable's own, where it is known"
    )
    start_error_mm: Annotated[float, Field(ge=0.01, le=100)] = Field(
        default=START_ERROR_MM, description="how far a surface may be from where poses, or angles and axis, put it"
    )
    voxel_mm: Annotated[float, Field(ge=0.001, le=1000)] | None = Field(
        default=None, description="length of the model's edges. Default: 1.25 times that of the scans'"
    )
    cut: bool = Field(
        default=True,
        description="whether plate and backdrops, where the turntable's planes are known, are cut away first",
    )
    label: FreeText | None = Field(default=None, description="free text, to find the model again")

    @model_validator(mode="after")
    def _of_a_turntable(self) -> Self:
        given = [name for name in ("angles_deg", "axis") if getattr(self, name, None) is not None]
        if self.poses != "turntable" and given:
            message = f'{given[0]}: expected "poses": "turntable" with it, found other poses; leave one of them out'
            raise ValueError(message)
        if self.poses != "markers" and self.dictionary is not None:
            message = 'dictionary: expected "poses": "markers" with it, found other poses; leave one of them out'
            raise ValueError(message)
        return self

    def plan(
        self, scans: Sequence[UUID], *, angles_deg: Sequence[float] | None = None, shoot: ShootPlan | None = None
    ) -> ModelPlan:
        """The requested plan. Raises ConfigError: see `ModelPlan`."""
        poses: StartingPoses
        if self.poses == "unknown":
            poses = UnknownPoses()
        elif self.poses == "markers":
            poses = MarkerPoses(self.dictionary or MARKER_DICTIONARY)
        elif self.poses != "turntable":
            poses = GivenPoses.of(map(orthonormalise_pose, self.poses))
        else:
            axis = None if self.axis is None else StatedAxis.of(self.axis.point_mm, self.axis.direction)
            poses = TurntablePoses(axis, None if angles_deg is None else tuple(angles_deg))
        return ModelPlan(
            tuple(scans), poses, start_error_mm=self.start_error_mm, voxel_mm=self.voxel_mm, cut=self.cut, shoot=shoot
        )


class ModelRequest(MadeRequest):
    """A model of scans on record."""

    scans: Annotated[list[Annotated[UUID, Field(strict=False)]], Field(min_length=2, max_length=MAX_VIEWS)] = Field(
        description="ids of scans that succeeded; the model is in the frame of the first"
    )
    angles_deg: Annotated[list[float], Field(max_length=MAX_VIEWS)] | None = Field(
        default=None,
        description="of a turntable: its angle at each scan, right-handed about its axis. Default: as the "
        "scans' reports say",
    )


class ModelBody(JobBody):
    """A model on record. `plan` has the axis and the angles that it is made with."""

    plan: AskedPlan[ModelPlan]
    pinned: bool = Field(description="kept, also where the settings remove old models")
    links: JobLinks


class ListedModel(ListedJob):
    """A model in a list."""

    views: int | None = Field(description="how many it was made of; null before")


class ModelPage(BaseModel):
    """Models from new to old. `next` is the path of the next page, null on the last."""

    models: list[ListedModel]
    next: str | None


@router.post("", status_code=202, responses=problems(404, 409, 429, 503, 507))
def start_model(
    service: Serving, response: Response, request: ModelRequest, idempotency_key: IdempotencyKey = None
) -> ModelBody:
    """Make one mesh of scans. It takes no rig, and the answer comes at once; follow `links.events` for the rest."""
    models = service.models

    def start(key: str | None) -> UUID:
        plan = request.plan(request.scans, angles_deg=request.angles_deg)
        return models.combine(plan, label=request.label, key=key).id

    record = started_once(service.keys, service.store, idempotency_key, "/model", request, start)
    response.headers["Location"] = f"/model/{record.id}"
    return model_body(service, record)


@router.get("")
def list_models(service: Serving, response: Response, cursor: Cursor = None, limit: PageLength = 50) -> ModelPage:
    """List models from new to old."""
    store = service.store

    def found(most: int) -> Sequence[JobRecord]:
        return store.page(JobKind.MODEL, before=cursor, limit=most)

    shown, following = paged(found, limit, "/model", service, response)
    return ModelPage(models=[_listed(service, record) for record in shown], next=following)


@router.get("/{model_id}")
def look_at_model(service: Serving, model_id: UUID) -> ModelBody:
    """Return a model: its state, its progress, and links to its files."""
    return model_body(service, service.store.get(model_id, JobKind.MODEL))


@router.patch("/{model_id}", responses=problems(507))
def rename_model(service: Serving, model_id: UUID, request: NewName) -> ModelBody:
    """Give a model another name."""
    return model_body(service, service.rename(model_id, JobKind.MODEL, request.label))


@router.post("/{model_id}/cancel", status_code=202)
def cancel_model(service: Serving, model_id: UUID) -> ModelBody:
    """Request a model and its views to stop. May be repeated; one that is over stays as it is."""
    return model_body(service, service.shooting.cancel(model_id))


@router.put("/{model_id}/pin")
def pin_model(service: Serving, model_id: UUID) -> ModelBody:
    """Keep a model, also where the settings remove old ones. DELETE ends that."""
    return model_body(service, service.store.pin(model_id, JobKind.MODEL, pinned=True))


@router.delete("/{model_id}/pin")
def unpin_model(service: Serving, model_id: UUID) -> ModelBody:
    """Allow the removal of a model when it is old, where the settings say so."""
    return model_body(service, service.store.pin(model_id, JobKind.MODEL, pinned=False))


@router.delete("/{model_id}", status_code=204, responses=problems(409, 507))
def delete_model(service: Serving, model_id: UUID) -> None:
    """Delete a model that is over with all its files. Its scans stay."""
    service.store.get(model_id, JobKind.MODEL)
    service.manager.delete(model_id)


def _serve(name: str, media_type: str) -> Callable[..., Response]:
    def fetch(service: Serving, model_id: UUID, known: KnownTag = None) -> Response:
        record, path = service.store.get(model_id, JobKind.MODEL), service.models.place(model_id) / name
        if record.state is not JobState.SUCCEEDED or not service.folder.owns(path):
            refuse_absent(record, name)
        service.retention.reading(model_id)
        require_whole(service, record, path.parent, name)
        return kept_file(path, media_type, record, known)

    fetch.__doc__ = f"Return {name} of a model that succeeded. ETags and ranges are honoured."
    return fetch


for _name, _media_type in MEDIA_TYPES.items():
    router.add_api_route(
        f"/{{model_id}}/{_name}",
        _serve(_name, _media_type),
        methods=["GET"],
        response_class=Response,
        responses=file_answers(_media_type),
        operation_id=f"fetch_model_{_name.removeprefix('model.').replace('.', '_')}",
        summary=f"Fetch {_name} of a model",
    )


def _listed(service: Service, record: JobRecord) -> ListedModel:
    found = {name: (record.summary or {}).get(name) for name in ("views", "triangles", "sigma_mm")}
    links = listed_links(record, service.models.place(record.id) / SIDES, SIDES)
    return filled(ListedModel, record, error=record.fault, links=links, **found)


def model_body(service: Service, record: JobRecord) -> ModelBody:
    """A record as an answer."""
    here, place = f"/model/{record.id}", service.models.place(record.id)
    ready = [name for name in MEDIA_TYPES if record.state is JobState.SUCCEEDED and service.folder.owns(place / name)]
    files = {name: f"{here}/{name}" for name in ready}
    links = JobLinks(self=here, events=f"{here}/events", cancel=f"{here}/cancel", files=files)
    return filled(ModelBody, record, error=record.fault, links=links)


IfBusy = Annotated[
    Literal["reject", "queue"], Field(description="what to do while the rig is held: answer 409, or wait in line")
]


class ModelShootRequest(MadeRequest):
    """A model of views to be shot evenly around the object. Poses, if given, are of all views."""

    views: Annotated[int, Field(ge=2, le=MOST_VIEWS)] = Field(default=8, description="how many")
    scan: ShotRequest = Field(default_factory=ShotRequest, description="how each is shot")
    manual: bool = Field(
        default=False,
        description="false: the rig's turntable turns the object. true: a person does; the first view is shot at once, "
        "each of the others by POST /model/{id}/view, and `progress` says when and how far to turn",
    )
    if_busy: IfBusy = "reject"


class ViewRequest(Strict):
    """The object was turned manually."""

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
    the model is made of those that succeed, and `notes` of its summary name the others.
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
    """Shoot the next view of a model of a manually turned object. After the last one the model is made."""

    def start(key: str | None) -> UUID:
        wait = request.if_busy == "queue"
        return service.shooting.shoot_view(model_id, again=request.again, wait=wait, key=key).id

    once(service.keys, idempotency_key, f"/model/{model_id}/view", request, start)
    return model_body(service, service.store.get(model_id, JobKind.MODEL))


@router.post("/{model_id}/combine", status_code=202, responses=problems(409, 507))
def combine_views(service: Serving, model_id: UUID) -> ModelBody:
    """Make a model of a manually turned object of the views that there are."""
    return model_body(service, service.shooting.combine(model_id))

"""Probes, and what each kind of problem means."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response
from starlette.exceptions import HTTPException

from slrig.api.openapi import problems
from slrig.api.problems import answer, explanations, problem
from slrig.api.schemas import Explanation, Probe
from slrig.api.service import Service, Serving
from slrig.errors import StorageError
from slrig.scan.runner import RunnerStatus

router = APIRouter(tags=["system"])


@router.get("/livez", openapi_extra={"security": []})
async def livez() -> Probe:
    """Tell that the process answers."""
    return Probe(checks={"process": "ok"})


@router.get("/readyz", response_model=Probe, responses=problems(503), openapi_extra={"security": []})
def readyz(service: Serving) -> Response | Probe:
    """Tell whether a scan could start and end well: records, disk, rig, reconstruction. Touches no device.

    A rig that is held is well. `pending` names what is not ready yet and gets there by itself: the rig while it is
    opened, the reconstruction until its process has loaded its kernels, which the first time takes a minute.
    """
    status = service.runner.status()
    checks = {
        "records": _records(service),
        "disk": _disk(service),
        "rig": _rig(status),
        "reconstruction": status.reconstruction,
    }
    if all(found == "ok" for found in checks.values()):
        return Probe(checks=checks)
    wrong = "; ".join(f"{name}: {found}" for name, found in checks.items() if found != "ok")
    opening = status.facts is None and status.fault is None and not status.ending
    pending = [name for name, waits in (("rig", opening), ("reconstruction", status.preparing)) if waits]
    detail = f"The service runs and cannot scan: {wrong}"
    return answer(problem(503, "not-ready", detail, checks=checks, pending=pending))


@router.get("/problems/{name}", responses=problems(404, 422))
def explain_problem(name: Annotated[str, Path(max_length=64)]) -> Explanation:
    """Explain a kind of problem: what `type` in an error leads to."""
    text = explanations().get(name)
    if text is None:
        detail = f"There is no kind of problem '{name}'."
        raise HTTPException(404, detail)
    return Explanation(type=f"/problems/{name}", title=name.replace("-", " ").capitalize(), description=text)


def _records(service: Service) -> str:
    try:
        service.store.check()
    except StorageError as error:
        return str(error)
    return "ok"


def _disk(service: Service) -> str:
    try:
        service.folder.require_space(service.settings.min_free_bytes)
    except StorageError as error:
        return str(error)
    return "ok"


def _rig(status: RunnerStatus) -> str:
    if status.ending:
        return "the service is ending"
    if status.fault is not None:
        return status.fault
    if status.facts is not None:
        return "ok"
    return f"the rig is being opened: {status.opening}" if status.opening else "the rig is being opened"

"""/notices: the receivers of notices, the webhook, and test notices."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path
from pydantic import BaseModel, Field

from slrig.api.problems import problems
from slrig.api.schemas import filled
from slrig.api.service import Service, Serving
from slrig.config import NoticeKind
from slrig.schedule.notices import WebhookEntry

router = APIRouter(prefix="/notices", tags=["schedule"])

ReceiverName = Annotated[str, Path(max_length=64, description="of the receiver, such as webhook or mqtt")]


class ReceiverBody(BaseModel):
    """A receiver of notices. Only the host of its address is shown: the rest often contains a secret."""

    name: str
    host: str
    kinds: list[NoticeKind]
    fixed: bool = Field(description="it is in the service's settings, and cannot be changed by request")
    waiting: int = Field(description="notices that it has not taken yet")
    oldest_s: float = Field(description="for how long the oldest of them has waited")


class ReceiverList(BaseModel):
    """All receivers of notices."""

    receivers: list[ReceiverBody]


class TrialBody(BaseModel):
    """Result of a test notice."""

    taken: bool
    answer: str = Field(description="of the receiver, or why there was none")
    seconds: float
    sent: dict[str, Any] = Field(description="the notice")


@router.get("")
def list_receivers(service: Serving) -> ReceiverList:
    """List the receivers of notices: of failed and missed runs, changes of the rig's health, and finished jobs."""
    return _receivers(service)


@router.put("/webhook", responses=problems(507))
def set_webhook(service: Serving, request: Annotated[WebhookEntry, Body()]) -> ReceiverList:
    """Send notices to an address by POST, from now on and after a restart, in place of the one before. One in the
    service's settings cannot be changed.
    """
    service.receivers.set_webhook(request)
    return _receivers(service)


@router.delete("/webhook", status_code=204, responses=problems(422, 507))
def remove_webhook(service: Serving) -> None:
    """Send nothing more to the webhook that was set, nor what waits for it. May be repeated."""
    service.receivers.remove_webhook()


@router.post("/{receiver}/test", responses=problems(422))
def send_test_notice(service: Serving, receiver: ReceiverName) -> TrialBody:
    """Send one test notice now and return the result, within 15 s."""
    return filled(TrialBody, service.receivers.get(receiver).try_out())


def _receivers(service: Service) -> ReceiverList:
    outbox, found = service.store.outbox, []
    for name, sender in [*service.receivers.senders.items()]:
        waiting, oldest_s = outbox.waiting(name)
        found.append(
            ReceiverBody(
                name=name,
                host=sender.host,
                kinds=[*outbox.wanted.get(name, ())],
                fixed=name in service.receivers.fixed,
                waiting=waiting,
                oldest_s=oldest_s,
            )
        )
    return ReceiverList(receivers=found)

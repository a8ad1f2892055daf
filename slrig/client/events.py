"""What happens to a job, as it is told while it is followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened. number : rises from event to event. job : whose it is, where all jobs are followed. Of a
    kind that this client does not know, no more is told.
    """

    number: int
    job: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Event):
    """How far a job is. fraction : 0 to 1 of the whole. pose : of a calibration, its number."""

    stage: str = ""
    fraction: float = 0.0
    detail: str = ""
    pose: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateChange(Event):
    """The new state of a job or a calibration; `error` is the problem that it failed of."""

    state: str = ""
    error: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Captured(Event):
    """The rig is free of the job, whose frames are computed with from now on. pose : of a calibration, its number."""

    pose: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FileReady(Event):
    """A file of a scan can be fetched from now on."""

    name: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseChange(Event):
    """The new state of a pose of a calibration."""

    pose: int = 0
    state: str = ""
    error: Mapping[str, Any] | None = None


_KINDS: Mapping[str, type[Event]] = {
    "progress": Progress,
    "state": StateChange,
    "captured": Captured,
    "file": FileReady,
    "pose": PoseChange,
}


def event_of(number: int, kind: str, data: Mapping[str, Any]) -> Event:
    """An event as it was sent.

    >>> event_of(3, "file", {"name": "mesh.ply"})
    FileReady(number=3, job=None, name='mesh.ply')
    """
    found = _KINDS.get(kind, Event)
    known = {field.name for field in fields(found)} - {"number"}
    return found(number=number, **{name: value for name, value in data.items() if name in known})

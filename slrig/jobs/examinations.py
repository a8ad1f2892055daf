"""What each examination found last: one file a kind in the data folder. A command that ran without the service leaves
its file there, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import UUID

import structlog
from pydantic import BaseModel, Field, ValidationError

from slrig.bundle import write_file
from slrig.errors import StorageError
from slrig.jobs.data_folder import SCANS
from slrig.jobs.job import Job, Outcome
from slrig.jobs.records import JobKind, utc_now

EXAMINATIONS = (JobKind.DOCTOR, JobKind.LATENCY, JobKind.CONFORMANCE)

_log = structlog.get_logger(__name__)


class Examination(BaseModel):
    """What an examination found, and when."""

    at: datetime
    found: dict[str, Any] = Field(description="as the command prints it as JSON")


class Examinations:
    """The last examination of each kind: the `Group` of examinations."""

    def __init__(self, root: Path) -> None:
        """Root : of the data folder."""
        self._root = root

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:  # noqa: ARG002 - as it is called
        """See `Group`. One that cannot be kept is on the record of its job all the same."""
        if outcome is None or outcome.summary is None:
            return outcome or Outcome()
        try:
            keep(self._root, job.kind, outcome.summary)
        except StorageError as error:
            _log.warning("an examination could not be kept", kind=str(job.kind), cause=str(error))
        return outcome


def keep(data: Path, kind: str, found: Mapping[str, Any]) -> bool:
    """Keep what an examination found in a data folder, and return whether it is one. Raises StorageError."""
    is_one = (data / SCANS).is_dir()
    if is_one:
        write_file(data / f"{kind}.json", Examination(at=utc_now(), found=dict(found)).model_dump_json().encode())
    return is_one


def last_examination(data: Path, kind: str, rig: str) -> Examination | None:
    """What an examination found last on the rig of that name; None where nothing was, or what lies there is no such
    file.
    """
    try:
        kept = Examination.model_validate_json((data / f"{kind}.json").read_bytes())
    except (OSError, ValidationError):
        return None
    return kept if kept.found.get("rig") == rig else None

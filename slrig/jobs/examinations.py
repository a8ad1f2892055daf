"""What `slrig doctor` and `slrig conform` found last: one file each in the data folder, where a service finds it.

Both take the rig for themselves and open it more than once, so they are commands and no work of a service.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError

from slrig.bundle.storage import write_file
from slrig.jobs.data_folder import SCANS
from slrig.jobs.records import utc_now

ExaminedBy = Literal["doctor", "conform"]

_MOST_BYTES = 2**22


class Examination(BaseModel):
    """What one of the commands found, and when."""

    rig: str
    at: datetime
    found: dict[str, Any] = Field(description="as the command prints it as JSON")


def keep(data: Path, command: ExaminedBy, found: Mapping[str, Any]) -> bool:
    """Keep what a command found in a data folder, and return whether it is one. Raises StorageError."""
    if not (data / SCANS).is_dir():
        return False
    kept = Examination(rig=found["rig"], at=utc_now(), found=dict(found))
    write_file(data / f"{command}.json", kept.model_dump_json(indent=1).encode())
    return True


def last_examination(data: Path, command: ExaminedBy, rig: str) -> Examination | None:
    """What a command found last on the rig of that name; None where nothing was, or what lies there is no such file."""
    try:
        with (data / f"{command}.json").open("rb") as file:
            found = Examination.model_validate_json(file.read(_MOST_BYTES))
    except (OSError, ValidationError):
        return None
    return found if found.rig == rig else None

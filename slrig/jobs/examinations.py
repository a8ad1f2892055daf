"""What `slrig doctor` and `slrig conform` found last: one file each in the data folder, where a service finds it.

Both take the rig for themselves and open it more than once, so they are commands and no work of a service.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, ValidationError

from slrig.bundle import write_file
from slrig.jobs.data_folder import SCANS
from slrig.jobs.records import utc_now


class Examination(BaseModel):
    """What one of the commands found, and when."""

    at: datetime
    found: dict[str, Any] = Field(description="as the command prints it as JSON")


def keep(data: Path, command: str, found: Mapping[str, Any]) -> bool:
    """Keep what a command found in a data folder, and return whether it is one. Raises StorageError."""
    is_one = (data / SCANS).is_dir()
    if is_one:
        write_file(data / f"{command}.json", Examination(at=utc_now(), found=dict(found)).model_dump_json().encode())
    return is_one


def last_examination(data: Path, command: str, rig: str) -> Examination | None:
    """What a command found last on the rig of that name; None where nothing was, or what lies there is no such file."""
    try:
        kept = Examination.model_validate_json((data / f"{command}.json").read_bytes())
    except (OSError, ValidationError):
        return None
    return kept if kept.found.get("rig") == rig else None

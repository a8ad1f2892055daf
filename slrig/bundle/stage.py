"""stage.json: at which angle of its stage an object was shot, and what turned it. Absent where there is no stage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.faults import Strict, read_description_of
from slrig.bundle.storage import json_bytes, write_file
from slrig.errors import BundleError

FILE = "stage.json"
MOST_BYTES = 2**16


TurnedBy = Literal["table", "hand"]
"""What turns the object on its stage: the rig's turntable, or a person."""


class StageAngle(Strict):
    """Where the stage stood. angle_deg : right-handed about its axis, from wherever its owner counts. count : equal
    where a turntable's angles have one zero; None where nobody keeps that.
    """

    angle_deg: Annotated[float, Field(allow_inf_nan=False)]
    turned_by: TurnedBy
    count: Annotated[str, Field(max_length=80)] | None = None

    def document(self) -> dict[str, object]:
        """As stage.json and a scan's report have it."""
        return self.model_dump(exclude_none=True)


def write_stage(folder: Path, stage: StageAngle) -> None:
    """Put the angle beside the frames. Raises StorageError."""
    write_file(folder / FILE, json_bytes(stage.document()))


def read_stage(folder: Path) -> StageAngle | None:
    """The angle of a bundle, None where it has none. Raises BundleError: the file cannot be read, or is wrong."""
    path = folder / FILE
    if not path.exists():
        return None
    return read_description_of(path, StageAngle, "angle of a stage", most_bytes=MOST_BYTES, error=BundleError)

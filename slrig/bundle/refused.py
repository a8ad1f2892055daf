"""Frames that were refused, kept apart from those of the scan: `refused/` with its list, `refused/refused.json`.

Whoever looks for a cause wants to see them; whoever reads the bundle does not meet them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.description import CameraName
from slrig.bundle.faults import Strict, read_description_of
from slrig.errors import BundleError
from slrig.model import Shot

FOLDER = "refused"
LIST = "refused.json"
_MOST_BYTES = 16 * 2**20


@dataclass(frozen=True, slots=True)
class Refused:
    """One exposure that did not count: which pattern and camera, which attempt at that pattern, and why.

    shot : its frame; None where no frame came, and where it had been accepted and `delivered` before. left_out : the
    whole exposure is of no use to the camera, and is not shot again.
    """

    pattern: int
    camera: str
    attempt: int
    cause: str
    shot: Shot | None = None
    delivered: bool = False
    left_out: bool = False


class RefusedEntry(Strict):
    """One line of the list. `file` is None where no frame came; times are those of bundle.json."""

    pattern: Annotated[int, Field(ge=0)]
    camera: CameraName
    attempt: Annotated[int, Field(ge=1)]
    cause: str
    file: str | None = None
    exposure_s: Annotated[float, Field(gt=0)] | None = None
    time_s: float | None = None
    left_out: Literal[True] | None = None


class RefusedList(Strict):
    """The whole of refused.json. `ended` says why the scan ended before its last pattern, None if it did not."""

    format: Literal["slrig-refused"] = "slrig-refused"
    version: Literal[1] = 1
    ended: str | None = None
    frames: list[RefusedEntry]


def read_refused(folder: Path) -> tuple[Refused, ...]:
    """What was refused while the bundle in `folder` was captured, without the frames themselves; often nothing.
    Raises BundleError: the list is there and is not as slrig wrote it.
    """
    path = folder / FOLDER / LIST
    if not path.is_file():
        return ()
    listed = read_description_of(path, RefusedList, "list of refused frames", most_bytes=_MOST_BYTES, error=BundleError)
    return tuple(
        Refused(entry.pattern, entry.camera, entry.attempt, entry.cause, left_out=bool(entry.left_out))
        for entry in listed.frames
    )

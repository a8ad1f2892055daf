"""A turntable whose angles keep their zero from one opening of the rig to the next, or say that they do not."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import structlog
from pydantic import BaseModel, ValidationError

from slrig.bundle import write_file
from slrig.devices import Turntable
from slrig.disk import storage_errors
from slrig.errors import StorageError
from slrig.model import RotationAxis

SAME_PLACE_DEG = 0.1
"""How far a table's own count may be from where it was left: above any step of a motor, below any turn of a hand."""

FROM_THE_START = "start"
"""The count of a table that each opening brings to the same place."""

_log = structlog.get_logger(__name__)


class _LastPosition(BaseModel):
    """Where a table was left. at_deg : None while it turned. own_deg : by its own count."""

    count: str
    at_deg: float | None = None
    own_deg: float = 0.0


class CountedTurntable:
    """Implements `slrig.devices.Turntable` by another one, whose angles count from its opening.

    A table whose own count is as it was left goes on from the angle where it stands. One that turned when the service
    was killed, or that counts anew, has angles that have nothing to do with those from before: they are of another
    `count`. A hand that moves a table without a scale of its own is not noticed.

    count : equal for all angles with one zero. path : the file that keeps where it stands; its folder is made.
    """

    def __init__(self, table: Turntable, path: Path) -> None:
        self._table = table
        self._path = path
        self.count, self._offset_deg = FROM_THE_START, 0.0
        if table.opened_at_deg is not None:
            left = _left(path)
            if (
                left is not None
                and left.at_deg is not None
                and abs(left.own_deg - table.opened_at_deg) < SAME_PLACE_DEG
            ):
                self.count, self._offset_deg = left.count, left.at_deg + table.opened_at_deg - left.own_deg
            else:
                self.count = uuid4().hex
                _log.info("the turntable's angles count anew from where it stands", count=self.count)

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`."""
        return self._table.poses

    @property
    def axis(self) -> RotationAxis | None:
        """See `Turntable`."""
        return self._table.axis

    @property
    def angles_deg(self) -> Sequence[float]:
        """See `Turntable`."""
        return self._table.angles_deg

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`."""
        return self._table.opened_at_deg

    def move(self, index: int) -> None:
        """See `Positioner`."""
        if 0 <= index < len(self.angles_deg):
            self.turn(self.angles_deg[index])
        else:
            self._table.move(index)

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. Raises StorageError, and turns nothing, where the disk refuses to keep that it turns."""
        opened_deg = self._table.opened_at_deg
        if opened_deg is None:
            self._table.turn(angle_deg)
            return
        own_deg = angle_deg - self._offset_deg
        self._keep(_LastPosition(count=self.count))
        self._table.turn(own_deg)
        # If that is refused, the next opening counts anew.
        with suppress(StorageError):
            self._keep(_LastPosition(count=self.count, at_deg=angle_deg, own_deg=opened_deg + own_deg))

    def close(self) -> None:
        """See `Positioner`."""
        self._table.close()

    def _keep(self, standing: _LastPosition) -> None:
        with storage_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
        write_file(self._path, standing.model_dump_json().encode())


def _left(path: Path) -> _LastPosition | None:
    """Where the table was left, None where nobody knows. What cannot be read is not known either."""
    try:
        return _LastPosition.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        _log.warning("where the turntable was left cannot be read", path=str(path), cause=str(error))
        return None

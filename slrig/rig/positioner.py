"""What moves the board, as the service calls it: guarded like the other devices of the rig."""

from __future__ import annotations

from collections.abc import Sequence

from slrig.devices import USUAL, Positioner
from slrig.rig.watchdog import Calls

MOVE_LIMIT_S = 120.0
"""How long a move may take: a stage crosses its whole travel, a robot goes round an obstacle."""

_DEVICE = "the positioner"


class GuardedPositioner:
    """Implements `slrig.devices.Positioner` by another one, all calls by way of `calls`."""

    def __init__(self, positioner: Positioner, calls: Calls) -> None:
        self._positioner = positioner
        self._calls = calls

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`."""
        return self._positioner.poses

    def move(self, index: int) -> None:
        """See `Positioner`."""
        self._calls.make(_DEVICE, "move", MOVE_LIMIT_S, lambda: self._positioner.move(index))

    def close(self) -> None:
        """See `Positioner`."""
        self._calls.make(_DEVICE, "close", USUAL.call_s, self._positioner.close)

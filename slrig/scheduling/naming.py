"""The rig, borrowed in the name of a schedule: whoever is refused meanwhile reads which schedule holds it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from uuid import UUID

from slrig.devices import Rig
from slrig.scan.holding import ActiveCalibration
from slrig.scan.work import Holder, RunnerStatus
from slrig.sessions.calibration.calibrating import CalibratedRig


class NamedLender:
    """Implements `slrig.sessions.calibration.calibrating.CalibratedRig` by another one. Any thread may call.

    What a thread borrows inside `named` is held by that holder; everything else by the holder that it states.
    """

    def __init__(self, rig: CalibratedRig) -> None:
        self._rig = rig
        self._mine = threading.local()

    @contextmanager
    def named(self, holder: Holder) -> Iterator[None]:
        """Have what this thread borrows inside of the block held by `holder`."""
        self._mine.holder = holder
        try:
            yield
        finally:
            del self._mine.holder

    def borrow(
        self,
        work: Callable[[Rig, Callable[[], bool]], None],
        *,
        holder: Holder,
        wait: bool,
        ended: Callable[[Exception | None], None],
        begun: Callable[[UUID], None] = lambda _: None,
    ) -> UUID:
        """See `slrig.scan.runner.Runner`."""
        chosen: Holder = getattr(self._mine, "holder", holder)
        return self._rig.borrow(work, holder=chosen, wait=wait, ended=ended, begun=begun)

    def recall(self, loan: UUID) -> None:
        """See `slrig.scan.runner.Runner`."""
        self._rig.recall(loan)

    def status(self) -> RunnerStatus:
        """See `slrig.scan.runner.Runner`."""
        return self._rig.status()

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """See `slrig.scan.runner.Runner`."""
        self._rig.use_calibration(active)

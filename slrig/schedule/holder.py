"""Work with the rig in the name of a schedule: whoever is refused meanwhile reads which schedule holds it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from uuid import UUID

from slrig.calibrate.calibrating import CalibratedRig
from slrig.devices import Rig
from slrig.jobs.job import Holder
from slrig.rig.session import ActiveCalibration
from slrig.scan.runner import RunnerStatus


class NamedHolder:
    """Implements `slrig.calibrate.calibrating.CalibratedRig` by another one. Any thread may call.

    What a thread submits inside `named` holds the rig as that holder; everything else as the holder that it states.
    """

    def __init__(self, rig: CalibratedRig) -> None:
        self._rig = rig
        self._mine = threading.local()

    @contextmanager
    def named(self, holder: Holder) -> Iterator[None]:
        """Have what this thread submits inside of the block hold the rig as `holder`."""
        self._mine.holder = holder
        try:
            yield
        finally:
            del self._mine.holder

    def submit_work(
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
        return self._rig.submit_work(work, holder=chosen, wait=wait, ended=ended, begun=begun)

    def cancel_work(self, work_id: UUID) -> None:
        """See `slrig.scan.runner.Runner`."""
        self._rig.cancel_work(work_id)

    def status(self) -> RunnerStatus:
        """See `slrig.scan.runner.Runner`."""
        return self._rig.status()

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """See `slrig.scan.runner.Runner`."""
        self._rig.use_calibration(active)

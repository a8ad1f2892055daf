"""What nobody would see until it is too late, put into the outbox: runs that failed, a rig that moved."""

from __future__ import annotations

from typing import get_args

from sqlalchemy.orm import Session

from slrig.calibrate.verification import HealthStore, VerificationRecord
from slrig.calibration.health import HealthState
from slrig.config import NoticeKind
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.schedule.records import RunState, Schedule, ScheduledRun

TOLD: dict[RunState, NoticeKind] = {
    RunState(kind.removeprefix("run.")): kind for kind in get_args(NoticeKind) if kind.startswith("run.")
}
"""What becomes of a run that a person has to know of."""


def tell_run(outbox: Outbox, session: Session, schedule: Schedule, run: ScheduledRun) -> None:
    """As `slrig.schedule.store.Notice`: tell of a run that a person has to know of."""
    if run.state not in TOLD:
        return
    due = schedule.order.cron.local(run.due)
    what = f"{schedule.order.task} due {due:%Y-%m-%d %H:%M %z}"
    more = "" if run.count == 1 else f", {run.count} times"
    outbox.put(
        session,
        TOLD[run.state],
        f"{what} was {run.state}{more}: {run.reason or 'no reason is known'}",
        schedule={
            "id": str(schedule.id),
            "label": schedule.order.label,
            "task": str(schedule.order.task),
            "cron": schedule.order.cron.text,
            "time_zone": schedule.order.cron.time_zone,
        },
        run={
            "number": run.number,
            "due": run.due.isoformat(),
            "state": str(run.state),
            "reason": run.reason,
            "count": run.count,
        },
    )


class NoticedHealth(HealthStore):
    """The history of a rig's health, every change of which is told."""

    def __init__(self, database: Database, outbox: Outbox) -> None:
        super().__init__(database)
        self._outbox = outbox

    def added(self, session: Session, before: VerificationRecord | None, now: VerificationRecord) -> None:
        """Tell of a health that is another one than before. A first verification that finds all well is no news."""
        earlier = HealthState.UNKNOWN if before is None else before.health.state
        state = now.health.state
        if state is earlier or (before is None and state is HealthState.GOOD):
            return
        self._outbox.put(
            session,
            "health.changed",
            f"its health was {earlier} and is {state}: {'; '.join(now.health.reasons) or 'nothing is wrong'}",
            health={
                "before": str(earlier),
                "state": str(state),
                "reasons": list(now.health.reasons),
                "remedy": now.health.remedy,
                "verification": str(now.id),
                "calibration": now.calibration,
            },
        )

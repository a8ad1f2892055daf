"""The events of all jobs of the service, whatever their kind, in the order in which they came."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from uuid import UUID

from sqlalchemy import func, select

from slrig.jobs.records import JobEvent, reference
from slrig.jobs.store import EVERY_JOB, JobStore
from slrig.jobs.tables import EventRow, JobRow, record_of


class JobFeed:
    """What happens to the jobs of all stores of one database, until the service ends. Any thread may call."""

    def __init__(self, *stores: JobStore) -> None:
        self._stores = stores
        self.ended = False

    def events(self, *, after: int, limit: int) -> Sequence[JobEvent]:
        """The first events whose number is above `after`, at most `limit`; their data name the job: see `reference`.

        Numbers rise over all jobs, with gaps: those of a job go with it.
        """
        query = select(EventRow, JobRow).join(JobRow, JobRow.id == EventRow.job_id).where(EventRow.id > after)
        with self._stores[0].database.reading() as session:
            return [
                JobEvent(event.id, event.kind, {**event.data, "job": reference(record_of(job))}, UUID(job.id))
                for event, job in session.execute(query.order_by(EventRow.id).limit(limit))
            ]

    def last(self) -> int:
        """The number of the newest event, 0 before the first."""
        with self._stores[0].database.reading() as session:
            return session.scalar(select(func.max(EventRow.id))) or 0

    def watch(self, wake: Callable[[], None]) -> Callable[[], None]:
        """As `JobStore.watch`, for all jobs, and at the end."""
        ends = [jobs.watch(EVERY_JOB, wake) for jobs in self._stores]

        def unwatch() -> None:
            for end in ends:
                end()

        return unwatch

    def end(self) -> None:
        """Nothing more will happen in this run of the service."""
        self.ended = True
        self._stores[0].wake(EVERY_JOB)

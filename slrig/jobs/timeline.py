"""What a job did when, from its own record: how long it waited, captured and computed, and what each stage took."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise

from slrig.jobs.records import JobEvent, JobRecord, JobState

STAGES_S = "stages_s"
"""Where the summary of a job has the seconds of each stage of its computation, in their order."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A stretch of a job. inside : the name of the stretch that it is a part of, None where it is one of the job's."""

    name: str
    begin: datetime
    end: datetime
    inside: str | None = None

    @property
    def seconds(self) -> float:
        """How long it took."""
        return (self.end - self.begin).total_seconds()


def stages_of(record: JobRecord, events: Sequence[JobEvent]) -> Iterator[Stage]:
    """The states that an ended job was in, and below `computing` the stages of the computation, one after the other.

    Of those only the seconds are known: a stage that was entered twice is one here, and what was computed while frames
    still came lies a little late.
    """
    changes = [
        (event.data["state"], datetime.fromisoformat(event.data["time"])) for event in events if _is_state(event)
    ]
    for (state, begin), (_, end) in pairwise(changes):
        yield Stage(state, begin, end)
        if state == JobState.COMPUTING:
            for name, seconds in ((record.summary or {}).get(STAGES_S) or {}).items():
                following = begin + timedelta(seconds=seconds)
                yield Stage(name, begin, following, inside=state)
                begin = following


def _is_state(event: JobEvent) -> bool:
    return event.kind == "state" and "time" in event.data

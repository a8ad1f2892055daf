"""Cron text and a time zone as moments. The rules, daylight saving among them, are Debian cron's, by cronsim."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import islice, takewhile
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError

from slrig.errors import ScheduleError

_EXAMPLE = "'30 6 * * mon-fri' is 06:30 on working days"
_FIRST_REACH = timedelta(hours=2)


@dataclass(frozen=True, slots=True)
class Cron:
    """When a schedule is due.

    A time that the clocks skip in spring is due right after the gap; one that they repeat in autumn is due once. Times
    that come every hour or more often follow the hours that really pass.

    Raises
    ------
    ScheduleError
        The text is no cron expression, it never comes, or there is no such time zone.
    """

    text: str
    time_zone: str
    _zone: ZoneInfo = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "_zone", ZoneInfo(self.time_zone))
        except (KeyError, ValueError, OSError) as error:
            message = (
                f"time_zone: expected a name of the IANA database ('Europe/Berlin', 'UTC'), found {self.time_zone!r}"
            )
            raise ScheduleError(message) from error
        if len(self.text.split()) != 5:
            message = (
                f"cron: expected five fields (minute, hour, day of month, month, day of week), found {self.text!r}; "
                f"{_EXAMPLE}"
            )
            raise ScheduleError(message)
        try:
            never = next(self._moments(datetime(2024, 1, 1, tzinfo=UTC)), None) is None
        except CronSimError as error:
            message = f"cron: {error}, found {self.text!r}; {_EXAMPLE}"
            raise ScheduleError(message) from error
        if never:
            message = f"cron: {self.text!r} never comes; {_EXAMPLE}"
            raise ScheduleError(message)

    def after(self, moment: datetime) -> datetime:
        """The first due time later than `moment`, UTC."""
        return next(self._moments(moment))

    def upcoming(self, moment: datetime, count: int) -> tuple[datetime, ...]:
        """The next `count` due times later than `moment`, UTC."""
        return tuple(islice(self._moments(moment), count))

    def newest(self, first: datetime, last: datetime) -> datetime | None:
        """The last due time from `first` to `last`, both included, UTC; None if there is none."""
        reach = _FIRST_REACH
        # From the end backwards, in longer and longer stretches: after a long pause only the newest is wanted.
        while True:
            start = max(first, last - reach)
            found = None
            for found_due in self._from(start, last):
                found = found_due
            if found is not None or start == first:
                return found
            reach *= 8

    def count(self, first: datetime, last: datetime, *, most: int) -> int:
        """How many due times lie from `first` to `last`, both included; `most` stands for that many or more."""
        return sum(1 for _ in islice(self._from(first, last), most))

    def _from(self, first: datetime, last: datetime) -> Iterator[datetime]:
        return takewhile(lambda due: due <= last, self._moments(first - timedelta(seconds=1)))

    def local(self, moment: datetime) -> datetime:
        """A moment as clocks in the schedule's time zone show it."""
        return moment.astimezone(self._zone)

    def _moments(self, moment: datetime) -> Iterator[datetime]:
        for due in CronSim(self.text, moment.astimezone(self._zone)):
            yield due.astimezone(UTC)

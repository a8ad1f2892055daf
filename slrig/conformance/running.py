"""An examination: one thread that owns the rig's devices, and a limit to how long each check may take."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol, Self

from slrig.conformance.bench import RigBench
from slrig.conformance.catalogue import CHECKS
from slrig.conformance.check import Check
from slrig.conformance.expectation import Failure, NotApplicableError, failure_of
from slrig.conformance.report import Outcome, Report, Result
from slrig.devices import Rig
from slrig.errors import DeviceError
from slrig.model import PatternSequence

OPENING_LIMIT_S = 120.0
CHECK_LIMIT_S = 60.0
_CLOSING_LIMIT_S = 10.0
_EXPOSURES_PER_PATTERN = 8


class Progress(Protocol):
    """Told how far an examination is: the check, the fraction done (0 to 1), and a few words."""

    def __call__(self, stage: str, fraction: float, detail: str, /) -> None:
        """Take note."""
        ...


def run(
    open_rig: Callable[[], Rig],
    sequence: PatternSequence,
    *,
    progress: Progress = lambda _stage, _fraction, _detail: None,
    checks: Sequence[Check] = CHECKS,
    limit_s: float | None = None,
) -> Report:
    """Examine a rig by every check.

    Parameters
    ----------
    open_rig
        Opens the rig afresh; called several times, each time after the rig was closed.
    sequence
        Patterns that its projector can show, white and black first.
    progress
        Told about each check before and after it, in the caller's thread.
    limit_s
        How long a check may take. Default: a minute, and more for long exposures.

    Raises
    ------
    Exception
        What opening the rig for the first time raises: a rig that does not open cannot be examined.
    """
    begun_s = time.monotonic()
    results: list[Result] = []
    with Examination(open_rig, sequence, limit_s=limit_s) as examination:
        for count, each in enumerate(checks):
            progress(each.title, count / len(checks), "")
            results.append(examination.judge(each))
            progress(each.title, (count + 1) / len(checks), results[-1].outcome)
        return Report(examination.name, tuple(results), time.monotonic() - begun_s, examination.stopped)


@dataclass(slots=True)
class _Job:
    """Work for the owner thread, and what came of it."""

    work: Callable[[], Any]
    done: threading.Event = field(default_factory=threading.Event)
    value: Any = None
    error: Exception | None = None


class Examination:
    """A rig under examination. A context manager: entering it opens the rig, leaving it closes the rig.

    The devices belong to one thread. A check that does not return keeps it, and with it the devices: nothing else is
    asked of them any more, and `stopped` says so. Should the check come back later, the rig is closed then.
    """

    def __init__(self, open_rig: Callable[[], Rig], sequence: PatternSequence, *, limit_s: float | None = None) -> None:
        self._stand = RigBench(open_rig, sequence)
        self._limit_s = limit_s
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        # A device that never answers must not keep the program from ending.
        self._owner = threading.Thread(target=self._work, name="conformance", daemon=True)
        self._stuck = False
        self.name = ""
        self.stopped: str | None = None

    def __enter__(self) -> Self:
        self._owner.start()
        try:
            rig = self._opened()
        except BaseException:
            self._jobs.put(None)
            raise
        self.name = rig.name
        if self._limit_s is None:
            longest_s = max((settings.exposure_s for settings in rig.settings.values()), default=0.0)
            exposures = _EXPOSURES_PER_PATTERN * max(len(self._stand.sequence), 16) * max(len(rig.cameras), 1)
            self._limit_s = CHECK_LIMIT_S + exposures * longest_s
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._jobs.put(None)
        if not self._stuck:
            self._owner.join(_CLOSING_LIMIT_S)

    def judge(self, check: Check) -> Result:
        """Examine the rig by one check. Once the examination was stopped, no check is run any more."""
        if self.stopped is not None:
            return Result(check.name, check.title, Outcome.NOT_RUN, 0.0, reason=self.stopped)
        begun_s = time.monotonic()
        job = _Job(lambda: self._judged(check))
        if self._done(job, self._limit_s):
            if job.error is not None:
                raise job.error
            outcome, failure, reason = job.value
            return Result(check.name, check.title, outcome, time.monotonic() - begun_s, failure, reason)
        self._stuck = True
        self.stopped = (
            f"'{check.title}' did not return in {self._limit_s:g} s, and holds the devices, which have one owner: "
            "nothing more can be asked of them; end the program, unplug them if need be, and see that the projector "
            "is dark"
        )
        failure = Failure(
            "every call returns in bounded time",
            f"a check that did not return in {self._limit_s:g} s",
            "bound every wait for the device; read gives up after timeout_s",
        )
        return Result(check.name, check.title, Outcome.FAILED, time.monotonic() - begun_s, failure)

    def _opened(self) -> Rig:
        opening = _Job(lambda: self._stand.rig)
        if not self._done(opening, OPENING_LIMIT_S):
            message = (
                f"asked the rig to open, and it did not in {OPENING_LIMIT_S:g} s; check its devices' power and cables, "
                "and that no other program holds them"
            )
            raise DeviceError(message)
        if opening.error is not None:
            raise opening.error
        rig: Rig = opening.value
        return rig

    def _opened_again(self) -> Failure | None:
        try:
            _ = self._stand.rig
        except Exception as error:  # noqa: BLE001 - a driver may raise anything, and without a rig there is no more to do
            self.stopped = f"the rig does not open again: {error}"
            return Failure(
                "a rig opens again after it was closed",
                f"{type(error).__name__}: {error}",
                "close lets the device go entirely: handles, threads, locks",
            )
        return None

    def _done(self, job: _Job, limit_s: float | None) -> bool:
        self._jobs.put(job)
        return job.done.wait(limit_s)

    def _work(self) -> None:
        """What the owner thread does: jobs until there are no more, then close the rig."""
        while (job := self._jobs.get()) is not None:
            try:
                job.value = job.work()
            except Exception as error:  # noqa: BLE001 - a driver may raise anything; the asking thread tells it
                job.error = error
            job.done.set()
        with suppress(Exception):
            self._stand.close()

    def _judged(self, check: Check) -> tuple[Outcome, Failure | None, str | None]:
        bench = self._stand
        try:
            if check.fresh:
                bench.close()
            if (failure := self._opened_again()) is not None:
                return Outcome.FAILED, failure, None
            unmet = [why for need in check.needs if (why := need.unmet(bench.rig, bench.sequence)) is not None]
            if unmet:
                return Outcome.NOT_APPLICABLE, None, "; ".join(unmet)
            check.function(bench)
            if check.fresh:
                bench.close()
            else:
                bench.rest()
        except NotApplicableError as reason:
            bench.rest()
            return Outcome.NOT_APPLICABLE, None, str(reason)
        except Exception as error:  # noqa: BLE001 - whatever a driver raises is what the report is about
            # What comes next must not suffer from what is left behind.
            bench.close()
            return Outcome.FAILED, failure_of(error), None
        return Outcome.PASSED, None, None

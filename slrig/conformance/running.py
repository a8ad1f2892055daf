"""An examination: one thread that owns the rig's devices, a limit of time for each check, and a scored report."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import StrEnum
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from slrig.conformance import declared, frames, freshness, positioners, sequences, settings, shutdown, states
from slrig.conformance.bench import Check, ExpectationError, Failure, NotApplicableError, RigBench, failure_of
from slrig.devices import Rig
from slrig.errors import DeviceError
from slrig.model import PatternSequence

CHECKS = tuple(
    each
    for module in (declared, states, settings, frames, freshness, sequences, positioners, shutdown)
    for each in vars(module).values()
    if isinstance(each, Check)
)
"""Every check, in the order in which a rig is examined: what is declared first, whole sequences and ways out last."""

OPENING_LIMIT_S = 120.0
CHECK_LIMIT_S = 60.0
_CLOSING_LIMIT_S = 10.0
_EXPOSURES_PER_PATTERN = 8  # more than any check makes

_Answer = TypeVar("_Answer")


class Outcome(StrEnum):
    """How a check ended. Not run: the examination was stopped before; it counts against the rig."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"
    NOT_RUN = "not run"


@dataclass(frozen=True, slots=True)
class Result:
    """One check's outcome. `failure` says what is wrong; `reason` why it does not apply or was not run."""

    name: str
    title: str
    outcome: Outcome
    seconds: float
    failure: Failure | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """Every check's result, in order, and how long all took. `stopped` says why the examination ended early, if so."""

    rig: str
    results: tuple[Result, ...]
    seconds: float
    stopped: str | None = None

    def count(self, outcome: Outcome) -> int:
        """How many checks ended so."""
        return sum(result.outcome is outcome for result in self.results)

    @property
    def applicable(self) -> int:
        """How many checks ask something of this rig."""
        return len(self.results) - self.count(Outcome.NOT_APPLICABLE)

    @property
    def score(self) -> float:
        """Passed checks over applicable ones, 0 to 1."""
        return self.count(Outcome.PASSED) / self.applicable if self.applicable else 0.0

    @property
    def percent(self) -> int:
        """The score in whole percent, rounded down: 100 only if every check that applies has passed."""
        return math.floor(100 * self.score)

    @property
    def conforms(self) -> bool:
        """Whether every check that applies has passed."""
        return self.applicable > 0 and self.count(Outcome.PASSED) == self.applicable

    def document(self) -> dict[str, Any]:
        """The report as JSON can hold it."""
        return {
            "rig": self.rig,
            "conforms": self.conforms,
            "score": self.score,
            "passed": self.count(Outcome.PASSED),
            "applicable": self.applicable,
            "seconds": self.seconds,
            "stopped": self.stopped,
            "checks": [asdict(result) for result in self.results],
        }


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

    open_rig : opens the rig afresh; called several times, each time after the rig was closed. sequence : patterns that
    its projector can show, white and black first. progress : told about each check before and after it, in the caller's
    thread. limit_s : how long a check may take; None is a minute, and more for long exposures.

    Raises what opening the rig for the first time raises: a rig that does not open cannot be examined.
    """
    begun_s = time.monotonic()
    results: list[Result] = []
    with Examination(open_rig, sequence, limit_s=limit_s) as examination:
        for count, each in enumerate(checks):
            progress(each.title, count / len(checks), "")
            results.append(examination.judge(each))
            progress(each.title, (count + 1) / len(checks), results[-1].outcome)
        return Report(examination.name, tuple(results), time.monotonic() - begun_s, examination.stopped)


class Examination:
    """A rig under examination. A context manager: entering it opens the rig, leaving it closes the rig.

    The devices belong to one thread. A check that does not return keeps it, and with it the devices: nothing else is
    asked of them any more, and `stopped` says so. Should the check come back later, the rig is closed then.
    """

    def __init__(self, open_rig: Callable[[], Rig], sequence: PatternSequence, *, limit_s: float | None = None) -> None:
        self._bench = RigBench(open_rig, sequence)
        self._limit_s = limit_s
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        # A device that never answers must not keep the program from ending.
        self._owner = threading.Thread(target=self._do_work, name="conformance", daemon=True)
        self._stuck = False
        self.name = ""
        self.stopped: str | None = None

    def __enter__(self) -> Self:
        self._owner.start()
        try:
            rig = self._opened()
        except BaseException:
            self._work.put(None)
            raise
        self.name = rig.name
        if self._limit_s is None:
            longest_s = max((settings.exposure_s for settings in rig.settings.values()), default=0.0)
            exposures = _EXPOSURES_PER_PATTERN * max(len(self._bench.sequence), 16) * max(len(rig.cameras), 1)
            self._limit_s = CHECK_LIMIT_S + exposures * longest_s
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._work.put(None)
        if not self._stuck:
            self._owner.join(_CLOSING_LIMIT_S)

    def judge(self, check: Check) -> Result:
        """Examine the rig by one check. Once the examination was stopped, no check is run any more."""
        if self.stopped is not None:
            return Result(check.name, check.title, Outcome.NOT_RUN, 0.0, reason=self.stopped)
        begun_s = time.monotonic()
        judged = self._done(lambda: self._judged(check), self._limit_s)
        if judged.done():
            outcome, failure, reason = judged.result()
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
        opening = self._done(lambda: self._bench.rig, OPENING_LIMIT_S)
        if not opening.done():
            raise DeviceError(
                f"asked the rig to open, and it did not in {OPENING_LIMIT_S:g} s; check its devices' power and cables, "
                "and that no other program holds them"
            )
        return opening.result()

    def _done(self, work: Callable[[], _Answer], limit_s: float | None) -> Future[_Answer]:
        """Have the owner thread do something; what came of it, if that was in time."""
        answer: Future[_Answer] = Future()
        self._work.put((work, answer))
        wait([answer], limit_s)
        return answer

    def _do_work(self) -> None:
        """What the owner thread does: work until there is no more, then close the rig."""
        while (next_one := self._work.get()) is not None:
            work, answer = next_one
            try:
                answer.set_result(work())
            except Exception as error:  # noqa: BLE001 - a driver may raise anything; the asking thread tells it
                answer.set_exception(error)
        with suppress(Exception):
            self._bench.close()

    def _judged(self, check: Check) -> tuple[Outcome, Failure | None, str | None]:
        bench = self._bench
        try:
            if check.fresh:
                bench.close()
            try:
                rig = bench.opened_again()
            except ExpectationError as error:
                self.stopped = f"the rig does not open again: {error.__cause__}"
                return Outcome.FAILED, error.failure, None
            unmet = [why for need in check.needs if (why := need.unmet(rig, bench.sequence)) is not None]
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

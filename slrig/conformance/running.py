"""Run of all checks on a rig: one thread owns the devices, each check has a time limit, and the report has a score."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import StrEnum
from types import TracebackType
from typing import Any, Self, TypeVar

from slrig.conformance import camera_checks, device_checks, rig_checks
from slrig.conformance.bench import Check, ExpectationError, Failure, NotApplicableError, RigBench, failure_from
from slrig.devices import Rig
from slrig.errors import DeviceError
from slrig.jobs.listener import SILENT, Listener
from slrig.model import PatternSequence
from slrig.rig.watchdog import Calls

CHECKS = tuple(
    each
    for module in (device_checks, camera_checks, rig_checks)
    for each in vars(module).values()
    if isinstance(each, Check)
)
"""Every check, in the order in which they run: declarations first, whole sequences and closing last."""

OPENING_LIMIT_S = 120.0
CHECK_LIMIT_S = 60.0
_CLOSING_LIMIT_S = 10.0
_EXPOSURES_PER_PATTERN = 8  # more than any check makes

_Answer = TypeVar("_Answer")


class CheckOutcome(StrEnum):
    """Outcome of a check. Not run: the examination was stopped before it; it counts against the rig."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"
    NOT_RUN = "not run"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check. `failure` describes a violation; `reason` why the check does not apply or was not run."""

    name: str
    title: str
    outcome: CheckOutcome
    seconds: float
    failure: Failure | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of all checks, in order, and their duration. stopped : why the examination ended early; None if it did
    not.
    """

    rig: str
    results: tuple[CheckResult, ...]
    seconds: float
    stopped: str | None = None

    def count(self, outcome: CheckOutcome) -> int:
        """Number of checks with this outcome."""
        return sum(result.outcome is outcome for result in self.results)

    @property
    def applicable(self) -> int:
        """Number of checks that apply to this rig."""
        return len(self.results) - self.count(CheckOutcome.NOT_APPLICABLE)

    @property
    def score(self) -> float:
        """Passed checks over applicable ones, 0 to 1."""
        return self.count(CheckOutcome.PASSED) / self.applicable if self.applicable else 0.0

    @property
    def percent(self) -> int:
        """The score in whole percent, rounded down: 100 only if every check that applies has passed."""
        return math.floor(100 * self.score)

    @property
    def conforms(self) -> bool:
        """True if every check that applies has passed."""
        return self.applicable > 0 and self.count(CheckOutcome.PASSED) == self.applicable

    def document(self) -> dict[str, Any]:
        """Return the report as JSON can hold it."""
        return {
            "rig": self.rig,
            "conforms": self.conforms,
            "score": self.score,
            "passed": self.count(CheckOutcome.PASSED),
            "applicable": self.applicable,
            "seconds": self.seconds,
            "stopped": self.stopped,
            "checks": [{**asdict(result), "failure": _failure_document(result.failure)} for result in self.results],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Self:
        """The report that `document` returned."""
        results = tuple(
            CheckResult(
                each["name"], each["title"], CheckOutcome(each["outcome"]), each["seconds"],
                _failure_from_document(each["failure"]), each["reason"],
            )
            for each in document["checks"]
        )  # fmt: skip
        return cls(document["rig"], results, document["seconds"], document["stopped"])


def run_checks(
    open_rig: Callable[[], Rig],
    sequence: PatternSequence,
    listener: Listener = SILENT,
    *,
    checks: Sequence[Check] = CHECKS,
    limit_s: float | None = None,
    calls: Calls | None = None,
    found: Callable[[ConformanceReport], None] = lambda _report: None,
) -> ConformanceReport:
    """Examine a rig by every check.

    open_rig : opens the rig; called several times, each time after the rig was closed. sequence : patterns that its
    projector can show, white and black first. listener : is called before and after each check, in the caller's thread,
    where it may end the examination. limit_s : time limit of a check; None is a minute, and more for long
    exposures. calls : see `ConformanceRun`. found : called before each check with the report as it is if that check
    does not return.
    Raises the errors of opening the rig for the first time.
    """
    start_s = time.monotonic()
    results: list[CheckResult] = []
    with ConformanceRun(open_rig, sequence, limit_s=limit_s, calls=calls) as run:
        for count, each in enumerate(checks):
            listener.step(each.title, count / len(checks), "")
            hangs = f"'{each.title}' did not return"
            unfinished = [_not_run(check, hangs) for check in checks[count:]]
            found(ConformanceReport(run.name, (*results, *unfinished), time.monotonic() - start_s, hangs))
            results.append(run.run_check(each))
            listener.step(each.title, (count + 1) / len(checks), results[-1].outcome)
        return ConformanceReport(run.name, tuple(results), time.monotonic() - start_s, run.stopped)


def _not_run(check: Check, reason: str) -> CheckResult:
    return CheckResult(check.name, check.title, CheckOutcome.NOT_RUN, 0.0, reason=reason)


def _failure_document(failure: Failure | None) -> dict[str, str] | None:
    if failure is None:
        return None
    return {"asked": failure.expected, "found": failure.found, "do": failure.remedy, "where": failure.where}


def _failure_from_document(document: Mapping[str, str] | None) -> Failure | None:
    if document is None:
        return None
    return Failure(document["asked"], document["found"], document["do"], document["where"])


class ConformanceRun:
    """Examination of a rig. A context manager that opens and closes the rig.

    The devices belong to one thread. A check that does not return blocks that thread: no further call is made to the
    devices, and `stopped` gives the reason. If the check returns later, the rig is closed then.
    calls : of a service with a watchdog that ends hanging calls: the caller's thread owns the devices then. None starts
    a thread of its own.
    """

    def __init__(
        self,
        open_rig: Callable[[], Rig],
        sequence: PatternSequence,
        *,
        limit_s: float | None = None,
        calls: Calls | None = None,
    ) -> None:
        self._bench = RigBench(open_rig, sequence)
        self._limit_s = limit_s
        self._calls = calls
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        # A daemon, so that a device that never answers cannot keep the program running.
        self._owner = threading.Thread(target=self._run_owner, name="conformance", daemon=True)
        self._stuck = False
        self.name = ""
        self.stopped: str | None = None

    def __enter__(self) -> Self:
        if self._calls is None:
            self._owner.start()
        try:
            rig = self._open()
        except BaseException:
            self._close()
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
        self._close()

    def run_check(self, check: Check) -> CheckResult:
        """Run one check. After the examination was stopped, checks are not run any more."""
        if self.stopped is not None:
            return _not_run(check, self.stopped)
        start_s = time.monotonic()
        answer = self._run_in_owner(check.title, lambda: self._run_on_bench(check), self._limit_s)
        if answer.done():
            outcome, failure, reason = answer.result()
            return CheckResult(check.name, check.title, outcome, time.monotonic() - start_s, failure, reason)
        self._stuck = True
        self.stopped = (
            f"'{check.title}' did not return in {self._limit_s:g} s, and holds the devices, which have one owner: "
            "no further check can use them; end the program, unplug them if necessary, and make sure that the "
            "projector is dark"
        )
        failure = Failure(
            "every call returns in bounded time",
            f"a check that did not return in {self._limit_s:g} s",
            "bound every wait for the device; read gives up after timeout_s",
        )
        return CheckResult(check.name, check.title, CheckOutcome.FAILED, time.monotonic() - start_s, failure)

    def _open(self) -> Rig:
        answer = self._run_in_owner("opening", lambda: self._bench.rig, OPENING_LIMIT_S)
        if not answer.done():
            raise DeviceError(
                f"the rig did not open in {OPENING_LIMIT_S:g} s; check its devices' power and cables, and that no "
                "other program holds them"
            )
        return answer.result()

    def _run_in_owner(self, title: str, work: Callable[[], _Answer], limit_s: float | None) -> Future[_Answer]:
        """Run work in the owner thread, and return its future; it is not done if the time limit passed."""
        answer: Future[_Answer] = Future()
        if self._calls is not None:
            answer.set_result(self._calls.make("the rig", f"'{title}'", limit_s or CHECK_LIMIT_S, work))
            return answer
        self._work.put((work, answer))
        wait([answer], limit_s)
        return answer

    def _close(self) -> None:
        if self._calls is not None:
            with suppress(Exception):
                self._bench.close()
            return
        self._work.put(None)
        if self._owner.ident is not None and not self._stuck:
            self._owner.join(_CLOSING_LIMIT_S)

    def _run_owner(self) -> None:
        """Body of the owner thread: do work until there is no more, then close the rig."""
        while (task := self._work.get()) is not None:
            work, answer = task
            try:
                answer.set_result(work())
            except Exception as error:  # noqa: BLE001 - a driver may raise anything; the caller's thread reports it
                answer.set_exception(error)
        with suppress(Exception):
            self._bench.close()

    def _run_on_bench(self, check: Check) -> tuple[CheckOutcome, Failure | None, str | None]:
        bench = self._bench
        try:
            if check.fresh:
                bench.close()
            try:
                rig = bench.reopen()
            except ExpectationError as error:
                self.stopped = f"the rig does not open again: {error.__cause__}"
                return CheckOutcome.FAILED, error.failure, None
            unmet = [why for need in check.needs if (why := need.unmet_reason(rig, bench.sequence)) is not None]
            if unmet:
                return CheckOutcome.NOT_APPLICABLE, None, "; ".join(unmet)
            check.function(bench)
            if check.fresh:
                bench.close()
            else:
                bench.set_to_rest()
        except NotApplicableError as reason:
            bench.set_to_rest()
            return CheckOutcome.NOT_APPLICABLE, None, str(reason)
        except Exception as error:  # noqa: BLE001 - the report is about every error that a driver raises
            # Close the rig, so that its state does not affect the next check.
            bench.close()
            return CheckOutcome.FAILED, failure_from(error), None
        return CheckOutcome.PASSED, None, None

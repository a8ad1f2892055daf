"""The wait for one job of the worker: what its process says is heard, and what ends the wait is found."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from ctypes import c_double
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

import structlog

from slrig.errors import ScanCancelledError, WorkerLostError
from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.worker_process import Done, Failed, FileMade, Preparing, Progressed, Task, Unloadable, received, sent

CANCEL_LIMIT_S = 10.0
"""A job that has not stopped this long after it was asked to is stopped by ending its process."""

SILENCE_LIMIT_S = 30.0
"""A process that shows no sign of life this long during a job is taken for dead. It shows two a second, and no single
step of the mathematics holds the interpreter for more than a second or two; a machine that swaps may."""

STANDSTILL_LIMIT_S = 900.0
"""A job that tells no progress this long is taken for one that never ends: the longest step that was measured, a solve
of sixty poses, takes about a minute."""

PREPARING = "preparing kernels"
"""The stage of compiling what numba has not compiled on this machine before."""

POLL_S = 0.1

Told = Callable[[str, float, str], None]
"""Is told the stage of a job, the fraction of it that is done, and a detail for people."""

Made = Callable[[str], None]
"""Is told the name of a file that is there, whole, while the job goes on."""

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class JobWait:
    """The wait for one job: what the process says is heard, and what ends the wait is found. noted : takes what the
    process says of itself.
    """

    task: Task
    number: int
    process: BaseProcess
    pipe: Connection
    stops: Connection
    heartbeat: c_double
    progress: Told
    cancelled: Callable[[], bool]
    made: Made
    noted: Callable[[object | None], None]
    answered: bool = False
    _answer: Done | Failed | None = None
    _stop_after: float | None = None
    _looked_s: float = field(default_factory=time.monotonic)
    _beat: float = -1.0
    _silence_s: float = 0.0
    _standstill_s: float = 0.0

    def settled(self, feed: FrameFeed) -> bool:
        """Wait until the frames of a capture have been sent, or cannot be; return whether all were."""
        while not feed.settled(POLL_S):
            # A process that still prepares its kernels takes no frames, and tells how far it is.
            self._hear()
            if self._watch():
                feed.abandon()
        return feed.whole

    def answer(self) -> Done | Failed:
        """Wait for the answer."""
        while True:
            ended = self.process.sentinel in wait([self.pipe, self.process.sentinel], timeout=POLL_S)
            self._hear()
            if self._answer is not None:
                return self._answer
            if ended and not self.pipe.poll():
                self.noted(None)
                raise self.lost()
            self._watch()

    def _hear(self) -> None:
        while self._answer is None and self.pipe.poll():
            match received(self.pipe):
                case Progressed(number, stage, fraction, detail) if number == self.number:
                    self._standstill_s = 0.0
                    self.progress(stage, fraction, detail)
                case FileMade(number, name) if number == self.number:
                    self.made(name)
                case Done(number) | Failed(number) as answer if number == self.number:
                    self.answered, self._answer = True, answer
                case Progressed() | FileMade() | Done() | Failed():
                    _log.warning("an answer that nobody waits for was dropped")
                case None | Unloadable() as told:
                    self.noted(told)
                    raise self.lost()
                case told:
                    self._standstill_s = 0.0
                    self.noted(told)
                    if isinstance(told, Preparing):
                        self.progress(PREPARING, 0.0, str(told))

    def _watch(self) -> bool:
        """Have the process stop when the job is cancelled, and end it when it does not, or is dead or stuck. Returns
        whether the job is cancelled.
        """
        now_s = time.monotonic()
        # By looks rather than by the clock: where the service itself was stopped, nothing is known of the worker.
        step_s, self._looked_s = min(now_s - self._looked_s, 1.0), now_s
        if self.heartbeat.value != self._beat:
            self._beat, self._silence_s = self.heartbeat.value, 0.0
        else:
            self._silence_s += step_s
        self._standstill_s += step_s
        if self._silence_s > SILENCE_LIMIT_S:
            raise self._replaced(f"showed no sign of life for {self._silence_s:.0f} s")
        if self._standstill_s > STANDSTILL_LIMIT_S:
            raise self._replaced(f"told no progress for {self._standstill_s / 60:.0f} minutes")
        if self._stop_after is not None and now_s > self._stop_after:
            _log.warning("a job did not stop when asked, its process is ended", job=self.task.what)
            message = f"The {self.task.what} was cancelled."
            raise ScanCancelledError(message)
        if self._stop_after is None and self.cancelled():
            self._stop_after = now_s + CANCEL_LIMIT_S
            sent(self.stops, self.number)
        return self._stop_after is not None

    def _replaced(self, why: str) -> WorkerLostError:
        _log.error("the worker is replaced", job=self.task.what, why=why)
        message = (
            f"The worker {why} in the middle of the {self.task.what}, and has been replaced. Look for what stops or "
            f"overloads this machine. {self.task.remedy}"
        )
        return WorkerLostError(message)

    def lost(self) -> WorkerLostError:
        """The error that stands for a process that ended."""
        self.process.join()
        code = self.process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        message = (
            f"The worker's process ended in the middle of the {self.task.what} ({how}), and has been replaced. If the "
            f"machine ran out of memory, free some or use a camera of fewer pixels. {self.task.remedy}"
        )
        return WorkerLostError(message)

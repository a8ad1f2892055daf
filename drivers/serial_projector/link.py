"""One command, one answer, over a line that loses and damages bytes: sent again until it is answered, obeyed once.

A command that is sent again keeps its number, and the box answers a number that it has obeyed already with what it
answered then. So an answer that is lost costs time, and never shows a pattern twice.
"""

from __future__ import annotations

import secrets
import threading
from collections import deque
from dataclasses import dataclass, field

from drivers.serial_port import SLICE_S, BytePort
from drivers.serial_projector.frames import (
    NUMBERS,
    BoxAnswer,
    BoxEvent,
    LineSplitter,
    RefusalCode,
    UnreadableLine,
    encode_line,
    parse_line,
)
from slrig.devices import Clock, SystemClock
from slrig.errors import DeviceError, DeviceStateError

MAX_TRIES = 12
_NS_PER_S = 1_000_000_000
_EVENTS = 4096


class BoxRefusedError(DeviceError):
    """The box answered, and does not obey. `number` is one of `RefusalCode` (or a number that newer firmware knows)."""

    def __init__(self, verb: str, number: int, words: tuple[str, ...]) -> None:
        self.verb, self.number, self.words = verb, number, words
        name = RefusalCode(number).name.lower() if number in set(RefusalCode) else "unknown"
        super().__init__(f"the trigger box refused {verb}: error {number} ({name}) {' '.join(words)}".rstrip())


class NoAnswerError(DeviceError):
    """No answer came, however often the command was sent: the box may have obeyed, or never heard of it."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What the box answered. It obeyed at some instant between `sent_ns` and `received_ns` (the link's clock)."""

    words: tuple[str, ...]
    sent_ns: int
    received_ns: int


@dataclass(slots=True)
class LinkCounters:
    """What the line did: commands, sent again, damaged lines that came in, answers to somebody else."""

    commands: int = 0
    again: int = 0
    damaged: int = 0
    others: int = 0


@dataclass(slots=True)
class BoxLink:
    """Commands to one box. One thread at a time uses it; `closing` ends a wait from another one.

    reply_s : how long an answer may take, beyond what the command itself takes. deadline_s : after which a command is
    not sent again. clock : of both, and of the answers' instants.
    """

    port: BytePort
    reply_s: float
    deadline_s: float
    # So many that two hosts hardly share one; never the number of a session before.
    session: str = field(default_factory=lambda: secrets.token_hex(2).upper())
    closing: threading.Event = field(default_factory=threading.Event)
    events: deque[BoxEvent] = field(default_factory=lambda: deque(maxlen=_EVENTS))
    tally: LinkCounters = field(default_factory=LinkCounters)
    clock: Clock = field(default_factory=SystemClock)
    _number: int = 0
    _splitter: LineSplitter = field(default_factory=LineSplitter)
    _waiting: deque[bytes] = field(default_factory=deque)

    def replace_port(self, port: BytePort) -> None:
        """Go on over another port. What was under way on the old one is lost."""
        self.port, self._splitter = port, LineSplitter()
        self._waiting.clear()

    def ask(
        self,
        verb: str,
        *numbers: int | str,
        takes_s: float = 0.0,
        tries: int = MAX_TRIES,
        deadline_s: float | None = None,
        while_closing: bool = False,
    ) -> Reply:
        """Send a command until it is answered; return the answer.

        Parameters
        ----------
        takes_s
            How long the box may be busy with it.
        while_closing
            Ask although `closing` is set.

        Raises
        ------
        RefusedError
            The box does not obey.
        SilentError
            No answer.
        DeviceGoneError
            The port is gone.
        DeviceStateError
            `closing` was set meanwhile.
        """
        self._number = (self._number + 1) % NUMBERS
        line = encode_line(" ".join(map(str, (self.session, self._number, verb, *numbers))))
        until_ns = self.after(self.deadline_s if deadline_s is None else deadline_s)
        self.tally.commands += 1
        first_ns = self.clock.now_ns()
        sent = 0
        while sent < tries and (sent == 0 or self.clock.now_ns() < until_ns):
            self.port.write(line)
            self.tally.again += sent > 0
            sent += 1
            answer = self._answer(self.after(self.reply_s + takes_s), while_closing)
            if answer is not None:
                if answer.code is not None:
                    raise BoxRefusedError(verb, answer.code, answer.words)
                return Reply(answer.words, first_ns, self.clock.now_ns())
        took_s = (self.clock.now_ns() - first_ns) / _NS_PER_S
        message = (
            f"asked the trigger box for {verb} {sent} times in {took_s:.2f} s, found no answer "
            f"({self.tally.damaged} damaged lines so far); check its cable, its power and the baud rate"
        )
        raise NoAnswerError(message)

    def after(self, seconds: float) -> int:
        """The time in so many seconds, ns."""
        return self.clock.now_ns() + round(seconds * _NS_PER_S)

    def _answer(self, until_ns: int, while_closing: bool) -> BoxAnswer | None:
        """The answer to the command that was sent last; None when it is time to send it again."""
        while True:
            while self._waiting:
                raw = self._waiting.popleft()
                match parse_line(raw):
                    case BoxAnswer() as answer if answer.session != self.session:
                        self.tally.others += 1
                    case BoxAnswer() as answer if answer.number == self._number:
                        return answer
                    case BoxEvent() as event:
                        self.events.append(event)
                    case UnreadableLine():
                        return None
                    case None:
                        self.tally.damaged += 1
                        # That may have been it: a little longer, for what else is under way.
                        until_ns = min(until_ns, self.after(SLICE_S))
            if self.closing.is_set() and not while_closing:
                message = "the projector was closed while it waited for the trigger box; open the rig again"
                raise DeviceStateError(message)
            left_s = (until_ns - self.clock.now_ns()) / _NS_PER_S
            if left_s <= 0:
                return None
            self._waiting.extend(self._splitter.lines(self.port.read(min(left_s, SLICE_S))))

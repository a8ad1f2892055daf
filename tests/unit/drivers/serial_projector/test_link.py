"""Commands over a bad line: sent again under their number, within bounds; and whatever else comes in meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from drivers.serial_projector.frames import Event, framed
from drivers.serial_projector.link import MOST_TRIES, Link, RefusedError, SilentError
from slrig.errors import DeviceGoneError, DeviceStateError


@dataclass
class ScriptedPort:
    """A port whose far end is a script: what it answers to each line that is written."""

    answers: Callable[[bytes, int], bytes]
    written: list[bytes] = field(default_factory=list)
    _waiting: bytes = b""

    def write(self, data: bytes) -> None:
        self.written.append(data)
        self._waiting += self.answers(data, len(self.written))

    def read(self, timeout_s: float) -> bytes:
        if not self._waiting:
            threading.Event().wait(timeout_s)
        data, self._waiting = self._waiting, b""
        return data

    def close(self) -> None:
        self.written.append(b"closed")


def answer(data: bytes, text: str) -> bytes:
    """A good answer to a line."""
    session, number = data.decode().split()[:2]
    return framed(f"{session} {number} {text}")


def link(answers: Callable[[bytes, int], bytes], *, reply_s: float = 0.05, deadline_s: float = 5.0) -> Link:
    return Link(ScriptedPort(answers), reply_s, deadline_s)


def written(of: Link) -> list[bytes]:
    assert isinstance(of.port, ScriptedPort)
    return of.port.written


def test_a_command_is_sent_again_as_it_was_until_it_is_answered() -> None:
    asked = link(lambda data, count: answer(data, "OK 3 99") if count == 4 else b"")
    before_ns = time.monotonic_ns()
    reply = asked.ask("SHOW", 3)
    assert reply.words == ("3", "99")
    assert before_ns <= reply.sent_ns < reply.received_ns - 150_000_000
    assert len(set(written(asked))) == 1
    assert asked.tally.again == 3


def test_twelve_tries_are_the_most() -> None:
    asked = link(lambda _data, _count: b"", reply_s=0.005)
    with pytest.raises(SilentError, match="SHOW 12 times"):
        asked.ask("SHOW", 3)
    assert len(written(asked)) == MOST_TRIES == 12


def test_a_deadline_ends_the_tries() -> None:
    asked = link(lambda _data, _count: b"", reply_s=0.05, deadline_s=0.12)
    with pytest.raises(SilentError):
        asked.ask("SHOW", 3)
    # Three on a quiet machine. One that is busy may be too late for the others.
    assert 1 <= len(written(asked)) <= 3


def test_a_line_that_the_box_could_not_read_is_sent_again_at_once() -> None:
    asked = link(lambda data, n: framed("? ERR 1 bad frame") if n < 10 else answer(data, "OK"), reply_s=5.0)
    begun_s = time.monotonic()
    asked.ask("BLANK")
    assert time.monotonic() - begun_s < 2
    assert len(written(asked)) == 10


def test_a_damaged_answer_is_asked_for_again_soon() -> None:
    asked = link(lambda data, n: answer(data, "OK 1").replace(b"OK 1", b"OK 2") if n < 3 else answer(data, "OK 1"))
    asked.reply_s = 5.0
    begun_s = time.monotonic()
    assert asked.ask("STOP").words == ("1",)
    assert time.monotonic() - begun_s < 2
    assert asked.tally.damaged == 2


def test_stale_and_foreign_answers_are_passed_over() -> None:
    def answers(data: bytes, count: int) -> bytes:
        session, number = data.decode().split()[:2]
        stale = framed(f"{session} {(int(number) - 1) % 10_000} OK stale")
        return framed("ZZZZ 1 OK foreign") + stale + framed("! FRAME 3 120") + answer(data, f"OK {count}")

    asked = link(answers)
    assert asked.ask("PING").words == ("1",)
    assert asked.ask("PING").words == ("2",)
    assert asked.tally.others == 2
    assert list(asked.events) == [Event("FRAME", ("3", "120"))] * 2


def test_each_command_has_its_number_and_each_link_its_session() -> None:
    sent = link(lambda data, _count: answer(data, "OK"))
    for _ in range(10_002):
        sent.ask("PING")
    numbers = [int(line.split()[1]) for line in written(sent)]
    assert numbers[:2] == [1, 2]
    assert numbers[9_998:] == [9_999, 0, 1, 2]
    assert {line.split()[0] for line in written(sent)} == {sent.session.encode()}
    assert len({link(lambda _data, _count: b"").session for _ in range(20)}) > 15


def test_a_refusal_keeps_its_code_and_words() -> None:
    asked = link(lambda data, _count: answer(data, "ERR 4 26 of 26"))
    with pytest.raises(RefusedError, match=r"refused SHOW: error 4 \(range\) 26 of 26") as refusal:
        asked.ask("SHOW", 26)
    assert (refusal.value.number, refusal.value.words) == (4, ("26", "of", "26"))
    with pytest.raises(RefusedError, match=r"error 77 \(unknown\)"):
        link(lambda data, _count: answer(data, "ERR 77 new")).ask("SHOW", 1)


def test_a_wait_ends_when_the_projector_is_closed() -> None:
    asked = link(lambda _data, _count: b"", reply_s=60.0, deadline_s=600.0)
    raised: list[BaseException] = []

    def wait() -> None:
        try:
            asked.ask("SHOW", 1)
        except DeviceStateError as error:
            raised.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    asked.closing.set()
    thread.join(10)
    assert not thread.is_alive()
    assert len(raised) == 1


def test_a_port_that_is_gone_is_told() -> None:
    def gone(_data: bytes, _count: int) -> bytes:
        message = "gone"
        raise DeviceGoneError(message)

    with pytest.raises(DeviceGoneError):
        link(gone).ask("PING")

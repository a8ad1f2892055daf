"""A trigger box as the host sees it: pattern checksums, the session with its verbs as methods, and the box's clock.

A box steps through the patterns in its flash and cannot receive images, so host and box compare checksums.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field

from drivers.serial_port import BytePort
from drivers.serial_projector.link import (
    BoxEvent,
    BoxLink,
    BoxRefusedError,
    NoAnswerError,
    RefusalCode,
    Reply,
    SequenceMode,
)
from slrig.bundle import Strict
from slrig.devices import Clock
from slrig.errors import DeviceBusyError, DeviceError, SlrigError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels


class SerialProjectorOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "serial_projector"`."""

    port: Annotated[str, Field(min_length=1, json_schema_extra={"takes": "device"})]
    """Serial port: a path, a persistent name in /dev/serial/by-id, COM3, or a pyserial URL."""

    baud: Annotated[int, Field(ge=1200, le=12_000_000, json_schema_extra={"unit": "bit/s"})] = 115_200
    """Baud rate of a real serial line; ignored by USB."""

    watchdog_s: Annotated[float, Field(ge=0.05, le=10)] = 2.0
    """The box goes dark when it receives nothing from the host for this time: after a crash or a cable fault."""

    max_on_s: Annotated[float, Field(ge=0.001, le=3600)] = 60.0
    """The box puts out a pattern that has been lit for this time without another request."""

    max_duty: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """Largest fraction of light in any 10 s."""

    brightness: Annotated[float, Field(ge=0.001, le=1)] = 1.0
    """Fraction of full power; below 1 the box must be able to dim."""

    open_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Longest time for the first answer after the port was opened; many boards restart then."""

    reply_s: Annotated[float, Field(ge=0.005, le=5)] = 0.15
    """Time after which an unanswered command is repeated; longer for a slow line."""

    deadline_s: Annotated[float, Field(ge=0.1, le=60)] = 2.5
    """Time after which an unanswered command has failed."""

    export_folder: Annotated[str, Field(min_length=1)] = "patterns"
    """Folder, relative to the rig file's, into which `slrig patterns` writes the pattern sets to flash, each into a
    subfolder named by its checksum."""


MAX_DRIFT = 1e-3
"""Largest relative error of a box's clock; a ceramic resonator is within it, a crystal is much better."""
_SLOT_NS = 4 * 10**9
_SLOTS = 16
_WANDER = 2e-6
"""Largest change of a clock's rate within the evaluated time, due to temperature."""
PROTOCOL = 1
MAX_PICKS_PER_LINE = 16
"""Checksums in one line, which has at most 240 bytes."""
_PINGS = 8
_FAREWELL_S = 0.6
_GREET_RETRY_S = 0.1
_UNLIMITED_TRIES = 10**6
_Values = TypeVar("_Values", "BoxInfo", "BoxStatus")
BEATS_PER_WATCHDOG = 5
"""Enough that a few lost ones, or a busy host, do not put the light out."""


def pattern_checksum(image: Pixels) -> int:
    """CRC-32 (ISO-HDLC, as zlib's) of one pattern's image, (H, W) uint8, row by row from the top left.

    >>> hex(pattern_checksum(np.array([[0, 255], [255, 0]], np.uint8)))
    '0xcf81683'
    """
    return zlib.crc32(image.tobytes())


def pattern_checksums(sequence: PatternSequence) -> tuple[int, ...]:
    """CRC-32 of every pattern of a sequence. Raises UnsupportedByDeviceError if a pattern has more than 8 bits."""
    deep = [index for index, profile in enumerate(sequence.profiles) if profile.dtype != np.uint8]
    if deep:
        message = f"patterns {deep} have more than 8 bits, the limit of a trigger box; encode them with 8 bits"
        raise UnsupportedByDeviceError(message)
    return tuple(pattern_checksum(sequence.image(index)) for index in range(len(sequence)))


def sequence_checksum(checksums: Sequence[int]) -> int:
    """CRC-32 of a sequence, from those of its patterns in order, four bytes each, most significant first.

    >>> f"{sequence_checksum([0x0CF81683, 0x00000000]):08X}"
    '46D5955C'
    """
    return zlib.crc32(b"".join(crc32.to_bytes(4, "big") for crc32 in checksums))


@dataclass(frozen=True, slots=True)
class _Exchange:
    device_us: int
    before_ns: int
    after_ns: int

    @property
    def width_ns(self) -> int:
        return self.after_ns - self.before_ns


class BoxClock:
    """Converts instants of a box into instants of CLOCK_MONOTONIC, with guaranteed bounds. Not thread-safe.

    The box stamps a command at u µs of its own clock, between the instant a ns at which the command's first byte left
    the host and the instant b ns at which the answer was read. So each exchange states: host(u) is in [a, b]. Both
    clocks run steadily, with a rate r between them; two exchanges bound r,

        (a₂ - b₁)/(u₂ - u₁) ≤ r ≤ (b₂ - a₁)/(u₂ - u₁),

    so the bounds tighten as the exchanges are further apart. An instant of the box is in all the intervals [a, b] at
    once, each extrapolated by the bounds of r: the middle of the intersection is the estimate, half its length the
    error. The shortest exchanges give the tightest bounds; those that waited for a retry are wider, never wrong.
    """

    def __init__(self) -> None:
        self._latest: _Exchange | None = None
        self._best: dict[int, _Exchange] = {}
        self._rate = (1 - MAX_DRIFT, 1 + MAX_DRIFT)

    @property
    def rate(self) -> tuple[float, float]:
        """Bounds of the ns of the host per 1000 · (1 µs of the box)."""
        return self._rate

    def note(self, device_us: int, before_ns: int, after_ns: int) -> None:
        """Note an exchange: the box stamped `device_us` between two instants of the host."""
        new = _Exchange(device_us, before_ns, after_ns)
        if self._latest is not None and not self._agree(new):
            # Its clock jumped, or drifts more than allowed: start again.
            self._best.clear()
            self._rate = (1 - MAX_DRIFT, 1 + MAX_DRIFT)
        self._latest = new
        slot = before_ns // _SLOT_NS
        best = self._best.get(slot)
        if best is None or new.width_ns <= best.width_ns:
            self._best[slot] = new
        for old in sorted(self._best)[:-_SLOTS]:
            del self._best[old]
        self._learn_rate()

    def host_ns(self, device_us: int) -> tuple[int, int]:
        """Convert an instant of the box into (instant, error) in ns. Raises ValueError before the first exchange."""
        bounds = self._bounds(device_us)
        if bounds is None:
            message = "no exchange with the box yet"
            raise ValueError(message)
        low_ns, high_ns = bounds
        return (low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2

    def _exchanges(self) -> list[_Exchange]:
        exchanges = list(self._best.values())
        return exchanges if self._latest is None or self._latest in exchanges else [*exchanges, self._latest]

    def _bounds(self, device_us: int) -> tuple[int, int] | None:
        """Return the (earliest, latest) instant that all exchanges allow; earliest after latest if they contradict."""
        slow, fast = self._rate
        lows, highs = [], []
        for each in self._exchanges():
            since_ns = (device_us - each.device_us) * 1000
            least, most = sorted((since_ns * slow, since_ns * fast))
            lows.append(each.before_ns + round(least))
            highs.append(each.after_ns + round(most))
        return (max(lows), min(highs)) if lows else None

    def _agree(self, new: _Exchange) -> bool:
        bounds = self._bounds(new.device_us)
        return bounds is None or max(bounds[0], new.before_ns) <= min(bounds[1], new.after_ns)

    def _learn_rate(self) -> None:
        exchanges = sorted(self._exchanges(), key=lambda each: each.device_us)
        slow, fast = 1 - MAX_DRIFT, 1 + MAX_DRIFT
        for index, first in enumerate(exchanges):
            for second in exchanges[index + 1 :]:
                apart_ns = (second.device_us - first.device_us) * 1000
                if apart_ns > 0:
                    slow = max(slow, (second.before_ns - first.after_ns) / apart_ns - _WANDER)
                    fast = min(fast, (second.after_ns - first.before_ns) / apart_ns + _WANDER)
        self._rate = (slow, fast) if slow <= fast else (1 - MAX_DRIFT, 1 + MAX_DRIFT)


@dataclass(frozen=True, slots=True)
class BoxLimits:
    """Limits that the host requests in HELLO."""

    watchdog_ms: int
    on_ms: int
    duty: int
    bright: int


@dataclass(frozen=True, slots=True)
class BoxInfo:
    """Properties of a box from HELLO, named as in the protocol. pick : 0 for a box that supports only runs of its
    flash. pulse : empty for a box whose pulses have a length of its own.
    """

    sltp: int
    model: str
    fw: str
    w: int
    h: int
    max: int
    boot: str
    watchdog_ms: int
    on_ms: int
    duty: int
    bright: int
    light_us: int
    error_us: int
    gap_us: int
    hold_us: int
    least_us: int
    pick: int = 0
    pulse: str = ""

    @property
    def light_s(self) -> float:
        """Longest time from a command to its light."""
        return self.light_us / 1e6


@dataclass(frozen=True, slots=True)
class BoxStatus:
    """Current state of a box. index : the pattern lit last, None before the first."""

    state: str
    loaded: int
    first: int
    frames: int
    shows: int
    fault: int
    t_us: int
    index: int | None = None


class BoxClient:
    """A session with one box. Thread-safe.

    Raises DeviceBusyError (another host is in a session with it), UnsupportedByDeviceError (it cannot keep to the
    limits), DeviceError (no answer in SLTP/1) and DeviceGoneError (the port is gone).
    """

    def __init__(self, link: BoxLink, limits: BoxLimits, *, label: str, open_s: float) -> None:
        self._link = link
        self._limits = limits
        self._label = label
        self._open_s = open_s
        self._lock = threading.RLock()
        self._clock = BoxClock()
        self._abandoned = threading.Event()
        self._box = self._greet_box()
        self._gap_us = self._box.gap_us

    @property
    def box(self) -> BoxInfo:
        """Properties of the box from the last greeting."""
        return self._box

    @property
    def gap_us(self) -> int:
        """Shortest time between exposures of the loaded sequence; it is longer if the engine has to step back."""
        return self._gap_us

    @property
    def link(self) -> BoxLink:
        """The link of the session."""
        return self._link

    def greet(self) -> BoxInfo:
        """Begin the session again after the box restarted: it is dark, with nothing loaded. Raises as opening does."""
        with self._lock:
            self._clock = BoxClock()
            self._box = self._greet_box()
            return self._box

    def reconnect(self, open_port: Callable[[], BytePort]) -> None:
        """Open the port again after the box was unplugged and plugged in, without greeting it. Raises as opening
        does.
        """
        with self._lock:
            # The system reuses the old name only after the old port is closed.
            self._link.port.close()
            self._link.replace_port(open_port())

    def ping(self) -> tuple[str, int]:
        """Return the state of the box, and its fault (0: none)."""
        with self._lock:
            return self._note_ping(self._link.ask("PING"))

    def beat(self) -> None:
        """Send one sign of life, unless the box is abandoned or a command is in progress."""
        if self._abandoned.is_set() or not self._lock.acquire(blocking=False):
            return
        try:
            with suppress(NoAnswerError, BoxRefusedError):
                self._note_ping(self._link.ask("PING", tries=1))
        finally:
            self._lock.release()

    def load(self, checksums: Sequence[int]) -> tuple[int, ...]:
        """Load patterns by their CRC-32; return the indices of missing ones, none if all are loaded.

        They are loaded as a run of the flash if possible, which an engine steps through fastest; else picked one by
        one, which a box without PICK refuses.
        """
        with self._lock:
            try:
                self._load(checksums)
            except BoxRefusedError as refusal:
                if refusal.number not in {RefusalCode.PATTERNS, RefusalCode.RANGE} or len(checksums) > self._box.pick:
                    raise
                missing = self._pick(checksums)
                if missing:
                    return missing
                self._load(checksums)
            self._abandoned.clear()
            return ()

    def _load(self, checksums: Sequence[int]) -> None:
        reply = self._ask("LOAD", len(checksums), f"{sequence_checksum(checksums):08X}")
        self._gap_us = _integer(reply, 2) if len(reply.words) > 2 else self._box.gap_us

    def _pick(self, checksums: Sequence[int]) -> tuple[int, ...]:
        """Pick patterns; return the indices of those that the box lacks."""
        missing: list[int] = []
        for at in range(0, len(checksums), MAX_PICKS_PER_LINE):
            reply = self._ask("PICK", at, *(f"{crc32:08X}" for crc32 in checksums[at : at + MAX_PICKS_PER_LINE]))
            missing += (_integer(reply, index) for index in range(1, len(reply.words)))
        return tuple(missing)

    def show(self, index: int) -> tuple[int, int]:
        """Light a pattern; return (t_visible_ns, t_err_ns), on the link's clock."""
        with self._lock:
            reply = self._ask("SHOW", index, takes_s=self._box.light_s)
            return self._read_light_time(reply, index)

    def sequence(self, first: int, count: int, exposure_us: int, period_us: int, mode: SequenceMode) -> None:
        """Begin a sequence and collect its events."""
        with self._lock:
            self._link.events.clear()
            self._ask("SEQ", first, count, exposure_us, period_us, int(mode), takes_s=self._box.light_s)

    def trigger(self, index: int) -> tuple[int, int]:
        """Light the next pattern of a waiting sequence, which is `index`; return as `show` does."""
        with self._lock:
            return self._read_light_time(self._ask("TRIG", takes_s=self._box.light_s), index)

    def stop(self) -> int:
        """End a sequence, dark; return the number of patterns that were lit."""
        return _integer(self._ask("STOP"), 0)

    def blank(self) -> None:
        """Go dark."""
        self._ask("BLANK")

    def status(self) -> BoxStatus:
        """Return the current state of the box."""
        return _parse_fields(BoxStatus, self._ask("STATUS").words)

    def frames(self) -> tuple[tuple[int, int, int], ...]:
        """Return (index, t_visible_ns, t_err_ns) of the patterns of the last sequence whose events were received."""
        with self._lock:
            found = []
            for event in self._link.events:
                match event:
                    case BoxEvent("FRAME", (index, t_us)) if index.isdigit() and t_us.isdigit():
                        t_ns, error_ns = self._clock.host_ns(int(t_us))
                        found.append((int(index), t_ns, error_ns + self._box.error_us * 1000))
            return tuple(found)

    def abandon(self) -> None:
        """Send no more signs of life until `load`, so that the watchdog of the box puts the light out."""
        self._abandoned.set()

    def close(self) -> None:
        """Go dark, end the session and close the port; from any thread, in any state. Idempotent; never raises."""
        self._link.closing.set()
        self._abandoned.set()
        with self._lock:
            with suppress(SlrigError):
                for verb in ("BLANK", "BYE"):
                    self._link.ask(verb, deadline_s=_FAREWELL_S, while_closing=True)
            self._link.port.close()

    def _ask(self, verb: str, *numbers: int | str, takes_s: float = 0.0) -> Reply:
        with self._lock:
            return self._link.ask(verb, *numbers, takes_s=takes_s)

    def _note_ping(self, reply: Reply) -> tuple[str, int]:
        self._clock.note(_integer(reply, 0), reply.sent_ns, reply.received_ns)
        return reply.words[1] if len(reply.words) > 1 else "", _integer(reply, 2)

    def _read_light_time(self, reply: Reply, index: int) -> tuple[int, int]:
        if _integer(reply, 0) != index:
            message = (
                f"requested pattern {index} from the trigger box on {self._label}, found {reply.words}; its "
                "firmware is faulty"
            )
            raise DeviceError(message)
        t_us = _integer(reply, 1)
        self._clock.note(t_us, reply.sent_ns, reply.received_ns)
        t_ns, error_ns = self._clock.host_ns(t_us)
        return t_ns, error_ns + self._box.error_us * 1000

    def _greet_box(self) -> BoxInfo:
        """Send HELLO until the box has started; many boards restart when their port is opened."""
        link = self._link
        until_ns = link.after(self._open_s)
        while True:
            left_s = (until_ns - link.clock.now_ns()) / 1e9
            try:
                box = self._check_box(self._send_hello(max(left_s, link.reply_s)))
                for _ in range(_PINGS):
                    self._note_ping(link.ask("PING"))
            except BoxRefusedError as refusal:
                if refusal.number == RefusalCode.RANGE:
                    raise UnsupportedByDeviceError(self._limits_message(refusal)) from refusal
                if refusal.number not in {RefusalCode.BUSY, RefusalCode.SESSION}:
                    raise
                # Another host's session may be ending, or the box has just restarted and lost this session.
                if left_s > 0:
                    link.clock.wait_until(link.after(_GREET_RETRY_S), link.closing)
                    if not link.closing.is_set():
                        continue
                raise DeviceBusyError(self._busy_message(" ".join(refusal.words))) from refusal
            return box

    def _send_hello(self, deadline_s: float) -> BoxInfo:
        limits = self._limits
        request = (PROTOCOL, limits.watchdog_ms, limits.on_ms, limits.duty, limits.bright)
        try:
            reply = self._link.ask("HELLO", *request, tries=_UNLIMITED_TRIES, deadline_s=deadline_s)
        except NoAnswerError as silence:
            if self._link.tally.others:
                raise DeviceBusyError(self._busy_message("answers to another host were received")) from silence
            raise DeviceError(self._silence_message(silence)) from silence
        return _parse_fields(BoxInfo, reply.words)

    def _check_box(self, box: BoxInfo) -> BoxInfo:
        """Return the box if it is usable. Raises DeviceError, UnsupportedByDeviceError."""
        exceeded = [
            f"{field.name} {getattr(box, field.name)} instead of {getattr(self._limits, field.name)}"
            for field in fields(BoxLimits)
            if getattr(box, field.name) > getattr(self._limits, field.name)
        ]
        if min(box.w, box.h, box.watchdog_ms, box.on_ms) < 1:
            message = f"the trigger box on {self._label} describes itself as {box}; its firmware is faulty"
            raise DeviceError(message)
        if box.sltp != PROTOCOL or exceeded:
            message = (
                f"the trigger box on {self._label} ({box.model} {box.fw}) speaks SLTP/{box.sltp} and grants "
                f"{', '.join(exceeded) or 'the requested limits'}; flash firmware of SLTP/{PROTOCOL} that keeps to them"
            )
            raise UnsupportedByDeviceError(message)
        return box

    def _busy_message(self, by: str) -> str:
        return (
            f"the trigger box on {self._label} is in a session with another host ({by}); end that one, or wait for its "
            "watchdog if it has failed"
        )

    def _limits_message(self, refusal: BoxRefusedError) -> str:
        return (
            f"the trigger box on {self._label} does not grant {self._limits}: {' '.join(refusal.words)}; a box that "
            "cannot dim takes brightness 1 only, else see watchdog_s, max_on_s and max_duty"
        )

    def _silence_message(self, silence: NoAnswerError) -> str:
        return (
            f"no trigger box that speaks SLTP/{PROTOCOL} answered on {self._label}: {silence}. Is it the "
            "right port (slrig devices), and is the firmware on the box?"
        )


def _integer(reply: Reply, index: int) -> int:
    """Return word `index` of an answer as a number. Raises DeviceError."""
    try:
        return int(reply.words[index])
    except (IndexError, ValueError) as error:
        message = (
            f"the trigger box answered {' '.join(reply.words)!r}, expected a number at {index}; its firmware is faulty"
        )
        raise DeviceError(message) from error


def _parse_fields(model: type[_Values], words: tuple[str, ...]) -> _Values:
    """Build a value from `key=value` words, ignoring unknown keys of newer firmware. Raises DeviceError."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    values: dict[str, Any] = {}
    faults = []
    for field in fields(model):
        text = given.get(field.name)
        if text is None and field.default is not MISSING:
            continue
        if text is None:
            faults.append(f"no {field.name}")
        elif field.type == "str":
            values[field.name] = text
        elif text.isdigit():
            values[field.name] = int(text)
        elif text == "-1" and field.default is None:
            # Firmware 1.0 sends -1 for none.
            continue
        else:
            faults.append(f"{field.name}={text}, no whole number")
    if faults:
        message = f"the trigger box answered {' '.join(words)!r}: {', '.join(faults)}; its firmware is faulty"
        raise DeviceError(message)
    return model(**values)


class KeepAlive:
    """Thread that sends signs of life to a box until it is stopped, except while the box is abandoned.

    They show that the process lives, not its calling thread: the box puts out a pattern that a stuck caller leaves lit
    after `max_on_s`. clock : for waiting.
    """

    def __init__(self, client: BoxClient, *, watchdog_s: float, clock: Clock) -> None:
        self._client, self._clock = client, clock
        self._period_ns = round(watchdog_s * 1e9 / BEATS_PER_WATCHDOG)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial projector", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread. Idempotent; from any thread."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while True:
            self._clock.wait_until(self._clock.now_ns() + self._period_ns, self._stop)
            if self._stop.is_set():
                return
            try:
                self._client.beat()
            except DeviceError:
                # The next command of the caller reports the error.
                continue

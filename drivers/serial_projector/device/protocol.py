"""The protocol core of a trigger box: SLTP/1 bytes in and out, and calls of a `BoxHardware`.

Pure: no pin, no port, no clock of its own. Runs unchanged in MicroPython (1.20 or newer) and in CPython. The docstring
of `drivers.serial_projector` describes verbs, fields and codes.
"""

# MicroPython has no `__future__`.

import binascii

try:
    from drivers.serial_projector.device import wire
    from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError, LightTime
except ImportError:
    # On a box the files are in one folder.
    import wire  # type: ignore[import-not-found, no-redef]
    from box import (  # type: ignore[import-not-found, no-redef]
        BoxDescription,
        BoxHardware,
        HardwareError,
        LightTime,
    )

MIN_WATCHDOG_MS = 50
MAX_PICKED = 512
"""Maximum number of patterns of PICK."""
_UNDER_LIGHT = ("lit", "playing", "waiting")


class BoxRefusal(Exception):  # noqa: N818 - an answer, not an error of the box
    """Refusal of a command."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__(words)
        self.code, self.words = code, words


class TriggerBox:
    """A box. Pass it every received byte (`feed`), call `poll` as often as possible, and send the bytes that both
    return.
    """

    def __init__(self, hardware: BoxHardware, description: BoxDescription, boot_id: int) -> None:
        self._hardware, self._description, self._boot = hardware, description, boot_id
        self._buffer = b""
        self._out: list[bytes] = []
        self._session = ""
        self._open = False
        self._number = -1
        self._reply = b""
        self._heard_us = 0
        self._watchdog_us, self._on_us, self._duty = MIN_WATCHDOG_MS * 1000, 0, 0
        self._order: list[int] = []
        self._picked: list[int] = []
        self._gap_us = description.gap_us
        self._state = "idle"
        self._fault = 0
        self._light_time = LightTime()
        self._lit = False
        self._lit_us = 0
        self._must_darken = False
        self._index = -1
        self._shows = 0
        self._sequence = (0, 0, 0, 0)
        self._next_us = self._off_us = 0
        self._frames = 0
        self._switch_off()

    def feed(self, data: bytes) -> bytes:
        """Process received bytes; return the bytes to send."""
        self._check_time()
        self._buffer += data
        while True:
            end = self._buffer.find(b"\n")
            if end < 0:
                break
            line, self._buffer = self._buffer[:end], self._buffer[end + 1 :]
            if line:
                self._out.append(self._answer(line))
        if len(self._buffer) > wire.MAX_LINE_BYTES:
            self._buffer = b""
        return self._flush()

    def poll(self) -> bytes:
        """Do all due work; return the bytes to send."""
        self._check_time()
        return self._flush()

    def wait_us(self) -> int:
        """Return the time until `poll` has work; -1 if only a command can cause any."""
        now_us = self._hardware.time_us()
        due = []
        if self._must_darken:
            due.append(now_us + 1000)
        if self._lit:
            due.append(self._lit_us + self._on_us)
            if self._duty < 1000:
                due.append(now_us + max(self._light_time.left_us(self._duty), 1))
        if self._state in _UNDER_LIGHT:
            due.append(self._heard_us + self._watchdog_us)
        if self._state == "playing" or (self._state == "waiting" and self._lit):
            due.append(self._off_us if self._lit else self._next_us)
        return max(min(due) - now_us, 0) if due else -1

    def _flush(self) -> bytes:
        out, self._out = self._out, []
        return b"".join(out)

    def _event(self, text: str) -> None:
        self._out.append(wire.encode_line("! " + text))

    # Timed actions.

    def _check_time(self) -> None:
        now_us = self._hardware.time_us()
        self._light_time.note(now_us, self._lit)
        if self._must_darken:
            self._switch_off()
        if self._state in _UNDER_LIGHT and now_us - self._heard_us > self._watchdog_us:
            self._raise_fault(wire.WATCHDOG)
        elif self._lit and now_us - self._lit_us > self._on_us:
            self._raise_fault(wire.ON_TIME)
        elif self._lit and self._light_used_up():
            self._raise_fault(wire.DUTY)
        elif self._state in ("playing", "waiting"):
            try:
                self._advance_sequence(now_us)
            except HardwareError:
                self._raise_fault(wire.LIGHT)

    def _advance_sequence(self, now_us: int) -> None:
        """Do the next step of a sequence, if it is due."""
        first, count, _, period_us = self._sequence
        if self._lit and now_us >= self._off_us:
            self._switch_off()
            if self._frames == count:
                self._state = "ready"
                self._event(f"DONE {count}")
                return
            self._hardware.select(self._order[first + self._frames])
            self._next_us = max(self._next_us + period_us, self._hardware.time_us())
        elif not self._lit and self._state == "playing" and now_us >= self._next_us:
            self._light_frame()

    def _light_frame(self) -> int:
        """Light the selected pattern of a sequence, and trigger the cameras."""
        first, _, exposure_us, _ = self._sequence
        t_us = self._light()
        self._hardware.pulse(exposure_us)
        self._off_us = self._hardware.time_us() + exposure_us + self._description.hold_us
        self._index = first + self._frames
        self._frames += 1
        self._event(f"FRAME {self._index} {t_us}")
        return t_us

    def _light(self) -> int:
        self._hardware.light()
        now_us = self._hardware.time_us()
        self._light_time.note(now_us, False)
        self._lit, self._lit_us = True, now_us
        self._shows += 1
        return now_us

    def _switch_off(self) -> None:
        self._must_darken = True
        try:
            self._hardware.switch_off()
        except HardwareError:
            # Retried by every poll.
            if self._fault != wire.LIGHT:
                self._fault = wire.LIGHT
                self._event(f"FAULT {wire.LIGHT}")
            return
        self._must_darken = False
        self._light_time.note(self._hardware.time_us(), self._lit)
        self._lit = False

    def _raise_fault(self, code: int) -> None:
        self._switch_off()
        self._state = "ready" if self._order else "idle"
        self._fault = code
        self._event(f"FAULT {code}")

    # Commands of the host.

    def _answer(self, line: bytes) -> bytes:
        text = wire.decode_line(line)
        words = text.split(" ") if text is not None else []
        if len(words) < 3 or len(words[0]) != 4 or not words[1].isdigit() or int(words[1]) >= wire.NUMBERS:
            return wire.encode_line(f"? ERR {wire.FRAMING} bad frame")
        session, number, verb = words[0], int(words[1]), words[2]
        now_us = self._hardware.time_us()
        if session == self._session:
            # A sign of life, even if the line is a repetition.
            self._heard_us = now_us
            ahead = (number - self._number) % wire.NUMBERS
            if ahead == 0:
                return self._reply
            if ahead >= wire.NUMBERS // 2:
                return wire.encode_line(f"{session} {number} ERR {wire.STATE} number {number} after {self._number}")
        if session != self._session or not self._open:
            silent_us = now_us - self._heard_us
            if self._open and silent_us <= self._watchdog_us:
                return wire.encode_line(f"{session} {number} ERR {wire.BUSY} held by {self._session}")
            if verb != "HELLO":
                return wire.encode_line(f"{session} {number} ERR {wire.SESSION} say HELLO")
            self._session, self._open, self._heard_us = session, False, now_us
        self._number = number
        try:
            done = self._execute(verb, words[3:])
            answer = f"{session} {number} OK {done}" if done else f"{session} {number} OK"
        except BoxRefusal as refusal:
            answer = f"{session} {number} ERR {refusal.code} {refusal.words}"
        except HardwareError as error:
            self._raise_fault(wire.LIGHT)
            answer = f"{session} {number} ERR {wire.HARDWARE} {error}"
        self._reply = wire.encode_line(answer)
        return self._reply

    def _execute(self, verb: str, words: list[str]) -> str:
        if verb not in ("HELLO", "PING", "PICK", "LOAD", "SHOW", "SEQ", "TRIG", "STOP", "BLANK", "STATUS", "BYE"):
            raise BoxRefusal(wire.VERB, verb)
        expected = {"HELLO": 5, "LOAD": 2, "SHOW": 1, "SEQ": 5, "PICK": max(len(words), 2)}.get(verb, 0)
        checksums = verb in ("PICK", "LOAD")
        try:
            numbers = [int(word, 16 if checksums and at else 10) for at, word in enumerate(words)]
        except ValueError:
            numbers = []
        if len(numbers) != len(words) or len(words) != expected or (numbers and min(numbers) < 0):
            raise BoxRefusal(wire.RANGE, f"{verb} takes {expected} numbers")
        answer: str = getattr(self, "_" + verb.lower())(*numbers)
        return answer

    def _hello(self, version: int, watchdog_ms: int, on_ms: int, duty: int, bright: int) -> str:
        about = self._description
        self._picked = []
        self._darken("idle")
        self._open = False
        if version != wire.VERSION:
            raise BoxRefusal(wire.RANGE, f"speaks SLTP/{wire.VERSION}")
        if watchdog_ms < MIN_WATCHDOG_MS or on_ms < 1 or not 1 <= duty <= 1000 or not 1 <= bright <= 1000:
            raise BoxRefusal(wire.RANGE, "limits")
        granted = self._hardware.set_brightness(bright)
        if granted > bright:
            raise BoxRefusal(wire.RANGE, f"bright {granted}")
        watchdog_ms, on_ms, duty = min(watchdog_ms, about.watchdog_ms), min(on_ms, about.on_ms), min(duty, about.duty)
        self._watchdog_us, self._on_us, self._duty = watchdog_ms * 1000, on_ms * 1000, duty
        self._open = True
        return (
            f"sltp={wire.VERSION} model={about.model} fw={about.firmware} w={about.width_px} h={about.height_px} "
            f"max={about.count} boot={self._boot:08X} watchdog_ms={watchdog_ms} on_ms={on_ms} duty={duty} "
            f"bright={granted} light_us={about.light_us} error_us={about.error_us} gap_us={about.gap_us} "
            f"hold_us={about.hold_us} least_us={about.least_us} pick={MAX_PICKED} pulse=exposure"
        )

    def _ping(self) -> str:
        return f"{self._hardware.time_us()} {self._state} {self._fault}"

    def _pick(self, at: int, *crc32: int) -> str:
        self._darken("idle")
        if at == 0:
            self._picked = []
        if at != len(self._picked) or at + len(crc32) > MAX_PICKED or max(crc32) > 0xFFFFFFFF:
            raise BoxRefusal(wire.RANGE, f"{at} after {len(self._picked)}, most {MAX_PICKED}")
        self._picked += [self._description.find(each) for each in crc32]
        return " ".join(
            [f"{len(self._picked)}"] + [f"{i}" for i, each in enumerate(self._picked) if each < 0 and i >= at]
        )

    def _load(self, count: int, crc32: int) -> str:
        self._darken("idle")
        about, order = self._description, self._picked
        self._picked = []
        if not order or len(order) != count or -1 in order or about.checksum(order) != crc32:
            order = self._find_run(count, crc32)
        self._order, self._gap_us, self._state = order, about.gap_for(order), "ready"
        return f"{count} {order[0]} {self._gap_us}"

    def _find_run(self, count: int, crc32: int) -> list[int]:
        """Find consecutive patterns of the flash with this checksum."""
        about = self._description
        if not 1 <= count <= about.count:
            raise BoxRefusal(wire.RANGE, f"{count} of {about.count}")
        for first in range(about.count - count + 1):
            if binascii.crc32(about.crc32[4 * first : 4 * (first + count)]) == crc32:
                return list(range(first, first + count))
        raise BoxRefusal(wire.PATTERNS, f"{about.count} {binascii.crc32(about.crc32):08X}")

    def _show(self, index: int) -> str:
        self._require_light(index)
        self._index = index
        self._switch_off()
        self._state = "ready"
        self._hardware.select(self._order[index])
        t_us = self._light()
        self._state = "lit"
        return f"{index} {t_us}"

    def _seq(self, first: int, count: int, exposure_us: int, period_us: int, mode: int) -> str:
        about = self._description
        self._require_light(first)
        if not 1 <= count <= len(self._order) - first or mode not in (wire.FREE, wire.STEP):
            raise BoxRefusal(wire.RANGE, f"{count} patterns from {first}, mode {mode}")
        if not about.least_us <= exposure_us <= self._on_us - about.hold_us or period_us < exposure_us + self._gap_us:
            raise BoxRefusal(wire.RANGE, f"exposure {exposure_us} period {period_us}")
        if mode == wire.FREE and (exposure_us + about.hold_us) * 1000 > self._duty * period_us:
            raise BoxRefusal(wire.LIMIT, f"duty {self._duty}")
        self._darken("ready")
        self._hardware.select(self._order[first])
        self._sequence, self._frames = (first, count, exposure_us, period_us), 0
        self._next_us = self._hardware.time_us() + about.gap_us
        self._state = "playing" if mode == wire.FREE else "waiting"
        return f"{self._next_us}"

    def _trig(self) -> str:
        self._require_no_fault()
        if self._state != "waiting" or self._lit:
            raise BoxRefusal(wire.STATE, "nothing waits" if self._state != "waiting" else "still lit")
        self._require_duty()
        t_us = self._light_frame()
        return f"{self._index} {t_us}"

    def _stop(self) -> str:
        self._darken("ready" if self._order else "idle")
        return f"{self._frames}"

    def _blank(self) -> str:
        self._darken("ready" if self._order else "idle")
        return ""

    def _bye(self) -> str:
        self._picked = []
        self._darken("idle")
        self._open = False
        return ""

    def _status(self) -> str:
        # No pattern was lit before the first light.
        index = f"index={self._index} " if self._index >= 0 else ""
        return (
            f"state={self._state} loaded={len(self._order)} first={self._order[0] if self._order else 0} {index}"
            f"frames={self._frames} shows={self._shows} fault={self._fault} t_us={self._hardware.time_us()}"
        )

    def _require_light(self, index: int) -> None:
        self._require_no_fault()
        if not self._order or self._state in ("playing", "waiting"):
            raise BoxRefusal(wire.STATE, self._state)
        if not 0 <= index < len(self._order):
            raise BoxRefusal(wire.RANGE, f"{index} of {len(self._order)}")
        self._require_duty()

    def _require_no_fault(self) -> None:
        if self._fault:
            raise BoxRefusal(wire.FAULT, f"{self._fault}")

    def _require_duty(self) -> None:
        if self._light_used_up():
            raise BoxRefusal(wire.LIMIT, f"duty {self._duty}")

    def _light_used_up(self) -> bool:
        return self._duty < 1000 and self._light_time.left_us(self._duty) <= 0

    def _darken(self, state: str) -> None:
        """End any activity on the host's request, which also acknowledges a fault."""
        self._state = state
        if state == "idle":
            self._order = []
        self._fault = 0
        self._switch_off()
        if self._must_darken:
            raise HardwareError("the light does not go out")

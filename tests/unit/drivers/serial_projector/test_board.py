"""The pins of the reference box, on a board in memory."""

# ruff: noqa: ARG002 - modules of MicroPython take what a test does not look at

from __future__ import annotations

import io
import sys
import types
from collections.abc import Callable
from unittest import mock

import pytest

from drivers.serial_projector.device import main
from drivers.serial_projector.device.box import HardwareError
from drivers.serial_projector.device.protocol import TriggerBox
from drivers.serial_projector.link import encode_line


class Pico:
    """A board whose clock stands still unless somebody sleeps. `did` : (µs, what) of every change of a pin."""

    def __init__(self) -> None:
        self.now_us = 0
        self.did: list[tuple[int, str]] = []
        self.levels: dict[int, int] = {}
        self.program: list[tuple[object, ...]] = []
        self.at_rest = -1
        board = self

        class Pin:
            """A pin."""

            IN, OUT, PULL_UP, PULL_DOWN = 0, 1, 2, 3

            def __init__(self, number: int, mode: int = 0, pull: int = 0, value: int | None = None) -> None:
                self.number = number
                if value is not None:
                    self.value(value)

            def value(self, value: int | None = None) -> int:
                if value is not None:
                    board.levels[self.number] = value
                    board.did.append((board.now_us, f"{self.number}={value}"))
                return board.levels.get(self.number, 0)

        class PWM:
            """A dimmed pin."""

            def __init__(self, pin: Pin, freq: int, duty_u16: int) -> None:
                self.pin = pin
                self.duty_u16(duty_u16)

            def duty_u16(self, level: int) -> None:
                self.pin.value(level)

        class StateMachine:
            """Runs the program, one word per µs, from one `pull` to the next."""

            def __init__(self, number: int, program: object, freq: int, set_base: Pin) -> None:
                self.us, self.pin = 1000000 // freq, set_base

            def active(self, active: int) -> None:
                assert active
                self.restart()

            def restart(self) -> None:
                """Begin anew; what it would have done later is not done."""
                board.did = [each for each in board.did if each[0] <= board.now_us]
                self.at = 0
                self.run(None)

            def put(self, word: int) -> None:
                """Give it a word: it runs until it wants the next one."""
                self.run(word)

            def run(self, word: int | None) -> None:
                x, osr, t_us = 0, 0, board.now_us
                program = board.program
                while True:
                    name, words = program[self.at][0], program[self.at][1:]
                    if name == "pull" and word is None:
                        return
                    self.at = (self.at + 1) % len(program)
                    t_us += self.us
                    if name == "pull":
                        assert word is not None
                        osr, word = word, None
                    elif name == "mov":
                        assert words == ("x", "osr")
                        x = osr
                    elif name == "set":
                        board.did.append((t_us, f"{self.pin.number}={words[1]}"))
                    elif name == "jmp":
                        assert words[0] == "x_dec"
                        x, again = x - 1, x > 0
                        if again:
                            self.at = program.index(("label", words[1]))
                    elif name == "label":
                        # No instruction: it takes no time.
                        t_us -= self.us

        class PIO:
            """Its levels."""

            OUT_LOW, OUT_HIGH = 0, 1

        def asm_pio(*, set_init: int) -> object:
            board.at_rest = set_init
            board.program = []

            def assembled(program) -> object:  # type: ignore[no-untyped-def]  # noqa: ANN001
                def word(name: str):  # type: ignore[no-untyped-def]  # noqa: ANN202
                    return lambda *words: board.program.append((name, *words))

                known = program.__globals__
                kept = dict(known)
                known.clear()
                for name in ("pull", "mov", "set", "label", "jmp"):
                    known[name] = word(name)
                for name in ("block", "x", "osr", "pins", "x_dec"):
                    known[name] = name
                program()
                known.clear()
                known.update(kept)
                return program

            return assembled

        self.machine = type("machine", (), {"Pin": Pin, "PWM": PWM})
        self.rp2 = type("rp2", (), {"asm_pio": staticmethod(asm_pio), "PIO": PIO, "StateMachine": StateMachine})
        self.time = self

    def ticks_us(self) -> int:
        """As the real one: it wraps."""
        return self.now_us % (1 << 30)

    def ticks_diff(self, later: int, earlier: int) -> int:
        return (later - earlier + (1 << 29)) % (1 << 30) - (1 << 29)

    def sleep_us(self, us: int) -> None:
        self.now_us += us


FULL = 65535
PATTERNS = {"size_px": [main.WIDTH_PX, main.HEIGHT_PX], "crc32": [f"{number:08X}" for number in range(26)]}


@pytest.fixture
def pico() -> Pico:
    board = Pico()
    board.levels[main.READY_PIN] = 1
    return board


@pytest.fixture
def board(pico: Pico) -> main.PicoBoard:
    return main.PicoBoard(pico.machine, pico.rp2, pico.time)


def pulses(pico: Pico, pin: int) -> int:
    return sum(what == f"{pin}=1" for _, what in pico.did)


def test_it_starts_dark_and_a_pattern_is_reached_by_steps_from_home(pico: Pico, board: main.PicoBoard) -> None:
    assert pico.levels[main.LAMP_PIN] == 0
    assert board.time_us() == 0
    for pattern, homed, stepped in ((3, 1, 3), (5, 1, 5), (5, 1, 5), (1, 2, 6)):
        board.select(pattern)
        assert (pulses(pico, main.HOME_PIN), pulses(pico, main.STEP_PIN)) == (homed, stepped)
    assert pico.levels[main.LAMP_PIN] == 0


def test_an_engine_whose_home_is_a_low_level_runs_in_between(pico: Pico, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(main, "HOME_LEVEL", 0)
    monkeypatch.setattr(main, "STEPS_TO_FIRST", 1)
    board = main.PicoBoard(pico.machine, pico.rp2, pico.time)
    assert pico.levels[main.HOME_PIN] == 1
    board.select(2)
    assert pico.levels[main.HOME_PIN] == 1
    assert sum(what == f"{main.HOME_PIN}=0" for _, what in pico.did) == 1
    assert pulses(pico, main.STEP_PIN) == 3


def test_an_engine_that_is_not_ready_is_a_failure_and_homed_next_time(pico: Pico, board: main.PicoBoard) -> None:
    board.select(2)
    pico.levels[main.READY_PIN] = 0

    counted = board.time_us

    def later_us() -> int:
        pico.now_us += 100
        return counted()

    board.time_us = later_us  # type: ignore[method-assign]
    with pytest.raises(HardwareError, match="READY"):
        board.select(3)
    pico.levels[main.READY_PIN] = 1
    board.select(3)
    assert pulses(pico, main.HOME_PIN) == 2


def test_light_follows_the_lamp_and_its_brightness(pico: Pico, board: main.PicoBoard) -> None:
    board.light()
    assert pico.levels[main.LAMP_PIN] == FULL
    board.switch_off()
    assert pico.levels[main.LAMP_PIN] == 0
    assert board.set_brightness(250) == 250
    assert pico.levels[main.LAMP_PIN] == 0
    board.light()
    assert pico.levels[main.LAMP_PIN] == FULL // 4


@pytest.mark.parametrize("level", [1, 0])
def test_the_cameras_get_a_pulse_as_long_as_the_exposure(
    pico: Pico, level: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(main, "CAMERA_LEVEL", level)
    board = main.PicoBoard(pico.machine, pico.rp2, pico.time)
    assert pico.at_rest == 1 - level
    for us in (200, 5_000):
        pico.did.clear()
        board.pulse(us)
        (begin_us, begun), (end_us, ended) = pico.did
        assert (begun, ended) == (f"{main.CAMERA_PIN}={level}", f"{main.CAMERA_PIN}={1 - level}")
        # The sensor adds 14.26 µs.
        assert end_us - begin_us == us - 14
    # The light goes out before its time.
    board.pulse(5_000)
    pico.now_us += 1_000
    board.switch_off()
    assert pico.did[-1] == (pico.now_us - main.LAMP_US + 1, f"{main.CAMERA_PIN}={1 - level}")


def test_its_time_never_wraps(pico: Pico, board: main.PicoBoard) -> None:
    for step in range(1, 41):
        pico.now_us += 200_000_000
        assert board.time_us() == 200_000_000 * step


def test_only_patterns_of_the_engines_extent_are_offered() -> None:
    assert main.describe_box(PATTERNS).count == 26
    assert main.describe_box({"size_px": [1, 1], "crc32": ["00000000"]}).count == 0
    assert main.describe_box({}).count == 0


class Ended(Exception):  # noqa: N818 - not a failure
    """The program would run for ever."""


class Usb:
    """The board's serial port: what comes in, one piece per turn, then the end."""

    def __init__(self, *pieces: bytes) -> None:
        self.pieces = list(pieces)
        self.sent = b""

    def read(self) -> bytes:
        if not self.pieces:
            raise Ended
        return self.pieces.pop(0)

    def write(self, data: bytes) -> None:
        self.sent += data


def test_the_program_answers_feeds_its_watchdog_and_tidies_in_the_dark(board: main.PicoBoard) -> None:
    alive: list[int] = []
    tidied: list[int] = []
    hello = encode_line("1A2B 1 HELLO 1 1000 5000 1000 1000")
    pings = [encode_line(f"1A2B {2 + number} PING") for number in range(2 * main.TIDY_AFTER)]
    usb = Usb(b"", hello[:9], hello[9:], *pings, b"")
    box = TriggerBox(board, main.describe_box(PATTERNS), 1)
    with pytest.raises(Ended):
        main.serve(box, usb, lambda: alive.append(1), lambda: tidied.append(len(alive)))  # type: ignore[arg-type]
    assert usb.sent.count(b" OK ") == 1 + 2 * main.TIDY_AFTER
    assert len(alive) == 5 + 2 * main.TIDY_AFTER
    # The first answer is that to HELLO, in the third turn.
    assert tidied == [2 + main.TIDY_AFTER, 2 + 2 * main.TIDY_AFTER]


def test_the_usb_port_gives_what_is_there_and_does_not_wait() -> None:
    sent, waiting = encode_line("1A2B 1 PING") * 10, io.BytesIO(encode_line("1A2B 1 PING") * 10)
    poll = mock.Mock(poll=lambda _: [1] if waiting.tell() < len(sent) else [])
    system = mock.Mock()
    system.stdin.buffer = waiting
    port = main.UsbPort(mock.Mock(poll=lambda: poll, POLLIN=1), system)
    taken = b""
    while data := port.read():
        assert len(data) <= 64
        taken += data
    assert taken == sent
    port.write(b"x")
    system.stdout.buffer.write.assert_called_once_with(b"x")


@pytest.fixture
def on_the_board(pico: Pico, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Runs the program on the board until its USB port ends; returns what it did besides."""
    done: list[str] = []

    def watchdog(timeout: int) -> types.SimpleNamespace:
        done.append(f"watchdog {timeout}")
        return types.SimpleNamespace(feed=lambda: None)

    def run(*pieces: bytes, service: int = 1) -> list[str]:
        pico.levels[main.SERVICE_PIN] = service
        machine = types.SimpleNamespace(
            Pin=pico.machine.Pin,  # type: ignore[attr-defined]
            PWM=pico.machine.PWM,  # type: ignore[attr-defined]
            WDT=watchdog,
        )
        micropython = types.SimpleNamespace(kbd_intr=lambda key: done.append(f"key {key}"))
        for name, module in (("machine", machine), ("rp2", pico.rp2), ("micropython", micropython), ("time", pico)):
            monkeypatch.setitem(sys.modules, name, module)
        usb = Usb(*pieces)
        monkeypatch.setattr(main, "UsbPort", lambda _select, _sys: usb)
        try:
            main.run()
        except Ended:
            done.append("ended")
        monkeypatch.undo()
        done.append(usb.sent.decode())
        return done

    return run


def test_the_program_leaves_the_light_out_however_it_ends(
    pico: Pico, on_the_board: Callable[..., list[str]], tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(str(tmp_path))
    did = on_the_board(encode_line("1A2B 1 HELLO 1 1000 5000 1000 1000"))
    assert did[:3] == ["key -1", f"watchdog {main.RESTART_MS}", "ended"]
    assert "model=slrig-pico" in did[3]
    assert "max=0" in did[3], "there is no patterns.json here"
    assert pico.levels[main.LAMP_PIN] == 0


def test_a_jumper_keeps_the_program_from_starting(pico: Pico, on_the_board: Callable[..., list[str]]) -> None:
    assert on_the_board(service=0) == [""]
    assert main.LAMP_PIN not in pico.levels

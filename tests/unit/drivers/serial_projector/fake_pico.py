"""The modules of MicroPython on an RP2040, for the pins of the reference box: everything that they do is noted."""

# MicroPython has no `__future__`. What its modules take and a test does not look at is taken all the same.
# ruff: noqa: ARG002


class Board:
    """A board whose clock stands still unless somebody sleeps. `did` : (µs, what) of every change of a pin."""

    def __init__(self) -> None:
        self.now_us = 0
        self.did: list[tuple[int, str]] = []
        self.levels: dict[int, int] = {}
        self.program: list[tuple[object, ...]] = []
        board = self

        class Pin:
            """A pin."""

            IN, OUT, PULL_UP, PULL_DOWN = 0, 1, 2, 3

            def __init__(self, number: int, mode: int = 0, pull: int = 0, value: "int | None" = None) -> None:
                self.number = number
                if value is not None:
                    self.value(value)

            def value(self, value: "int | None" = None) -> int:
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
            """Runs the program, one word per µs."""

            def __init__(self, number: int, program: object, freq: int, set_base: Pin) -> None:
                self.us, self.pin, self.is_active = 1000000 // freq, set_base, 0

            def active(self, active: int) -> None:
                self.is_active = active

            def put(self, word: int) -> None:
                """Give it a word: it runs until it wants the next one."""
                assert self.is_active
                at, x, osr, t_us = 0, 0, 0, board.now_us
                program = board.program
                while True:
                    name, words = program[at][0], program[at][1:]
                    at += 1
                    t_us += self.us
                    if name == "pull":
                        if osr:
                            return
                        osr = word
                    elif name == "mov":
                        assert words == ("x", "osr")
                        x = osr
                    elif name == "set":
                        board.did.append((t_us, f"{self.pin.number}={words[1]}"))
                    elif name == "jmp":
                        assert words[0] == "x_dec"
                        x, again = x - 1, x > 0
                        if again:
                            at = program.index(("label", words[1]))
                    elif name == "label":
                        # No instruction: it takes no time.
                        t_us -= self.us
                    at %= len(program)

        class PIO:
            """Its levels."""

            OUT_LOW = 0

        def asm_pio(**options: int) -> object:
            assert options == {"set_init": PIO.OUT_LOW}

            def assembled(program) -> object:  # type: ignore[no-untyped-def]  # noqa: ANN001
                def word(name: str):  # type: ignore[no-untyped-def]  # noqa: ANN202
                    return lambda *words: board.program.append((name,) + words)  # noqa: RUF005 - MicroPython cannot

                known = program.__globals__
                kept = dict(known)
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

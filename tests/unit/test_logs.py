"""Log lines: text for people, JSON for programs, and never among what a command prints."""

from __future__ import annotations

import errno
import io
import json
import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from slrig import logs
from slrig.logs import LogFormat, set_up_console_logs, set_up_logs
from tests.unit.command import slrig


@pytest.fixture(autouse=True)
def _as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What tells of errors in these tests is pytest's, and is again afterwards."""
    root = logging.getLogger()
    monkeypatch.setattr(logs, "_chosen", None)
    for owner, name in ((sys, "excepthook"), (sys, "unraisablehook"), (threading, "excepthook"), (root, "handlers")):
        monkeypatch.setattr(owner, name, getattr(owner, name))
    level = root.level
    yield
    logging.captureWarnings(capture=False)
    root.setLevel(level)


class Stream(io.StringIO):
    """A standard error that is, or is not, a terminal."""

    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal


def line(monkeypatch: pytest.MonkeyPatch, form: LogFormat, *, terminal: bool) -> str:
    stream = Stream(terminal=terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    set_up_logs("info", form)
    structlog.get_logger().warning("the rig cannot be opened", rig="bench", cause="no light")
    return stream.getvalue()


def test_terminal_shows_text_and_pipe_carries_json_unless_a_form_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = line(monkeypatch, "auto", terminal=True)
    assert "{" not in shown
    assert shown.index("the rig cannot be opened") < shown.index("bench") < shown.index("no light")
    carried = json.loads(line(monkeypatch, "auto", terminal=False))
    assert (carried["event"], carried["cause"]) == ("the rig cannot be opened", "no light")
    assert carried["timestamp"].endswith("Z")
    written = line(monkeypatch, "text", terminal=False)
    assert written.partition(" ")[2] == "[warning] the rig cannot be opened rig=bench cause='no light'\n"
    assert json.loads(line(monkeypatch, "json", terminal=True))["rig"] == "bench"


def test_error_is_logged_with_its_trace_in_either_form(monkeypatch: pytest.MonkeyPatch) -> None:
    for form in ("text", "json"):
        stream = Stream(terminal=False)
        monkeypatch.setattr(sys, "stderr", stream)
        set_up_logs("info", form)
        try:
            [][0]
        except IndexError:
            structlog.get_logger().exception("it failed")
        assert "Traceback" in stream.getvalue()
        assert "IndexError" in stream.getvalue()


@pytest.mark.parametrize("command", ["conform", "latency", "doctor", "verify", "accept", "reconstruct", "calibrate"])
def test_command_that_works_by_itself_sets_up_logs(tmp_path: Path, command: str) -> None:
    solve = ["solve"] if command == "calibrate" else []
    output = [] if command in {"conform", "latency", "doctor", "verify"} else ["--output", tmp_path / "absent.json"]
    result = slrig(command, *solve, tmp_path / "absent", *output)
    assert result.exit_code == 2, result.output
    assert structlog.is_configured()


def test_person_reads_warnings_and_no_more(capsys: pytest.CaptureFixture[str]) -> None:
    set_up_console_logs()
    structlog.get_logger().info("a frame was shot again")
    structlog.get_logger().warning("the projector may still be lit")
    written = capsys.readouterr()
    assert written.out == ""
    assert "the projector may still be lit" in written.err
    assert "a frame was shot again" not in written.err


@pytest.mark.parametrize(
    "said",
    [
        "Authorization: Bearer {}",
        "authorization: Basic {}",
        "illegal header line: bytearray(b'X-API-Key:{}')",
        "headers [(b'authorization', b'Bearer {}'), (b'cookie', b'slrig={}')]",
        "{{'x-api-key': '{}', 'Set-Cookie': 'slrig_session={}; HttpOnly'}}",
        "SLRIG_API_KEY={}",
    ],
)
@pytest.mark.parametrize("form", ["text", "json"])
def test_key_is_in_no_line(monkeypatch: pytest.MonkeyPatch, said: str, form: LogFormat) -> None:
    key = "5tYw-Zm9v_YmFy.0x~Q=="
    stream = Stream(terminal=False)
    monkeypatch.setattr(sys, "stderr", stream)
    set_up_logs("info", form)
    logging.getLogger("uvicorn.error").error("refused %s", said.format(key, key))
    structlog.get_logger().warning("refused", request=said.format(key, key))
    assert stream.getvalue().count("refused") == 2
    assert "5tYw" not in stream.getvalue()


def test_text_moves_no_cursor(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream(terminal=False)
    monkeypatch.setattr(sys, "stderr", stream)
    set_up_logs("info", "text")
    structlog.get_logger().warning("removed", label="a\x1b[2Jb")
    logging.getLogger("uvicorn.error").error("\x1b[2J")
    assert "\x1b" not in stream.getvalue()
    assert stream.getvalue().count("u001b[2J") == 2


def test_log_that_cannot_be_written_raises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(Stream):
        def write(self, _text: str) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sys, "stderr", Full(terminal=False))
    set_up_logs("info", "json")
    structlog.get_logger().error("lost")
    logging.getLogger("asyncio").error("lost")

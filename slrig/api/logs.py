"""Where log lines go, and in what form: text for people, JSON for the programs that collect a service's log."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from typing import Literal

import structlog

LogFormat = Literal["auto", "text", "json"]


class _Log(structlog.PrintLogger):
    """A log that never fails whoever writes it: a full disk, a reader that is gone. The line is lost, not the work."""

    def msg(self, message: str) -> None:
        """Print a line if it can be printed."""
        with suppress(OSError):
            super().msg(message)

    log = debug = info = warn = warning = msg
    fatal = failure = err = error = critical = exception = msg


def set_up_logs(level: str, form: LogFormat = "auto") -> None:
    """Send log lines of `level` and above to stderr. form auto : text on a terminal, JSON elsewhere."""
    on_terminal = sys.stderr.isatty()
    text = on_terminal if form == "auto" else form == "text"
    renderers: list[structlog.typing.Processor] = (
        [
            # A person compares the time with their own clock, and reads the event, not columns.
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.dev.ConsoleRenderer(
                colors=on_terminal,
                pad_level=False,
                pad_event_to=0,
                sort_keys=False,
                exception_formatter=structlog.dev.plain_traceback,
            ),
        ]
        if text
        else [
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ]
    )
    structlog.configure(
        processors=[structlog.contextvars.merge_contextvars, structlog.processors.add_log_level, *renderers],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=lambda *_: _Log(sys.stderr),
        cache_logger_on_first_use=False,
    )


def set_up_logs_for_a_person() -> None:
    """For a command that does its work itself: warnings only, for it tells its progress and its errors by itself.

    Without it structlog writes on stdout, among what `--json` prints.
    """
    set_up_logs("warning", "text")

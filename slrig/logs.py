"""Logs: text for people, JSON for programs.

All lines have one form: those of our own loggers, those of libraries, Python's warnings, and the errors that end a
thread or the process. They all go through the root logger of the standard library.
"""

from __future__ import annotations

import logging
import re
import sys
import threading
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, TextIO

import structlog
from structlog.typing import EventDict, Processor, WrappedLogger

from slrig.printable import printable

LogFormat = Literal["auto", "text", "json"]

_SECRET = re.compile(
    r"(?P<name>\bbearer\s+|\b(?:authorization|x-api-key|(?:set-)?cookie|slrig_api_key)\b[\\'\"\])]*\s*[:=,]\s*(?:b?\\?['\"])?"
    r"(?:(?:bearer|basic)\s+)?)(?P<secret>[^\s\\'\",;]+)",
    re.IGNORECASE,
)
"""Keys, cookies and other credentials of the service in requests that a library quotes."""


@dataclass(frozen=True, slots=True)
class LogSettings:
    """Log settings of this process and of those that it starts."""

    level: str
    form: LogFormat


_chosen: LogSettings | None = None


def log_settings() -> LogSettings | None:
    """Return the log settings of this process; None if they were not set."""
    return _chosen


class _TolerantHandler(logging.StreamHandler[TextIO]):
    """A handler that never fails its caller: if the disk is full or the reader is gone, it loses the line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the standard library's own name
        """Ignore the error."""


class _OwnOrWarningFilter(logging.Filter):
    """Passes lines of slrig, and warnings and errors of libraries, which log their steps at lower levels."""

    def filter(self, record: logging.LogRecord) -> bool:
        """See `logging.Filter`."""
        return isinstance(record.msg, dict) or record.levelno >= logging.WARNING


class _Formatter(structlog.stdlib.ProcessorFormatter):
    """Formats a line, with secrets masked."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter`."""
        return _SECRET.sub(r"\g<name>***", super().format(record))


def set_up_logs(level: str, form: LogFormat = "auto") -> None:
    """Send log lines of `level` and above to stderr, and those of libraries from warnings on.

    Python's warnings, and errors that end a thread or the process, are logged too. form auto : text on a terminal, JSON
    elsewhere.
    """
    global _chosen
    _chosen = LogSettings(level, form)
    _configure(level, form)
    logging.captureWarnings(capture=True)
    threading.excepthook = _log_thread_error
    sys.excepthook = _log_process_error
    sys.unraisablehook = _log_unraisable_error


def set_up_console_logs() -> None:
    """Set up logs for a command that reports its own progress and errors: warnings only, as text on stderr.

    Without this call structlog writes to stdout, into the output of `--json`.
    """
    _configure("warning", "text")


def _configure(level: str, form: LogFormat) -> None:
    on_terminal = sys.stderr.isatty()
    text = on_terminal if form == "auto" else form == "text"
    common: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
    ]
    last: list[Processor] = (
        [
            # Local time, and no columns: a person reads this.
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            _escape_values,
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
    lines = _TolerantHandler(sys.stderr)
    lines.addFilter(_OwnOrWarningFilter())
    lines.setFormatter(
        _Formatter(
            foreign_pre_chain=common,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
        )
    )
    root = logging.getLogger()
    root.handlers = [*(handler for handler in root.handlers if not isinstance(handler, _TolerantHandler)), lines]
    root.setLevel(level.upper())
    structlog.configure(
        processors=[*common, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=structlog.stdlib.LoggerFactory(),
        cache_logger_on_first_use=False,
    )


def _escape_values(_logger: WrappedLogger, _method: str, event: EventDict) -> EventDict:
    """Escape control characters in values from outside, and omit the name of the logger."""
    event.pop("logger", None)
    return {
        name: printable(value.rstrip("\n")) if isinstance(value, str) and name != "exception" else value
        for name, value in event.items()
    }


def _log_thread_error(failed: threading.ExceptHookArgs) -> None:
    if failed.exc_type is not SystemExit:
        error = failed.exc_value or failed.exc_type()
        name = None if failed.thread is None else failed.thread.name
        structlog.get_logger(__name__).error("a thread ended by an error", thread=name, exc_info=error)


def _log_process_error(kind: type[BaseException], error: BaseException, _trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        structlog.get_logger(__name__).warning("the process was interrupted")
    else:
        structlog.get_logger(__name__).critical("the process ended by an error", exc_info=error)


def _log_unraisable_error(lost: sys.UnraisableHookArgs) -> None:
    message = lost.err_msg or "an error could not be raised"
    error = lost.exc_value
    structlog.get_logger(__name__).error(message, object=repr(lost.object), exc_info=error or lost.exc_type())

"""Logs: text for people, JSON for programs.

Every line has one form, whoever wrote it: our own loggers, those of libraries, Python's warnings, and the errors that
end a thread or the process. They all go through the root logger of the standard library.
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
"""A key, a cookie or what else opens the service, where a library quotes what it was sent."""


@dataclass(frozen=True, slots=True)
class LogSettings:
    """How this process logs. A process that it starts is told, and does the same."""

    level: str
    form: LogFormat


_chosen: LogSettings | None = None


def chosen() -> LogSettings | None:
    """How this process logs; None where nobody said."""
    return _chosen


class _Lines(logging.StreamHandler[TextIO]):
    """A log that never fails whoever writes it: a full disk, a reader that is gone. The line is lost, not the work."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the standard library's own name
        """Let it go."""


class _OursOrSerious(logging.Filter):
    """Lets pass what slrig says, and what is at least a warning of a library: alembic tells each of its steps."""

    def filter(self, record: logging.LogRecord) -> bool:
        """See `logging.Filter`."""
        return isinstance(record.msg, dict) or record.levelno >= logging.WARNING


class _Formatter(structlog.stdlib.ProcessorFormatter):
    """The form of a line, without what must not be in any."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter`."""
        return _SECRET.sub(r"\g<name>***", super().format(record))


def set_up_logs(level: str, form: LogFormat = "auto") -> None:
    """Send log lines of `level` and above to stderr, those of libraries from warnings on, with whatever would else be
    printed there as Python does: warnings, and the error that ends a thread or the process.

    form auto : text on a terminal, JSON elsewhere.
    """
    global _chosen
    _chosen = LogSettings(level, form)
    _set_up(level, form)
    logging.captureWarnings(capture=True)
    threading.excepthook = _thread_failed
    sys.excepthook = _process_failed
    sys.unraisablehook = _error_lost


def set_up_logs_for_a_person() -> None:
    """For a command that does its work itself: warnings only, for it tells its progress and its errors by itself.

    Without it structlog writes on stdout, among what `--json` prints.
    """
    _set_up("warning", "text")


def _set_up(level: str, form: LogFormat) -> None:
    on_terminal = sys.stderr.isatty()
    text = on_terminal if form == "auto" else form == "text"
    common: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
    ]
    last: list[Processor] = (
        [
            # A person compares the time with their own clock, and reads the event, not columns.
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            _printable_values,
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
    lines = _Lines(sys.stderr)
    lines.addFilter(_OursOrSerious())
    lines.setFormatter(
        _Formatter(
            foreign_pre_chain=common,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
        )
    )
    root = logging.getLogger()
    root.handlers = [*(handler for handler in root.handlers if not isinstance(handler, _Lines)), lines]
    root.setLevel(level.upper())
    structlog.configure(
        processors=[*common, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=structlog.stdlib.LoggerFactory(),
        cache_logger_on_first_use=False,
    )


def _printable_values(_logger: WrappedLogger, _method: str, event: EventDict) -> EventDict:
    """What strangers sent moves no cursor. The name of the logger is for programs."""
    event.pop("logger", None)
    return {
        name: printable(value.rstrip("\n")) if isinstance(value, str) and name != "exception" else value
        for name, value in event.items()
    }


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    if failed.exc_type is not SystemExit:
        error = failed.exc_value or failed.exc_type()
        name = None if failed.thread is None else failed.thread.name
        structlog.get_logger(__name__).error("a thread ended by an error", thread=name, exc_info=error)


def _process_failed(kind: type[BaseException], error: BaseException, _trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        structlog.get_logger(__name__).warning("the process was interrupted")
    else:
        structlog.get_logger(__name__).critical("the process ended by an error", exc_info=error)


def _error_lost(lost: sys.UnraisableHookArgs) -> None:
    words = lost.err_msg or "an error could not be told to anybody"
    error = lost.exc_value
    structlog.get_logger(__name__).error(words, object=repr(lost.object), exc_info=error or lost.exc_type())

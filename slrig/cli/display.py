"""Progress for people: a bar on a terminal, a line per stage elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

_EVERY_S = 2.0
"""How often a line tells of a stage that goes on, where there is no bar."""


class ProgressDisplay:
    """Told the stage, the fraction done and a detail; shows them on stderr."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        console = Console(file=stream)
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("[bold]{task.description:<20}", table_column=None),
                BarColumn(bar_width=None),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[detail]:<32}"),
                console=console,
            )
            self._task = self._bar.add_task("", total=1.0, detail="")
        self._stage = self._detail = ""
        self._began_s = self._told_s = time.monotonic()

    def start(self) -> None:
        """Begin to show."""
        if self._bar is not None:
            self._bar.start()

    def stop(self) -> None:
        """Leave what was shown, and show no more."""
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, stage: str, fraction: float, detail: str, /) -> None:
        """Show where the work is."""
        if self._bar is not None:
            shown = detail if len(detail) <= 32 else f"{detail[:31]}…"
            self._bar.update(self._task, description=stage, completed=fraction, detail=shown)
        elif stage != self._stage or (detail != self._detail and time.monotonic() - self._told_s >= _EVERY_S):
            self._told_s, self._detail = time.monotonic(), detail
            line = f"{self._told_s - self._began_s:6.1f} s  {fraction:4.0%}  {stage}"
            print(f"{line:<40}{detail}".rstrip(), file=self._stream, flush=True)
        self._stage = stage


@contextmanager
def progress_shown() -> Iterator[ProgressDisplay]:
    """A progress display on stderr for the length of a block."""
    display = ProgressDisplay(sys.stderr)
    display.start()
    try:
        yield display
    finally:
        display.stop()

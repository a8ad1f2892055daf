"""Output of commands: progress, a bar on a terminal and a line per stage elsewhere; tables; JSON."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Column, Table
from rich.text import Text

from slrig.jobs.listener import PREPARING
from slrig.printable import printable

_FIRST_SHARE = 0.2
"""Share of the work before which the remaining time is not shown."""
EVERY_S = 2.0
"""Interval of lines about a stage that goes on, where there is no bar."""


def time_left(elapsed_s: float, fraction: float, stage: str = "") -> str:
    """The remaining time, by the time so far; "" before a fifth is done, at the end, and while kernels are compiled.

    >>> time_left(10.0, 0.1), time_left(10.0, 0.25), time_left(100.0, 0.4)
    ('', 'about 30 s left', 'about 2 min 30 s left')
    """
    if not _FIRST_SHARE <= fraction < 1.0 or PREPARING in stage:
        return ""
    minutes, seconds = divmod(round(elapsed_s * (1 / fraction - 1)), 60)
    return f"about {f'{minutes} min ' if minutes else ''}{seconds} s left"


class _TimeLeft(ProgressColumn):
    """See `time_left`."""

    def render(self, task: Task) -> Text:
        """Return the remaining time as text."""
        return Text(time_left(task.elapsed or 0.0, task.completed / (task.total or 1.0), task.description))


class ProgressDisplay:
    """Shows the stage, the fraction done and a detail on stderr.

    Where there is no terminal it prints a line for each stage, and another every `every_s` while one goes on, even
    without a report: one kernel may take ten seconds to compile.
    """

    def __init__(self, stream: TextIO, *, every_s: float = EVERY_S) -> None:
        self._stream = stream
        self._every_s = every_s
        console = Console(file=stream)
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("[bold]{task.description:<20}", table_column=None),
                BarColumn(bar_width=None),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                _TimeLeft(),
                TextColumn("{task.fields[detail]:<32}"),
                console=console,
            )
            self._task = self._bar.add_task("", total=1.0, detail="")
        self._now = ("beginning", 0.0, "")
        self._began_s = self._printed_s = time.monotonic()
        self._printing = threading.Lock()
        self._ended = threading.Event()
        self._repeating = threading.Thread(target=self._repeat, name="slrig-progress", daemon=True)

    def start(self) -> None:
        """Begin to show."""
        if self._bar is not None:
            self._bar.start()
        else:
            self._repeating.start()

    def stop(self) -> None:
        """Leave what was shown, and show no more."""
        self._ended.set()
        if self._bar is not None:
            self._bar.stop()
        elif self._repeating.is_alive():
            self._repeating.join()

    def __call__(self, stage: str, fraction: float, detail: str, /) -> None:
        """Show where the work is."""
        if self._bar is not None:
            shown = detail if len(detail) <= 32 else f"{detail[:31]}…"
            self._bar.update(self._task, description=stage, completed=fraction, detail=shown)
            return
        with self._printing:
            begun = stage != self._now[0]
            self._now = (stage, fraction, detail)
            if begun:
                self._print()

    def error(self, message: str) -> None:
        """Print an error that does not end the work: it stays, above the bar where there is one."""
        safe = "\n".join(map(printable, message.rstrip().split("\n")))
        if self._bar is not None:
            # The terminal breaks lines by itself, so that paths can be copied.
            self._bar.console.print(Text.assemble(("error: ", "bold red"), safe), soft_wrap=True)
            return
        with self._printing:
            print(f"error: {safe}", file=self._stream, flush=True)
            # What comes next may begin with the stage that failed.
            self._now = ("", *self._now[1:])

    def _repeat(self) -> None:
        wait_s = self._every_s
        while not self._ended.wait(wait_s):
            with self._printing:
                wait_s = self._printed_s + self._every_s - time.monotonic()
                if wait_s <= 0:
                    self._print()
                    wait_s = self._every_s

    def _print(self) -> None:
        self._printed_s = time.monotonic()
        stage, fraction, detail = self._now
        line = f"{self._printed_s - self._began_s:6.1f} s  {fraction:4.0%}  {stage}"
        left = time_left(self._printed_s - self._began_s, fraction, stage)
        more = ", ".join(each for each in (detail, left) if each)
        print(f"{line:<40}{more}".rstrip(), file=self._stream, flush=True)


@contextmanager
def progress_shown() -> Iterator[ProgressDisplay]:
    """A progress display on stderr for the length of a block."""
    display = ProgressDisplay(sys.stderr)
    display.start()
    try:
        yield display
    finally:
        display.stop()


def plain_table(*heads: Column | str, **options: Any) -> Table:
    """A table without lines, flush with the text above it. options : of `rich.table.Table`."""
    return Table(*heads, box=None, pad_edge=False, header_style="bold", **options)


def print_table(heads: Sequence[Column | str], rows: Iterable[Sequence[Text | str]]) -> None:
    """Print rows as they are, without rich's markup; labels of older records may hold what a terminal acts on."""
    table = plain_table(*heads)
    for row in rows:
        table.add_row(*(Text(printable(cell)) if isinstance(cell, str) else cell for cell in row))
    Console().print(table)


def print_json(document: Any) -> None:
    """Print a document for `--json`."""
    # A line end here is one of the layout; JSON escapes those of the texts, but not all that a terminal acts on.
    lines = json.dumps(document, indent=2, ensure_ascii=False).split("\n")
    typer.echo("\n".join(map(printable, lines)))


def counted(count: int, what: str) -> str:
    """A number of things.

    >>> counted(0, "fault"), counted(1, "turn"), counted(3, "turn")
    ('0 faults', '1 turn', '3 turns')
    """
    return f"{count} {what}{'s' * (count != 1)}"


def answered(prompt: str, console: Console | None = None) -> str:
    """Input of a person, in lower case; "q" for the end of input and "quit". console : prints the prompt."""
    try:
        answer = (input(prompt) if console is None else console.input(prompt)).strip().lower()
    except EOFError:
        return "q"
    return "q" if answer == "quit" else answer


def quality_lines(summary: Mapping[str, Any]) -> list[str]:
    """A report's summary of the frames, the mesh and its error, one line each."""
    lines = []
    if summary.get("identity") is not None:
        lines.append(f"{'frames':<10}{summary['identity']}")
    mesh = summary.get("mesh") or {}
    figures = mesh.get("figures") or {}
    if figures.get("triangles") is not None:
        lines.append(f"{'size':<10}{figures['vertices']:,} vertices, {figures['triangles']:,} triangles")
    sigma = (mesh.get("sigma_mm") or {}).get("p50")
    if sigma is not None:
        holds = mesh.get("sigma_holds")
        shown = "" if holds is None else f"; {holds}"
        lines.append(f"{'stated':<10}standard deviation of a point {sigma:.4f} mm (median){shown}")
    truth = summary.get("truth") or {}
    if truth:
        lines.append(f"{'error':<10}{_error(truth)}")
    return lines + [f"{'note':<10}{note}" for note in summary.get("notes") or []]


def _error(truth: Mapping[str, Any]) -> str:
    """The error against the known truth: of the area near it, and the share beyond."""
    rms_mm, beyond, complete = (truth.get(name) for name in ("rms_mm", "gross_fraction", "complete_0.3mm"))
    text = "nothing within 1 mm of the known truth"
    if rms_mm is not None:
        text = f"rms {rms_mm:.4f} mm against the known truth"
        # Reports of earlier versions have the error alone.
        text += "" if beyond is None else f", of the {1 - beyond:.1%} of the area within 1 mm; {beyond:.1%} beyond 1 mm"
    return text if complete is None else f"{text}, {complete:.1%} of the visible surface within 0.3 mm"

"""What an examination finds: values in words, each with its remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding matters. Note: scans may be right all the same. Fault: they will not be."""

    OK = "ok"
    NOTE = "note"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found out.

    name : what it is, for programs, as `exposure.saturated`. subject : what it is about, as `camera 'left'`.
    found : what was measured, in words with numbers. remedy : what to do; empty if nothing has to be done.
    """

    name: str
    subject: str
    severity: Severity
    found: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if (self.severity is Severity.OK) == bool(self.remedy):
            message = f"finding {self.name}: a remedy belongs to every note and fault, and to nothing else"
            raise ValueError(message)


def ok(name: str, subject: str, found: str) -> Finding:
    """Something that is as it should be."""
    return Finding(name, subject, Severity.OK, found)


def note(name: str, subject: str, found: str, remedy: str) -> Finding:
    """Something to know, or to improve."""
    return Finding(name, subject, Severity.NOTE, found, remedy)


def fault(name: str, subject: str, found: str, remedy: str) -> Finding:
    """Something that spoils scans."""
    return Finding(name, subject, Severity.FAULT, found, remedy)


def judged(kind: Severity | None, name: str, subject: str, found: str, remedy: str) -> Finding:
    """A finding of a severity with its remedy; of None, something that is as it should be."""
    return ok(name, subject, found) if kind is None else Finding(name, subject, kind, found, remedy)


def camera_named(name: str) -> str:
    """Words for a camera.

    >>> camera_named("left")
    "camera 'left'"
    """
    return f"camera '{name}'"


def ms(seconds: float) -> str:
    """A time in milliseconds, to three digits.

    >>> ms(0.0166667), ms(0.4), ms(0.00005)
    ('16.7 ms', '400 ms', '0.05 ms')
    """
    value = seconds * 1e3
    return f"{value:.0f} ms" if abs(value) >= 100 else f"{value:.3g} ms"

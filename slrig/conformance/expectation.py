"""What is expected of a device: what was asked, what was found, and what its driver's author does about it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from slrig.devices import Trigger
from slrig.errors import SlrigError

TOLERANCE = 0.01
"""How far an exposure or a gain may be from what was asked, as a fraction."""

STEPPED = (Trigger.SOFTWARE, Trigger.FREE)
"""The triggers with which a camera can follow a projector that steps; the better one first."""


@dataclass(frozen=True, slots=True)
class Failure:
    """One broken expectation: which device, what was asked of it, what was found, and what its driver's author does."""

    asked: str
    found: str
    do: str
    where: str = ""

    def __str__(self) -> str:
        device = f"{self.where}: " if self.where else ""
        return f"{device}{self.asked}; found {self.found}; {self.do}"


class ExpectationError(Exception):
    """A device does not do what the contract asks of it. Raised by checks only, and kept in their result."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(str(failure))
        self.failure = failure


class NotApplicableError(Exception):
    """A check found out, once at work, that it has nothing to ask of these devices. The message says why."""


def expect(condition: object, *, asked: str, found: object, do: str) -> None:
    """Go on if the condition holds. Raises ExpectationError."""
    if not condition:
        raise ExpectationError(Failure(asked, str(found), do))


@contextmanager
def refused(error: type[SlrigError], *, asked: str, do: str) -> Iterator[None]:
    """Expect that the block raises `error`. Raises ExpectationError if it raises another, or none."""
    asked = f"{asked} is refused with {error.__name__}"
    try:
        yield
    except error:
        return
    except Exception as other:
        raise ExpectationError(Failure(asked, _named(other), do)) from other
    raise ExpectationError(Failure(asked, "no error", do))


@contextmanager
def works(*, asked: str, do: str) -> Iterator[None]:
    """Expect that the block raises nothing. Raises ExpectationError."""
    try:
        yield
    except Exception as error:
        raise ExpectationError(Failure(asked, _named(error), do)) from error


@contextmanager
def at(where: str) -> Iterator[None]:
    """Name the device in whatever goes wrong within the block; errors of a driver become failures of the check."""
    try:
        yield
    except ExpectationError as error:
        if error.failure.where:
            raise
        raise ExpectationError(replace(error.failure, where=where)) from error
    except NotApplicableError:
        raise
    except Exception as error:
        raise ExpectationError(replace(failure_of(error), where=where)) from error


def failure_of(error: Exception) -> Failure:
    """What an error means that came out of a device where none was due."""
    if isinstance(error, ExpectationError):
        return error.failure
    do = (
        "correct the rig as the message says, or the driver if it is wrong"
        if isinstance(error, SlrigError)
        else "a driver raises the errors of slrig.errors, and no others"
    )
    return Failure("no error comes from a call that the contract allows", _named(error), do)


def near(got: float, asked: float) -> bool:
    """Whether a setting is what was asked, within the tolerance. What a device cannot tell (NaN) is no contradiction.

    >>> near(0.01001, 0.01), near(0.02, 0.01), near(math.nan, 0.01)
    (True, False, True)
    """
    return math.isnan(got) or abs(got - asked) <= TOLERANCE * abs(asked) + 1e-12


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__

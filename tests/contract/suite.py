"""The contract of cameras and projectors as tests: a bench per driver, and the checks of `slrig.conformance` on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from slrig.conformance import Examination
from slrig.conformance.bench import usual_settings
from slrig.devices import Head, KeepsTime, Rig, SystemClock
from slrig.model import PatternSequence, Size
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import patterns_for

COLOUR = "frames_come_in_colour_where_it_is_declared"
"""The check that a mono camera has nothing to show for."""


@dataclass(frozen=True)
class Bench:
    """A driver under test. `open_head` opens the instrument afresh; `sequence` begins with white, then black; `end`
    lets go of what stands below the driver.
    """

    open_head: Callable[[], Head]
    sequence: PatternSequence
    end: Callable[[], object] = lambda: None

    @contextmanager
    def head(self) -> Iterator[Head]:
        head = self.open_head()
        try:
            yield head
        finally:
            close(head)

    def open_rig(self) -> Rig:
        return rig_of(self.open_head())

    def examination(self) -> Examination:
        return Examination(self.open_rig, self.sequence)


def sequence_for(projector: Size) -> PatternSequence:
    """White, black, Gray code of columns with inverses, shifted lines, and white and black again."""
    return encode(patterns_for(projector), projector)


def close(head: Head) -> None:
    head.projector.close()
    for camera in head.cameras.values():
        camera.close()


def rig_of(head: Head) -> Rig:
    settings = {name: usual_settings(camera) for name, camera in head.cameras.items()}
    clock = head.clock if isinstance(head, KeepsTime) else SystemClock()
    return Rig("bench", head.cameras, head.projector, settings, head.calibration, head, clock=clock)

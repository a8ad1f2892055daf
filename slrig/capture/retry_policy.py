"""Which frames count: each is held against the others, what they contradict is shot again, and three failures end it.

A contradiction seldom says which of its frames is wrong, so all its suspects are shot again. If it stays, what its test
rests on is shot again with them, unless another frame has vouched for that.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable

from slrig.bundle.refused import Refused
from slrig.capture.checks import Contradiction, place
from slrig.capture.evidence import Evidence
from slrig.errors import FrameTimeoutError, ScanEvidenceError
from slrig.model import Black, Frame, PatternSequence, Shot, White

MOST_FAILURES = 3
"""A pattern whose frame failed so often ends the scan."""

_ORDINALS = ("first", "second", "third")


class RetryPolicy:
    """Takes every frame of a capture once, and knows which patterns have to be shown again to which cameras.

    refused : is told of every exposure that does not count. since_ns : when times count from; None stands for the start
    of the first frame. colour : cameras whose white and black frames are kept in colour, too.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        evidence: Evidence,
        refused: Callable[[Refused], None],
        *,
        since_ns: int | None = None,
        colour: Collection[str] = (),
    ) -> None:
        self.evidence = evidence
        self.again: dict[int, list[str]] = {}
        self._sequence = sequence
        self._tell = refused
        self._shots: Counter[tuple[str, int]] = Counter()
        self._made: Counter[str] = Counter()
        self._causes: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._missing: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._t_first_ns = since_ns
        self._colour = colour
        self._last_cause = ""

    @property
    def most_shots(self) -> int:
        """How many exposures one camera may need at most."""
        return MOST_FAILURES * len(self._sequence)

    def begin(self, camera: str, index: int) -> None:
        """Count an exposure that is about to be made. Raises ScanEvidenceError when there were too many."""
        self._shots[camera, index] += 1
        self._made[camera] += 1
        if self._made[camera] > self.most_shots:
            raise ScanEvidenceError(
                f"camera '{camera}': {self.most_shots} exposures gave no {len(self._sequence)} frames that agree with "
                f"one another; the last cause: {self._last_cause}"
            )

    def shot(self, index: int, frame: Frame) -> Shot:
        """The frame as a shot; its time counts from the start of the first frame."""
        if self._t_first_ns is None:
            self._t_first_ns = frame.t_start_ns
        time_s = (frame.t_start_ns - self._t_first_ns) / 1e9
        wanted = frame.camera in self._colour and isinstance(self._sequence.patterns[index], White | Black)
        colour = frame.colour() if wanted and frame.colour is not None else None
        return Shot(index, frame.camera, frame.image, frame.exposure_s, time_s, colour)

    def took(self, index: int, frame: Frame, fault: str | None) -> Shot | None:
        """Judge a frame; return it if it counts. `fault` is what it says against itself.
        Raises ScanEvidenceError: it was the third failure of a pattern.
        """
        shot = self.shot(index, frame)
        # Frames that are lost now and then say nothing against those that come.
        self._missing[shot.camera, index].clear()
        if fault is not None:
            self._causes[shot.camera, index].append(fault)
            self._shoot_again(Refused(index, shot.camera, self._shots[shot.camera, index], fault, shot))
            self._end_at_third(shot.camera, [index])
            return None
        found = self.evidence.contradictions(shot)
        return shot if not found or index not in self._answer(shot, found) else None

    def missed(self, camera: str, index: int, cause: str) -> None:
        """Take note that no frame came. Raises FrameTimeoutError when none came three times running."""
        missing = self._missing[camera, index]
        missing.append(cause)
        self._shoot_again(Refused(index, camera, self._shots[camera, index], cause))
        if len(missing) >= MOST_FAILURES:
            raise FrameTimeoutError(self._failed(camera, index, missing))

    def _answer(self, shot: Shot, found: tuple[Contradiction, ...]) -> frozenset[int]:
        """Have the suspects shot again; return the patterns whose frames count no more."""
        camera = shot.camera
        accused: dict[int, str] = {}
        for each in found:
            for suspect in each.suspects:
                accused.setdefault(suspect, each.cause)
        for suspect, cause in accused.items():
            self._causes[camera, suspect].append(cause)
        beyond = {
            pattern: each.cause
            for each in found
            if any(len(self._causes[camera, suspect]) > 1 for suspect in each.suspects)
            for pattern in each.beyond
        }
        gone = self.evidence.retract(camera, {*accused, *beyond})
        for pattern in gone:
            cause = accused.get(pattern) or beyond.get(pattern) or found[0].cause
            own = pattern == shot.pattern
            attempt = self._shots[camera, pattern]
            self._shoot_again(Refused(pattern, camera, attempt, cause, shot if own else None, delivered=not own))
        self._end_at_third(camera, accused)
        return frozenset(gone)

    def refuse(self, refused: Refused) -> None:
        """Put an exposure on record as one that does not count, and tell of it."""
        self.evidence.note(refused)
        self._tell(refused)

    def _shoot_again(self, refused: Refused) -> None:
        cameras = self.again.setdefault(refused.pattern, [])
        if refused.camera not in cameras:
            cameras.append(refused.camera)
        self._last_cause = refused.cause
        self.refuse(refused)

    def _end_at_third(self, camera: str, patterns: Iterable[int]) -> None:
        for index in patterns:
            causes = self._causes[camera, index]
            if len(causes) >= MOST_FAILURES:
                raise ScanEvidenceError(self._failed(camera, index, causes))

    def _failed(self, camera: str, index: int, causes: list[str]) -> str:
        return f"{place(camera, index, self._sequence.patterns[index])}: {in_words(causes)}"


def in_words(causes: list[str]) -> str:
    """Words for several failures of one thing; those that differ in numbers only are told once.

    >>> in_words(["frame 7 is dark", "frame 9 is dark"])
    'it failed 2 times, each time alike: frame 9 is dark'
    >>> in_words(["it is dark", "it came twice"])
    'it failed 2 times. The first time: it is dark. The second time: it came twice'
    """
    if len({re.sub(r"\d+", "", cause) for cause in causes}) == 1:
        return f"it failed {len(causes)} times, each time alike: {causes[-1]}"
    listed = [f"The {_ORDINALS[number]} time: {cause}" for number, cause in enumerate(causes)]
    return f"it failed {len(causes)} times. {'. '.join(listed)}"

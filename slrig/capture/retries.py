"""Retries of frames that contradict one another while a sequence is captured."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Protocol

from slrig.bundle import RefusedFrame
from slrig.capture.frame_checks import CHECK_CABLE, Contradiction, describe_frame
from slrig.errors import FrameTimeoutError, ScanEvidenceError, of_camera
from slrig.model import Black, Frame, PatternSequence, Shot, White

MAX_FAILURES = 3
"""Number of failures of one pattern that ends the scan."""

ALIKE_EACH_TIME = (
    "it is the same each time, so not a bad cable but the rig or the scene causes it: check the order in which the "
    "projector shows the patterns, its latency and the exposure"
)

_ORDINALS = ("first", "second", "third")


class FrameChecks(Protocol):
    """Checks the frames of a capture against one another, as `slrig.capture.verifier.Evidence` does."""

    def add_shot(self, shot: Shot) -> tuple[Contradiction, ...]:
        """Add a frame; return the contradictions that it reveals."""
        ...

    def retract(self, camera: str, patterns: Collection[int]) -> tuple[int, ...]:
        """Remove frames; return the patterns removed."""
        ...

    def came_alike(self, camera: str, patterns: Iterable[int]) -> bool:
        """True if the frames of these patterns equal their rejected exposures."""
        ...

    def clear(self) -> None:
        """Remove all frames."""
        ...

    def record_refused(self, refused: RefusedFrame) -> None:
        """Record a rejected exposure."""
        ...


class RetryPolicy:
    """Decides which frames of a capture count, and which patterns to show again to which cameras.

    refused : called for each rejected exposure. since_ns : zero of `Shot.time_s`; None is the start of the first frame.
    colour : cameras whose white and black frames are also stored in colour.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        evidence: FrameChecks,
        refused: Callable[[RefusedFrame], None],
        *,
        since_ns: int | None = None,
        colour: Collection[str] = (),
    ) -> None:
        self.evidence = evidence
        self.pending: dict[int, list[str]] = {}
        self._sequence = sequence
        self._on_refused = refused
        self._attempts: Counter[tuple[str, int]] = Counter()
        self._exposures: Counter[str] = Counter()
        self._causes: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._missing: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._t_first_ns = since_ns
        self._colour = colour
        self._last_cause = ""

    @property
    def max_exposures(self) -> int:
        """Maximum number of exposures of one camera."""
        return MAX_FAILURES * len(self._sequence)

    def start_exposure(self, camera: str, index: int) -> None:
        """Count an exposure before it is made. Raises ScanEvidenceError: there were too many."""
        self._attempts[camera, index] += 1
        self._exposures[camera] += 1
        if self._exposures[camera] > self.max_exposures:
            message = (
                f"camera '{camera}': {self.max_exposures} exposures gave no {len(self._sequence)} frames that agree "
                f"with one another; the last cause: {self._last_cause}"
            )
            with of_camera(camera):
                raise ScanEvidenceError(message)

    def holds(self, camera: str, index: int) -> bool:
        """True if a pattern that is shown again stays until its frame was checked. Where one was lost for the first
        time, it is shown no longer than any other.
        """
        return len(self._missing[camera, index]) != 1

    def make_shot(self, index: int, frame: Frame) -> Shot:
        """Return a frame as a shot, with its time since the start of the first frame."""
        if self._t_first_ns is None:
            self._t_first_ns = frame.t_start_ns
        time_s = (frame.t_start_ns - self._t_first_ns) / 1e9
        wanted = frame.camera in self._colour and isinstance(self._sequence.patterns[index], White | Black)
        with of_camera(frame.camera):
            colour = frame.colour() if wanted and frame.colour is not None else None
        return Shot(index, frame.camera, frame.image, frame.exposure_s, time_s, colour)

    def submit(self, index: int, frame: Frame, fault: str | None) -> Shot | None:
        """Check a frame; return it as a shot if it counts. fault : reason to reject the frame that is already known.
        Raises ScanEvidenceError: the pattern failed for the third time.
        """
        shot = self.make_shot(index, frame)
        # Only consecutive losses count.
        self._missing[shot.camera, index].clear()
        if fault is not None:
            self._causes[shot.camera, index].append(fault)
            self._request_again(RefusedFrame(index, shot.camera, self._attempts[shot.camera, index], fault, shot))
            self._raise_after_max_failures(shot.camera, [index])
            return None
        found = tuple(each for each in self.evidence.add_shot(shot) if not self._is_constant(each))
        return shot if not found or index not in self._resolve(shot, found) else None

    def _is_constant(self, found: Contradiction) -> bool:
        """True if frames differ in light for the third time, came alike, and none of them is proven wrong: then the rig
        or the scene is so. They count, and the summary has the contradiction.
        """
        failures = [len(self._causes[found.camera, each]) for each in found.suspects]
        is_last = max(failures, default=0) >= MAX_FAILURES - 1
        return found.is_doubt and is_last and self.evidence.came_alike(found.camera, found.suspects)

    def report_missing(self, camera: str, index: int, cause: str) -> None:
        """Record that no frame came. Raises FrameTimeoutError: none came three times in a row."""
        missing = self._missing[camera, index]
        missing.append(cause)
        self._request_again(RefusedFrame(index, camera, self._attempts[camera, index], cause))
        if len(missing) >= MAX_FAILURES:
            with of_camera(camera):
                raise FrameTimeoutError(self._failure_message(camera, index, missing))

    def _resolve(self, shot: Shot, found: tuple[Contradiction, ...]) -> frozenset[int]:
        """Request the suspects again; return the patterns whose frames no longer count."""
        camera = shot.camera
        suspects: dict[int, str] = {}
        for each in found:
            for suspect in each.suspects:
                suspects.setdefault(suspect, each.cause)
        for suspect, cause in suspects.items():
            self._causes[camera, suspect].append(cause)
        further_suspects = {
            pattern: each.cause
            for each in found
            if any(len(self._causes[camera, suspect]) > 1 for suspect in each.suspects)
            for pattern in each.further_suspects
        }
        removed = self.evidence.retract(camera, {*suspects, *further_suspects})
        for pattern in removed:
            cause = suspects.get(pattern) or further_suspects.get(pattern) or found[0].cause
            is_current = pattern == shot.pattern
            attempt = self._attempts[camera, pattern]
            self._request_again(
                RefusedFrame(pattern, camera, attempt, cause, shot if is_current else None, delivered=not is_current)
            )
        self._raise_after_max_failures(camera, suspects)
        return frozenset(removed)

    def refuse(self, refused: RefusedFrame) -> None:
        """Record a rejected exposure and report it."""
        self.evidence.record_refused(refused)
        self._on_refused(refused)

    def _request_again(self, refused: RefusedFrame) -> None:
        cameras = self.pending.setdefault(refused.pattern, [])
        if refused.camera not in cameras:
            cameras.append(refused.camera)
        self._last_cause = refused.cause
        self.refuse(refused)

    def _raise_after_max_failures(self, camera: str, patterns: Iterable[int]) -> None:
        for index in patterns:
            causes = self._causes[camera, index]
            if len(causes) >= MAX_FAILURES:
                with of_camera(camera):
                    raise ScanEvidenceError(self._failure_message(camera, index, causes))

    def _failure_message(self, camera: str, index: int, causes: list[str]) -> str:
        return f"{describe_frame(camera, index, self._sequence.patterns[index])}: {describe_causes(causes)}"


def describe_causes(causes: list[str]) -> str:
    """Describe several failures of one thing; causes that differ only in numbers are given once.

    >>> describe_causes(["frame 7 is dark", "frame 9 is dark"])
    'it failed 2 times, each time alike: frame 9 is dark'
    >>> describe_causes(["it is dark", "it came twice"])
    'it failed 2 times. The first time: it is dark. The second time: it came twice'
    """
    if len({re.sub(r"\d+", "", cause) for cause in causes}) == 1:
        last = causes[-1]
        if have_same_cause(causes):
            # Chance, as in a cable or a connector, differs each time.
            last = last.replace(CHECK_CABLE, ALIKE_EACH_TIME)
        return f"it failed {len(causes)} times, each time alike: {last}"
    listed = [f"The {_ORDINALS[number]} time: {cause}" for number, cause in enumerate(causes)]
    return f"it failed {len(causes)} times. {'. '.join(listed)}"


def have_same_cause(causes: Sequence[str]) -> bool:
    """True if descriptions of one fault agree, also in their numbers, as nearly as noise allows.

    >>> have_same_cause(["15% of the lit pixels", "16% of the lit pixels"])
    True
    >>> have_same_cause(["15% of the lit pixels", "35% of the lit pixels"])
    False
    """
    if len({re.sub(r"\d+", "", cause) for cause in causes}) != 1:
        return False
    columns = zip(*([int(number) for number in re.findall(r"\d+", cause)] for cause in causes), strict=True)
    return all(max(each) - min(each) <= 2 + 0.1 * max(each) for each in columns)

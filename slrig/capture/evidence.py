"""Evidence that each frame shows the pattern it claims, gathered frame by frame from a sample of pixels.

The tests need no model of the scene. White against black tells what is lit; light is additive, so a bit and its inverse
add up to white and black; line frames must be bright where the Gray code puts their lines; a frame that equals an
earlier frame of another pattern was not exposed for its own; the closing frames must equal the opening ones.
A pattern that is constant over the visible part of the projector is no contradiction.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from slrig.bundle.refused import Refused
from slrig.capture.checks import Contradiction, place
from slrig.capture.frame_verifier import FrameVerifier
from slrig.model import Black, CameraFormat, Capture, Pattern, Shot, White


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """What the frames of one sequence have proven.

    patterns : how many were seen. verified : how many of them passed, in every camera, a test that another pattern
    would fail. lit, light_drift, noise_dn : per camera, share of the image that the projector lights, largest change
    of the light as a share of white, noise of a frame in DN; missing where nothing tells. faults : contradictions that
    stand. shot_again : how many exposures were refused and made again; causes : why, each once. left_out : why
    whole exposures of a bracket were left out, each once.
    """

    patterns: int
    verified: int
    lit: Mapping[str, float]
    light_drift: Mapping[str, float]
    noise_dn: Mapping[str, float]
    faults: tuple[str, ...]
    shot_again: int = 0
    causes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def __str__(self) -> str:
        again = f", {self.shot_again} frame{'s' * (self.shot_again != 1)} shot again" if self.shot_again else ""
        return f"{self.verified}/{self.patterns} patterns verified{again}"

    def with_refused(self, refused: Sequence[Refused], patterns: Sequence[Pattern]) -> EvidenceSummary:
        """The summary with what refused exposures come to."""
        shot = [each for each in refused if not each.left_out]
        return replace(
            self,
            shot_again=len(shot),
            causes=tuple(dict.fromkeys(f"{place(r.camera, r.pattern, patterns[r.pattern])}: {r.cause}" for r in shot)),
            left_out=tuple(dict.fromkeys(each.cause for each in refused if each.left_out)),
        )


class Evidence:
    """The evidence of one sequence: feed it every frame, in any order; white and black first is cheapest.

    patterns : the whole sequence. cameras : every camera by name. refused : what is on record as refused already.
    """

    def __init__(
        self, patterns: Sequence[Pattern], cameras: Mapping[str, CameraFormat], refused: Sequence[Refused] = ()
    ) -> None:
        self._patterns = tuple(patterns)
        self._cameras = dict(cameras)
        self._refused = [replace(each, shot=None) for each in refused if each.pattern < len(self._patterns)]
        self._verifiers: dict[str, FrameVerifier] = {}
        self.forget()

    def contradictions(self, shot: Shot) -> tuple[Contradiction, ...]:
        """Take a frame in; return the contradictions that it brings to light."""
        return tuple(self._verifiers[shot.camera].judge(shot))

    def retract(self, camera: str, patterns: Collection[int]) -> tuple[int, ...]:
        """Forget frames and what was concluded from them, as if they had never come; those left are judged again.

        Returns the patterns whose frames are forgotten: these, and all of that camera if one tells what is lit. What
        the others now contradict is returned with the next frame.
        """
        return self._verifiers[camera].retract(patterns)

    def forget(self) -> None:
        """Forget every frame. What was refused stays on record."""
        self._verifiers = {name: FrameVerifier(name, form, self._patterns) for name, form in self._cameras.items()}

    def note(self, refused: Refused) -> None:
        """Put on record that an exposure was refused."""
        self._refused.append(replace(refused, shot=None))

    def summary(self) -> EvidenceSummary:
        """Sum up what was found so far."""
        verifiers = self._verifiers.values()
        seen = {index for each in verifiers for index in each.seen}
        unproven = {index for each in verifiers for index in each.seen - each.found.verified}
        found = {each.name: each.found for each in verifiers}
        summary = EvidenceSummary(
            patterns=len(seen),
            verified=len(seen - unproven),
            lit={each.name: each.lighting.lit for each in verifiers if each.lighting is not None},
            light_drift={name: each.light_drift for name, each in found.items() if each.light_drift is not None},
            noise_dn={name: each.noise_dn for name, each in found.items() if each.noise_dn is not None},
            faults=tuple(str(told) for each in verifiers for told in each.told),
        )
        return summary.with_refused(self._refused, self._patterns)


def check_capture(capture: Capture, refused: Sequence[Refused] = ()) -> EvidenceSummary:
    """Judge a recorded capture. Contradictions are listed in the summary, not raised: somebody kept these frames.

    Of a pattern that was exposed for different times, the exposure that most patterns share is judged. `refused` is
    what was shot again while it was captured.
    """
    evidence = Evidence(capture.patterns, capture.cameras, refused)
    for index in judged_frames(capture):
        evidence.contradictions(capture.shots[index])
    return evidence.summary()


def judged_frames(capture: Capture) -> list[int]:
    """Of the frames of a capture those that `check_capture` judges, by their indices, in the order in which it does."""
    chosen: list[int] = []
    for camera in capture.cameras:
        indices = [index for index, shot in enumerate(capture.shots) if shot.camera == camera]
        exposures = [capture.shots[index].exposure_s for index in indices]
        most = max(exposures, key=exposures.count, default=None)
        by_pattern: dict[int, int] = {}
        for index, exposure_s in zip(indices, exposures, strict=True):
            if exposure_s == most:
                by_pattern.setdefault(capture.shots[index].pattern, index)
        # One white and one black first: every other test refers to them.
        opening = [next((i for i in by_pattern if capture.patterns[i] == p), -1) for p in (White(), Black())]
        chosen += [by_pattern[i] for i in opening if i in by_pattern]
        chosen += [index for i, index in by_pattern.items() if i not in opening]
    return chosen

"""How often a driver lets a frame pass that does not show the pattern it was paired with: for every driver, counted."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.bundle.sidecars import RefusedFrame
from slrig.capture.frame_checks import Contradiction
from slrig.capture.sequencer import capture
from slrig.capture.verifier import Evidence
from slrig.devices import DisplayedPattern, Projector, ProjectorInfo, Rig, ScannerHead
from slrig.errors import FrameTimeoutError, ScanEvidenceError
from slrig.model import Pattern, PatternSequence, Pixels, Shot
from tests.contract.suite import rig_of

_BANDS = 12
_DAMAGED = 0.15
"""A band that is off by this share of the scene's contrast, root mean square, is not what was shown."""

Expected = Callable[[str, int], Pixels]
"""What a camera sees of a pattern of the sequence: (H, W), in its own units, with little noise or none."""

FRAMES = int(os.environ.get("SLRIG_PAIRING_FRAMES", "300"))
"""How many frames a slow test of pairing counts. 300 find a fault of one frame in a hundred with 95 %; campaigns, run
when a driver or the evidence changes, ask for 2000 or more."""


@dataclass(frozen=True, slots=True)
class PairingResult:
    """frames : accepted, in scans that were complete; wrong : of these, how many show another pattern or are damaged.

    shot_again : exposures that were refused and made again. refused_scans : of `scans`, how many ended for want of
    frames that agree. examples : words for the first wrong ones.
    """

    frames: int
    wrong: int
    shot_again: int
    refused_scans: int
    scans: int
    examples: tuple[str, ...]


@dataclass
class Gaps:
    """Idle time of random length, on the rig's own clock: often none, often short, now and then long."""

    rig: Rig
    rng: np.random.Generator
    longest_s: float
    _never: threading.Event = field(default_factory=threading.Event)

    def idle(self) -> None:
        length_s = float(self.rng.choice([0.0, 0.1, 1.0], p=[0.6, 0.3, 0.1]) * self.rng.random()) * self.longest_s
        if length_s > 0:
            self.rig.clock.wait_until(self.rig.clock.now_ns() + round(length_s * 1e9), self._never)


class IdlingProjector:
    """A projector before which a program dawdles, now and then, before it shows the next pattern."""

    def __init__(self, projector: Projector, gaps: Gaps) -> None:
        self._projector, self._gaps = projector, gaps
        self.load, self.play, self.stop = projector.load, projector.play, projector.stop
        self.blank, self.close = projector.blank, projector.close

    @property
    def info(self) -> ProjectorInfo:
        return self._projector.info

    def show(self, index: int) -> DisplayedPattern:
        self._gaps.idle()
        return self._projector.show(index)


class Unproven(Evidence):
    """Believes every frame: what is left is what the driver itself keeps away."""

    def add_shot(self, shot: Shot) -> tuple[Contradiction, ...]:
        del shot
        return ()


def wrong_pairings(
    open_rig: Callable[[], Rig | ScannerHead],
    sequence: PatternSequence,
    expected: Expected,
    *,
    frames: int,
    seed: int,
    longest_idle_s: float = 0.5,
    timeout_s: float = 2.0,
    most_scans: int = 1000,
    proven: bool = True,
) -> PairingResult:
    """Scan until `frames` frames were accepted in complete scans, and count those that should not have been.

    open_rig : opens the instrument once, for all scans. sequence : white and black at both ends, as a scan has them.
    expected : the truth to compare with. longest_idle_s : of a gap between two patterns, two frames or two scans.
    timeout_s : as `capture` has it. proven : whether frames are held against one another, as a scan does; else the
    driver has nothing but time stamps and marks of damage, and what it lets pass is its own doing.
    """
    opened = open_rig()
    rig = opened if isinstance(opened, Rig) else rig_of(opened)
    gaps = Gaps(rig, np.random.default_rng(seed), longest_idle_s)
    truths = {name: Truths.of(name, sequence, expected) for name in rig.cameras}
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    idling = replace(rig, projector=IdlingProjector(rig.projector, gaps))
    accepted = wrong = again = refused_scans = scans = 0
    examples: list[str] = []
    with rig:
        while accepted < frames and scans < most_scans:
            scans += 1
            gaps.idle()
            evidence = (Evidence if proven else Unproven)(sequence.patterns, formats)
            latest: dict[tuple[str, int], Shot] = {}

            def take_back(refused: RefusedFrame, latest: dict[tuple[str, int], Shot] = latest) -> None:
                if refused.delivered:
                    del latest[refused.camera, refused.pattern]

            try:
                for shot in capture(idling, sequence, timeout_s=timeout_s, evidence=evidence, refused=take_back):
                    latest[shot.camera, shot.pattern] = shot
                    gaps.idle()
            except (ScanEvidenceError, FrameTimeoutError):
                refused_scans += 1
                latest = {}
            again += evidence.summary().shot_again
            accepted += len(latest)
            found = [words for shot in latest.values() if (words := truths[shot.camera].wrong(shot)) is not None]
            wrong += len(found)
            examples += found[: 10 - len(examples)]
    return PairingResult(accepted, wrong, again, refused_scans, scans, tuple(examples))


@dataclass(frozen=True)
class Truths:
    """What one camera should see of each pattern: images (N, H, W) float32; contrast, the scene's, in its units."""

    camera: str
    patterns: tuple[Pattern, ...]
    images: NDArray[np.float32]
    contrast: float

    @classmethod
    def of(cls, camera: str, sequence: PatternSequence, expected: Expected) -> Truths:
        images = np.stack([expected(camera, index) for index in range(len(sequence))]).astype(np.float32)
        contrast = float(np.percentile(images.max(axis=0) - images.min(axis=0), 95))
        return cls(camera, sequence.patterns, images, contrast)

    def wrong(self, shot: Shot) -> str | None:
        """Words for a frame that is nearer to another pattern than to its own, or is damaged; None for a sound one."""
        rest = self.images - shot.image.astype(np.float32)
        distance = np.mean(rest**2, axis=(1, 2))
        own = shot.pattern
        nearest = int(np.argmin(distance))
        if self.patterns[nearest] == self.patterns[own]:
            nearest = own
        # Patterns may look alike where the camera looks: nearer by as much as their difference is nearer in truth.
        apart = float(np.mean((self.images[nearest] - self.images[own]) ** 2))
        if distance[own] - distance[nearest] > 0.1 * apart > 0:
            return f"camera '{self.camera}': the frame paired with pattern {own} shows pattern {nearest}"
        bands = [float(np.sqrt(np.mean(band**2))) for band in np.array_split(rest[own], _BANDS)]
        if max(bands) > _DAMAGED * self.contrast:
            return f"camera '{self.camera}': the frame paired with pattern {own} is damaged"
        return None


def seen_by(open_rig: Callable[[], Rig | ScannerHead], sequence: PatternSequence) -> Expected:
    """What an undisturbed instrument of the same kind sees: the truth for those that make their own pictures."""
    opened = open_rig()
    rig = opened if isinstance(opened, Rig) else rig_of(opened)
    with rig:
        images: Mapping[tuple[str, int], NDArray[Any]] = {
            (shot.camera, shot.pattern): shot.image for shot in capture(rig, sequence)
        }
    return lambda camera, index: images[camera, index]

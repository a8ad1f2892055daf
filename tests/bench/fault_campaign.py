"""Frames that are stale, exchanged, torn or damaged, in scans of scenes whose light is worse in one way each: how many
pass.

`python -m tests.bench.fault_campaign --sequence fast --faults 2000` prints a row for each kind of fault; the names of
`sinusoids` play those. A fault counts as passed if nothing contradicts it and the frame is nearer to another pattern or
damaged by the measure of the drivers' contract; frames of sound scans that something contradicts are false alarms.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import structlog

from slrig.capture.verifier import check_capture
from slrig.model import (
    Axis,
    Black,
    Capture,
    Gray,
    Pattern,
    PatternSequence,
    Pixels,
    SequenceName,
    Shot,
    Sine,
    Size,
    White,
)
from slrig.patterns import encode, gray_bits
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.bench.line_sweep import scenes
from tests.contract.pairing import Truths
from tests.golden.lit_scenes import LitScene

Fault = Callable[[LitScene, PatternSequence, list[Shot], np.random.Generator], tuple[str, list[int]]]
"""Changes some shots; returns what it did, in words, and to which."""

_DAMAGES = ("noise", "dark", "bright", "shifted", "inverted", "of another frame")


def _with_image(shots: list[Shot], index: int, image: Pixels) -> None:
    shots[index] = replace(shots[index], image=image)


def stale(
    scene: LitScene, sequence: PatternSequence, shots: list[Shot], rng: np.random.Generator
) -> tuple[str, list[int]]:
    """A frame shows the pattern that was played one to three before its own."""
    index = int(rng.integers(1, len(shots)))
    before = max(index - int(rng.integers(1, 4)), 0)
    _with_image(shots, index, scene.frame(sequence.patterns[before], rng))
    return f"shows {sequence.patterns[before]}", [index]


def exchanged(_: LitScene, __: PatternSequence, shots: list[Shot], rng: np.random.Generator) -> tuple[str, list[int]]:
    """Two frames stand in each other's place: neighbours, or any."""
    one = int(rng.integers(0, len(shots) - 1))
    other = one + 1 if rng.random() < 0.5 else int(rng.integers(0, len(shots)))
    first, second = shots[one].image, shots[other].image
    _with_image(shots, one, second)
    _with_image(shots, other, first)
    return "", [one, other]


def damaged(_: LitScene, __: PatternSequence, shots: list[Shot], rng: np.random.Generator) -> tuple[str, list[int]]:
    """A tenth to a half of a frame's rows are noise, dark, bright, shifted sideways, inverted, or of another frame."""
    index = int(rng.integers(0, len(shots)))
    image = shots[index].image.copy()
    rows = len(image)
    count = int(rng.uniform(0.1, 0.5) * rows)
    first = int(rng.integers(0, rows - count))
    band, top = slice(first, first + count), int(np.iinfo(image.dtype).max)
    kind = int(rng.integers(0, 6))
    if kind == 0:
        image[band] = rng.integers(0, top + 1, image[band].shape, image.dtype)
    elif kind == 1:
        image[band] = 0
    elif kind == 2:
        image[band] = top
    elif kind == 3:
        image[band] = np.roll(image[band], int(rng.integers(5, 40)), axis=1)
    elif kind == 4:
        image[band] = top - image[band]
    else:
        image[band] = shots[int(rng.integers(0, len(shots)))].image[band]
    _with_image(shots, index, image)
    return f"{count} of {rows} rows {_DAMAGES[kind]}", [index]


def torn(_: LitScene, __: PatternSequence, shots: list[Shot], rng: np.random.Generator) -> tuple[str, list[int]]:
    """The upper rows of a frame show the frame before, or the lower ones the next."""
    index, is_next = int(rng.integers(1, len(shots) - 1)), bool(rng.integers(0, 2))
    image, rows = shots[index].image, len(shots[index].image)
    first = int(rng.uniform(0.15, 0.85) * rows)
    above, below = (image, shots[index + 1].image) if is_next else (shots[index - 1].image, image)
    _with_image(shots, index, np.concatenate([above[:first], below[first:]]))
    return f"from row {first} on", [index]


def one_off(_: LitScene, __: PatternSequence, shots: list[Shot], rng: np.random.Generator) -> tuple[str, list[int]]:
    """A frame is missing, or is there twice, so that all later ones are one off."""
    index = int(rng.integers(1, len(shots) - 1))
    before = [shot.image for shot in shots]
    is_missing = bool(rng.integers(0, 2))
    after = (
        [*before[:index], *before[index + 1 :], before[-1]]
        if is_missing
        else [*before[:index], *before[index - 1 : -1]]
    )
    for place, image in enumerate(after):
        _with_image(shots, place, image)
    return f"{'missing' if is_missing else 'twice'} at {index}", list(range(index, len(shots)))


FAULTS: dict[str, Fault] = {
    "stale": stale, "exchanged": exchanged, "damaged": damaged, "torn": torn, "one off": one_off,
}  # fmt: skip


def sinusoids(size: Size) -> dict[str, tuple[Pattern, ...]]:
    """Sequences of sinusoids, by name."""
    width_px = float(size.width_px)

    def shifted(period_px: float, steps: int) -> list[Pattern]:
        return [Sine(Axis.COLUMN, period_px, shift, steps) for shift in range(steps)]

    bits = gray_bits(size.width_px, 8, 0)
    ends: list[Pattern] = [White(), Black()]
    singles = [Sine(Axis.COLUMN, period_px, 0, 1) for period_px in (23.5, 25.0, 26.0, 28.0, 21.0, 31.0)]
    return {
        "3 x 4": (*ends, *shifted(width_px, 4), *shifted(width_px / 8, 4), *shifted(16.0, 4)),
        "2x3": (*ends, *shifted(width_px, 3), *shifted(width_px / 20, 3)),
        "code and 4": (*ends, *(Gray(Axis.COLUMN, bit, bits, 8) for bit in range(bits)), *shifted(16.0, 4)),
        "micro": (*ends, *shifted(24.0, 3), *singles),
        "without white": (*shifted(width_px, 4), *shifted(width_px / 8, 4), *shifted(16.0, 4)),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sequence", default="standard", choices=[*SequenceName, *sinusoids(Size(64, 64))])
    parser.add_argument("--faults", type=int, default=2000)
    parser.add_argument("--sound", type=int, default=500)
    parser.add_argument("--only")
    asked = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    stands = {name: scene for name, scene in scenes().items() if asked.only in (None, name)}
    rng = np.random.default_rng(41)
    totals: Counter[str] = Counter()
    for name, scene in stands.items():
        named = sinusoids(scene.projector).get(asked.sequence)
        sequence = (
            pattern_sequence(PatternPlan(sequence=SequenceName(asked.sequence)), scene.projector)
            if named is None
            else encode(named, scene.projector)
        )
        totals.update(
            _campaign(name, scene, sequence, asked.faults // len(stands) + 1, asked.sound // len(stands) + 1, rng)
        )
    sys.stdout.write(f"all of {asked.sequence}: {dict(totals)}\n")


def _campaign(
    name: str, scene: LitScene, sequence: PatternSequence, faults: int, sound: int, rng: np.random.Generator
) -> Counter[str]:
    found: Counter[str] = Counter()
    usual = [scene.capture(sequence.patterns, seed=1000 + seed) for seed in range(4)]
    for seed in range(sound):
        summary = check_capture(scene.capture(sequence.patterns, seed=seed))
        found["sound frames"] += len(sequence)
        found["false alarms"] += len(summary.faults)
        found["sound frames proven"] += summary.verified
        if summary.faults:
            sys.stdout.write(f"{name}: sound, but {summary.faults[0]}\n")
    images = np.stack([scene.expected_dn(pattern) for pattern in sequence.patterns])
    contrast = float(np.percentile(images.max(axis=0) - images.min(axis=0), 95))
    truths = Truths(scene.eye.name, sequence.patterns, images, contrast)
    for kind, fault in FAULTS.items():
        for number in range(faults):
            capture = usual[number % len(usual)]
            shots = list(capture.shots)
            words, touched = fault(scene, sequence, shots, rng)
            found[kind] += 1
            judged = check_capture(Capture(capture.projector, capture.patterns, capture.cameras, tuple(shots)))
            if judged.faults:
                continue
            if any(truths.wrong(shots[index]) for index in touched):
                # A frame that nothing proves is reported as such.
                how = "passed" if judged.verified == len(sequence) else "passed, not all proven"
                found[f"{kind} {how}"] += 1
                patterns = [sequence.patterns[index] for index in touched]
                sys.stdout.write(f"{name}: {kind} {how}, {words}, of {patterns}\n")
            else:
                found[f"{kind} that make no difference"] += 1
    sys.stdout.write(f"{name}: {dict(found)}\n")
    sys.stdout.flush()
    return found


if __name__ == "__main__":
    main()

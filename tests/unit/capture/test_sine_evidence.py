"""Frames of sinusoids are proven to show their patterns; wrong ones are named, right ones of any scene pass."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import pytest

from slrig.bundle import RefusedFrame
from slrig.capture.sequencer import capture
from slrig.capture.verifier import Evidence, EvidenceSummary, check_capture
from slrig.model import Axis, Black, Capture, Gray, Pattern, Pixels, Shot, Sine, Size, White
from slrig.patterns import encode
from tests.unit.capture.fake_rig import CameraFaults, Scene, fake_rig

PROJECTOR, CAMERA = Size(256, 192), Size(320, 240)
REFERENCES: tuple[Pattern, ...] = (White(), Black())


def shifted(period_px: float, steps: int) -> tuple[Pattern, ...]:
    return tuple(Sine(Axis.COLUMN, period_px, shift, steps) for shift in range(steps))


SEQUENCES: dict[str, tuple[Pattern, ...]] = {
    "three periods of four": (*REFERENCES, *shifted(256, 4), *shifted(64, 4), *shifted(16, 4)),
    "2x3": (*REFERENCES, *shifted(256, 3), *shifted(16, 3)),
    "a code and four": (*REFERENCES, *(Gray(Axis.COLUMN, bit, 5, 8) for bit in range(5)), *shifted(16, 4)),
    "micro": (
        *REFERENCES,
        *shifted(18, 3),
        *(Sine(Axis.COLUMN, period_px, 0, 1) for period_px in (17, 19.5, 16, 20.5, 22, 24)),
    ),
    "without white and black": (*shifted(256, 4), *shifted(64, 4), *shifted(16, 4)),
}
SCENES = {
    "noisy": {"noise_dn": 4.0},
    "dark": {"white": 0.08, "ambient": 0.0, "noise_dn": 1.0},
    "strong ambient light": {"white": 0.3, "ambient": 0.4, "noise_dn": 1.5},
    "defocused": {"blur_px": 3.0, "noise_dn": 1.0},
    "camera with gamma 2.2": {"gamma": 2.2, "noise_dn": 1.0},
    "projector with gamma 2.2": {"scaler_px": 0.7, "noise_dn": 1.0},
    "saturated in places": {"white": 1.3, "noise_dn": 1.5},
    "12 bit": {"bit_depth": 12, "noise_dn": 6.0},
}


def few(*names: Any, of: Iterable[Any]) -> list[Any]:
    """These, and the others in the long run."""
    return [*names, *(pytest.param(each, marks=pytest.mark.slow) for each in of if each not in names)]


def scene(name: str = "noisy") -> Scene:
    return Scene(projector=PROJECTOR, camera=CAMERA, **SCENES[name])  # type: ignore[arg-type]


def images(patterns: Sequence[Pattern], stage: Scene | None = None) -> list[Pixels]:
    return [shot.image for shot in (stage or scene()).shots(patterns)]


def summary(patterns: Sequence[Pattern], frames: Sequence[Pixels], stage: Scene | None = None) -> EvidenceSummary:
    shots = tuple(Shot(index, "left", image) for index, image in enumerate(frames))
    return check_capture(Capture(PROJECTOR, tuple(patterns), {"left": (stage or scene()).format}, shots))


@pytest.mark.parametrize("name", few("noisy", of=SCENES))
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_right_frames_are_verified(sequence: str, name: str) -> None:
    patterns, stage = SEQUENCES[sequence], scene(name)
    found = summary(patterns, images(patterns, stage), stage)
    assert found.faults == ()
    # Noise as large as a fine period hides which it is.
    assert found.verified == (len(REFERENCES) if (sequence, name) == ("2x3", "dark") else len(patterns))


def torn(frames: list[Pixels], index: int) -> list[int]:
    frames[index] = np.concatenate([frames[index - 1][:100], frames[index][100:]])
    return [index]


def stale(frames: list[Pixels], index: int) -> list[int]:
    frames[index] = frames[index - 1]
    return [index]


def early(frames: list[Pixels], index: int) -> list[int]:
    frames[index - 1] = frames[index]
    return [index - 1]


def garbled(frames: list[Pixels], index: int) -> list[int]:
    frames[index] = frames[index].copy()
    frames[index][60:100] = np.random.default_rng(2).integers(0, 256, frames[index][60:100].shape)
    return [index]


def dark_rows(frames: list[Pixels], index: int) -> list[int]:
    frames[index] = frames[index].copy()
    frames[index][60:100] = 0
    return [index]


def exchanged(frames: list[Pixels], index: int) -> list[int]:
    frames[index - 3], frames[index] = frames[index], frames[index - 3]
    return [index - 3, index]


@pytest.mark.parametrize("spoil", few(stale, of=(torn, early, garbled, dark_rows, exchanged)))
@pytest.mark.parametrize("sequence", few("2x3", "a code and four", of=SEQUENCES))
def test_a_wrong_frame_is_named_once_and_no_other(
    sequence: str, spoil: Callable[[list[Pixels], int], list[int]]
) -> None:
    patterns = SEQUENCES[sequence]
    frames = images(patterns)
    wrong = spoil(frames, len(patterns) - 2)
    found = summary(patterns, frames)
    assert len(found.faults) == 1
    assert found.wrong == {"left": frozenset(wrong)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: [*f[:6], *f[7:], f[-1]], "a frame is missing at pattern 6 "),
        (lambda f: [*f[:5], f[4], *f[5:-1]], "pattern [45] .* is one too many"),
        (lambda f: [f[-1], *f[:-1]], "all frames are one frame behind their patterns"),
    ],
)
def test_a_sequence_in_another_order_is_named(change: Callable[[list[Pixels]], list[Pixels]], words: str) -> None:
    patterns = SEQUENCES["three periods of four"]
    found = summary(patterns, change(images(patterns)))
    assert found.misordered is not None
    assert found.faults == (f"camera 'left': {found.misordered}",)
    assert re.search(words, found.misordered)


def test_a_period_that_runs_backwards_contradicts_the_other() -> None:
    """With two of three shifts exchanged, every pixel has a position, but adjacent pixels are far apart."""
    patterns = SEQUENCES["2x3"]
    frames = images(patterns)
    frames[6], frames[7] = frames[7], frames[6]
    (fault,) = summary(patterns, frames).faults
    assert re.search(r"run opposite|exchanged", fault)


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), [pytest.param(2, 3, marks=pytest.mark.slow), (2, 4)])
def test_exchanged_frames_that_fit_other_positions_are_found_by_their_jumps(one: int, other: int) -> None:
    patterns = SEQUENCES["micro"]
    frames = images(patterns)
    frames[one], frames[other] = frames[other], frames[one]
    assert summary(patterns, frames).wrong == {"left": frozenset({one, other})}


def test_a_wrong_frame_is_found_as_soon_as_its_period_is_complete() -> None:
    patterns = SEQUENCES["three periods of four"]
    frames = images(patterns)
    torn(frames, 4)
    evidence = Evidence(patterns, {"left": scene().format}, projector=PROJECTOR)
    shots = [Shot(index, "left", image) for index, image in enumerate(frames)]
    found = [[each.suspects for each in evidence.add_shot(shot)] for shot in shots[:6]]
    assert found == [[], [], [], [], [], [(4,)]]
    evidence.retract("left", (4,))
    shots[4] = Shot(4, "left", images(patterns)[4])
    assert [evidence.add_shot(shot) for shot in (shots[4], *shots[6:])] == [()] * 9
    assert evidence.summary().faults == ()
    assert evidence.summary().verified == len(patterns)


def test_stale_and_garbled_frames_are_shot_again() -> None:
    patterns = (*REFERENCES, *shifted(128, 4), *shifted(16, 4))
    fake = fake_rig(faults={"left": CameraFaults(garbled=frozenset({4}), stale=frozenset({8}))}, cameras=["left"])
    sequence = encode(patterns, fake.projector.size)
    evidence = Evidence(patterns, {"left": fake.cameras["left"].info.format}, projector=fake.projector.size)
    refused: list[RefusedFrame] = []
    kept = {shot.pattern: shot for shot in capture(fake.rig, sequence, evidence=evidence, refused=refused.append)}
    assert kept.keys() == set(range(len(patterns)))
    assert {each.pattern for each in refused} >= {4, 7}
    assert evidence.summary().faults == ()
    assert evidence.summary().verified == len(patterns)


@pytest.mark.parametrize("factor", [1.25, pytest.param(0.7, marks=pytest.mark.slow)])
@pytest.mark.parametrize("sequence", few("2x3", of=("three periods of four", "micro")))
def test_a_change_of_light_is_measured_and_no_fault(sequence: str, factor: float) -> None:
    patterns, stage = SEQUENCES[sequence], scene("strong ambient light")
    frames = images(patterns, stage)
    changed = len(patterns) - 2
    frames[changed] = np.clip(np.rint(factor * frames[changed].astype(float)), 0, 255).astype(np.uint8)
    found = summary(patterns, frames, stage)
    assert found.faults == ()
    assert found.frame_light["left"][changed].factor == pytest.approx(factor, abs=0.05)
    light = found.light["left"]["column sinusoids"]
    assert (light.least, light.most) == pytest.approx((min(factor, 1), max(factor, 1)), abs=0.05)


def test_sinusoids_of_one_period_are_not_verified() -> None:
    patterns = (*REFERENCES, *shifted(16, 4))
    found = summary(patterns, images(patterns))
    assert (found.faults, found.verified) == ((), len(REFERENCES))

"""Frames sorted by pattern: averages, substitutes, and error messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    Gray,
    LineShift,
    Pattern,
    Shot,
    Size,
    White,
)
from slrig.patterns.sequence import scan_patterns
from slrig.reconstruction.camera_response import estimate_noise
from slrig.reconstruction.frames import Images, axis_frames, sample_format, stack_rows, subsample
from tests.unit.reconstruction.builders import grid, seen_by_camera

CAMERA = CameraFormat(Size(3, 2), 8)
BITS = [Gray(Axis.COLUMN, bit, 2) for bit in range(2)]
INVERSES = [Gray(Axis.COLUMN, bit, 2, inverted=True) for bit in range(2)]
LINES = [LineShift(Axis.COLUMN, shift, 4) for shift in range(4)]

Seen = tuple[Pattern, int | Sequence[int], float | None]


def capture_of(*seen: Seen, camera: CameraFormat = CAMERA, name: str = "eye") -> Capture:
    """Frames of one value each (or one per column), in the order given."""
    patterns = tuple(dict.fromkeys(pattern for pattern, _, _ in seen))
    shots = tuple(
        Shot(
            patterns.index(pattern),
            name,
            np.broadcast_to(np.array(value, dtype=np.uint8), camera.size.shape).copy(),
            exposure_s=exposure,
        )
        for pattern, value, exposure in seen
    )
    return Capture(Size(4, 4), patterns, {name: camera}, shots)


def plain(*patterns: Pattern, value: int = 50) -> list[Seen]:
    return [(pattern, value, None) for pattern in patterns]


def exposed(exposure_s: float | None, *patterns: Pattern) -> list[Seen]:
    return [(pattern, 50, exposure_s) for pattern in patterns]


ENDS: list[Seen] = [(White(), 200, None), (Black(), 10, None)]


def first_pixels(images: Images) -> list[float]:
    return [float(image[0, 0]) for image in images]


def test_frames_are_sorted_by_pattern() -> None:
    seen: list[Seen] = [(LINES[2], 72, None), (BITS[1], 21, None), (LINES[0], 70, None), (INVERSES[0], 30, None)]
    seen += [*ENDS, (INVERSES[1], 31, None), (BITS[0], 20, None)]
    frames = axis_frames(capture_of(*seen), "eye", Axis.COLUMN)
    assert first_pixels(frames.bits) == [20, 21]
    assert frames.inverses is not None
    assert first_pixels(frames.inverses) == [30, 31]
    assert first_pixels(frames.lines) == [70, 72]
    assert frames.line_patterns == (LINES[0], LINES[2])
    assert (frames.contrast == 190).all()
    assert frames.full_scale == 255
    assert (frames.gray.bits, frames.gray.cell_px, frames.gray.offset_px) == (2, 1, 0)
    for image in (frames.white, frames.black):
        assert image.dtype == np.float32
    for image in (*frames.bits, *frames.inverses, *frames.lines):
        assert image.dtype == np.uint8


def test_rows_of_frames_are_those_of_all_images() -> None:
    frames = axis_frames(capture_of(*ENDS, *plain(*BITS), *plain(*INVERSES), *plain(*LINES)), "eye", Axis.COLUMN)
    some = frames.rows(slice(1, 2))
    assert some.inverses is not None
    for images in (some.bits, some.inverses, some.lines):
        assert {image.shape for image in images} == {(1, frames.white.shape[1])}
    assert stack_rows(frames.lines, slice(1, 2)).dtype == np.float32
    assert first_pixels(some.bits) == first_pixels(frames.bits)
    assert subsample(frames.bits, 2, 3).shape == (2, -(-frames.white.shape[0] // 2), -(-frames.white.shape[1] // 3))


def test_only_the_requested_axis_and_camera_are_used() -> None:
    row = Gray(Axis.ROW, 0, 1)
    both = capture_of(*ENDS, *plain(*BITS), *plain(row, LineShift(Axis.ROW, 0, 4), value=77))
    assert first_pixels(axis_frames(both, "eye", Axis.ROW).bits) == [77]
    assert len(axis_frames(both, "eye", Axis.COLUMN).lines) == 0
    other = capture_of(*ENDS, *plain(*BITS, value=99), name="other")
    together = Capture(both.projector, both.patterns, {**both.cameras, **other.cameras}, both.shots + other.shots)
    assert np.max(axis_frames(together, "eye", Axis.COLUMN).bits) == 50


def test_repeats_at_one_exposure_are_averaged() -> None:
    opening: list[Seen] = [(White(), 205, None), (White(), 207, None)]
    frames = axis_frames(capture_of(*ENDS, *opening, *plain(*BITS)), "eye", Axis.COLUMN)
    assert (frames.white == np.float32(204)).all()
    twice = axis_frames(capture_of(*ENDS, *plain(*BITS), *plain(*BITS, value=60), *ENDS), "eye", Axis.COLUMN)
    assert (np.array(twice.bits) == np.float32(55)).all()
    assert (frames.reference_repeats, twice.reference_repeats) == (1.0, 1.0)


def test_white_and_black_that_close_a_sequence_are_evidence_only() -> None:
    closing: list[Seen] = [(White(), 220, None), (Black(), 30, None)]
    frames = axis_frames(capture_of(*ENDS, *plain(*BITS), *closing), "eye", Axis.COLUMN)
    assert (frames.white == 200).all()
    assert (frames.black == 10).all()
    alone = axis_frames(capture_of(*plain(*BITS), *closing), "eye", Axis.COLUMN)
    assert (alone.white == 220).all()
    # Of a sequence that is played twice everything counts, and twice as much of the ends where it is closed, too.
    twice = axis_frames(capture_of(*ENDS, *plain(*BITS), *closing, *ENDS, *plain(*BITS), *closing), "eye", Axis.COLUMN)
    assert (twice.white == 210).all()
    assert twice.reference_repeats == 2.0


@pytest.mark.parametrize("opening", [2, 3])
def test_repeated_reference_frames_have_less_noise(opening: int) -> None:
    frames = axis_frames(capture_of(*(ENDS * opening), *plain(*BITS), *ENDS), "eye", Axis.COLUMN)
    assert frames.reference_repeats == opening


def test_a_bit_shown_only_inverted_is_inverted() -> None:
    frames = axis_frames(capture_of(*ENDS, *plain(BITS[0]), (INVERSES[1], 60, None)), "eye", Axis.COLUMN)
    assert first_pixels(frames.bits) == [50, 200 + 10 - 60]


def test_without_white_and_black_the_pairs_stand_in() -> None:
    seen: list[Seen] = [
        (BITS[0], [90, 11, 12], None), (INVERSES[0], [10, 91, 92], None),
        (BITS[1], [9, 10, 95], None), (INVERSES[1], [93, 94, 8], None),
    ]  # fmt: skip
    frames = axis_frames(capture_of(*seen), "eye", Axis.COLUMN)
    assert frames.white[0].tolist() == [93, 94, 95]
    assert frames.black[0].tolist() == [9, 10, 8]
    with_white = axis_frames(capture_of(*seen, (White(), 99, None)), "eye", Axis.COLUMN)
    assert with_white.white[0].tolist() == [99, 99, 99]
    assert with_white.black[0].tolist() == [9, 10, 8]


REFUSED = {
    "no code": ([*ENDS, *plain(*LINES)], ["camera 'eye'", "no Gray-code frames", "column axis"]),
    "another axis": ([*ENDS, *plain(Gray(Axis.ROW, 0, 1))], ["no Gray-code frames", "column axis"]),
    "a missing bit": ([*ENDS, *plain(BITS[1])], ["camera 'eye'", "bits [0] of 2", "shoot them again"]),
    "two codes": (
        [*ENDS, *plain(*BITS, Gray(Axis.COLUMN, 0, 2, cell_px=3))],
        ["camera 'eye'", "2 different codes", "(2, 1, 0)", "(2, 3, 0)", "keep one"],
    ),
    "two periods": (
        [*ENDS, *plain(*BITS, *LINES, LineShift(Axis.COLUMN, 0, 8))],
        ["camera 'eye'", "two periods or widths", "keep one"],
    ),
    "nothing to compare with": (
        [(White(), 200, None), *plain(*BITS)],
        ["camera 'eye'", "no white and black frames", "no bit with its inverse", "add a white and a black frame"],
    ),
    "several exposures": (
        [seen for e in (0.01, 0.02) for seen in exposed(e, White(), Black(), *BITS)],
        ["camera 'eye'", "frames of one exposure", "0.01", "0.02", "fuse them first"],
    ),
}  # type: dict[str, tuple[list[Seen], list[str]]]


@pytest.mark.parametrize("case", REFUSED)
def test_frames_that_cannot_be_decoded_are_refused(case: str) -> None:
    seen, words = REFUSED[case]
    with pytest.raises(PatternError) as caught:
        axis_frames(capture_of(*seen), "eye", Axis.COLUMN)
    for word in words:
        assert word in str(caught.value)


def test_recorded_frames_are_not_modified() -> None:
    capture = capture_of(*ENDS, *plain(*BITS), *plain(*BITS, value=60), *plain(INVERSES[0]), *ENDS)
    before = [shot.image.copy() for shot in capture.shots]
    axis_frames(capture, "eye", Axis.COLUMN)
    for shot, image in zip(capture.shots, before, strict=True):
        np.testing.assert_array_equal(shot.image, image)


@pytest.mark.parametrize(
    ("bits", "step", "declared"),
    [(12, 16, 16), (10, 64, 16), (14, 4, 16), (12, 1, 16), (10, 1, 16), (14, 1, 16), (10, 1, 12), (12, 1, 12)],
)
def test_the_bits_of_a_word_that_samples_use_are_found(bits: int, step: int, declared: int) -> None:
    full = 2**bits - 1
    samples = np.minimum(np.random.default_rng(0).normal(0.8 * full, 0.1 * full, (300, 400)), full)
    found = sample_format([(samples.astype(np.uint16) * step).astype(np.uint16)], 2.0**declared - 1)
    assert found == (step, full * step)


def test_eight_bits_and_few_values_are_as_declared() -> None:
    assert sample_format([np.array([[0, 254]], dtype=np.uint8)], 255.0) == (1.0, 255.0)
    assert sample_format([np.array([[0, 4096]], dtype=np.uint16)], 65535.0) == (1.0, 65535.0)


@pytest.mark.parametrize("noise", [0.2, 2.0], ids=["less than a step", "more than a step"])
def test_left_aligned_samples_have_the_noise_of_the_camera(noise: float) -> None:
    x, y = grid((200, 300))
    shown = scan_patterns(
        Size(256, 192), line_shift=False, period_px=8, line_width_px=1, gray_cell_px=2, gray_offset_px=0, rows=False
    )
    capture = seen_by_camera(20 + 0.7 * x + 0.1 * y, shown, Size(256, 192), noise=noise, white=2000.0, bit_depth=12)
    shots = tuple(replace(shot, image=shot.image << np.uint16(4)) for shot in capture.shots)
    aligned = replace(capture, cameras={"eye": CameraFormat(Size(300, 200), 16)}, shots=shots)
    plain, ours = (estimate_noise(axis_frames(each, "eye", Axis.COLUMN)) for each in (capture, aligned))
    assert ours.read_variance == pytest.approx(256 * plain.read_variance, rel=1e-3)
    assert ours.read_variance >= 256 / 12

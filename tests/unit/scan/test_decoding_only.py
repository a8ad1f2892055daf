"""Decoding without a calibration: positions, causes and what to change, for people who are setting up a rig."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from slrig.bundle import write_bundle
from slrig.cli.commands import app
from slrig.errors import PatternError
from slrig.model import Axis, Black, CameraFormat, Capture, Gray, LineShift, Pattern, Pixels, Shot, Size, White
from slrig.model.capture import MAX_MISSING_BITS, trim_incomplete_codes
from slrig.patterns.codes import gray_bits, gray_profile
from slrig.patterns.sequence import scan_patterns
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.preparation import sample_scan
from slrig.scan.reconstruct import decode_bundle, reconstruct_bundle


def recorded(folder: Path, change: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None) -> Path:
    """A made-up scan without its calibration, each frame changed."""
    capture, _ = sample_scan()
    if change is not None:
        shots = []
        for shot in capture.shots:
            image: Pixels = np.clip(change(shot.image.astype(np.float64)), 0, 255).astype(np.uint8)
            shots.append(replace(shot, image=image))
        capture = replace(capture, shots=tuple(shots))
    write_bundle(folder, capture, None)
    return folder


def without_finest_bit(folder: Path) -> Path:
    """A made-up Gray-only scan of which nobody copied the finest bit."""
    capture, calibration = sample_scan()
    kept = [
        shot
        for shot in capture.shots
        if not isinstance(shown := capture.patterns[shot.pattern], LineShift)
        and not (isinstance(shown, Gray) and shown.bit == shown.bits - 1)
    ]
    write_bundle(folder, replace(capture, shots=tuple(kept)), calibration)
    return folder


def test_a_missing_bit_is_told_and_the_others_are_decoded(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["reconstruct", str(without_finest_bit(tmp_path / "b")), "--decode-only", "--output", str(tmp_path / "o")]
    )
    assert result.exit_code == 0, result.output
    words = " ".join(result.output.split())
    assert "note a camera has no frame of bit 6 of the 6 of the column code: the first 5 are used" in words
    report = json.loads((tmp_path / "o" / "report.json").read_text())
    assert len(report["notes"]) == 1
    assert report["decoded"][0]["decoded"] > 0.9


def test_a_missing_bit_leaves_a_mesh_of_the_others(tmp_path: Path) -> None:
    bundle = without_finest_bit(tmp_path / "b")
    report = reconstruct_bundle(bundle, tmp_path / "out", plan=ReconstructionPlan())
    assert "bit 6 of the 6" in str(report["notes"])
    assert len(trimesh.load_mesh(tmp_path / "out" / "mesh.ply", process=False).faces) > 200


def test_positions_are_those_of_the_projector(tmp_path: Path) -> None:
    (found,), _ = decode_bundle(recorded(tmp_path / "bundle"), tmp_path / "out")
    assert found.lit > 0.5
    assert found.decoded > 0.9
    assert found.advice == []
    position = tifffile.imread(tmp_path / "out" / "position-sample-column.tiff")
    assert position.dtype == np.float32
    known = np.isfinite(position)
    assert known.mean() == pytest.approx(found.lit * found.decoded, abs=0.02)
    # Columns rise to the right on a sheet that has no cliff.
    assert (np.diff(position[20], axis=0)[known[20, 1:] & known[20, :-1]] > -0.5).all()
    assert {each.name for each in (tmp_path / "out").iterdir()} == {
        "position-sample-column.tiff", "position-sample-column.png", "rejected-sample-column.png", "report.json",
    }  # fmt: skip
    (told,) = json.loads((tmp_path / "out" / "report.json").read_text())["decoded"]
    assert told["camera"] == "sample"
    assert told["axis"] == "column"
    assert told["decoded"] == found.decoded


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image: 2.5 * image, "saturated"),
        (lambda image: 12 + 0.04 * image, "weak"),
    ],
)
def test_it_says_what_to_change(
    tmp_path: Path, change: Callable[[NDArray[np.float64]], NDArray[np.float64]], words: str
) -> None:
    (found,), _ = decode_bundle(recorded(tmp_path / "bundle", change), tmp_path / "out")
    assert any(words in advice for advice in found.advice), found


def test_frames_without_a_code_are_refused(tmp_path: Path) -> None:
    capture, _ = sample_scan()
    kept = [index for index, pattern in enumerate(capture.patterns) if not isinstance(pattern, Gray)]
    shots = tuple(replace(s, pattern=kept.index(s.pattern)) for s in capture.shots if s.pattern in kept)
    bare = Capture(capture.projector, tuple(capture.patterns[index] for index in kept), capture.cameras, shots)
    write_bundle(tmp_path / "bundle", bare, None)
    with pytest.raises(PatternError, match="no frames of Gray code or sinusoids"):
        decode_bundle(tmp_path / "bundle", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---- Recordings that lack a fine bit: what the rest of the code is, and what is left alone


PROJECTOR = Size(64, 48)


def scan_without(*lacking: tuple[str, int], lines: bool = False, rows: bool = False) -> Capture:
    """Two cameras' frames of a scan; of each bit of the columns that is named a camera has none. Each frame tells its
    pattern and its camera.
    """
    patterns = scan_patterns(
        PROJECTOR, line_shift=lines, period_px=8, line_width_px=1, gray_cell_px=2, gray_offset_px=1, rows=rows
    )
    cameras = {name: CameraFormat(Size(3, 2), 8) for name in ("left", "right")}
    shots = [
        Shot(index, name, np.full((2, 3), index + 100 * (name == "right"), np.uint8), 0.02, 0.1 * index)
        for index, pattern in enumerate(patterns)
        for name in cameras
        if not (isinstance(pattern, Gray) and pattern.axis is Axis.COLUMN and (name, pattern.bit) in lacking)
    ]
    return Capture(PROJECTOR, patterns, cameras, tuple(shots))


def shown_by_frame(capture: Capture) -> dict[tuple[str, int], Pattern]:
    """By camera and what the frame tells of itself: the pattern that it is said to show."""
    return {(shot.camera, int(shot.image[0, 0]) % 100): capture.patterns[shot.pattern] for shot in capture.shots}


@given(extent_px=st.integers(16, 400), cell_px=st.integers(1, 4), offset_px=st.integers(0, 9), cut=st.integers(1, 3))
def test_what_is_left_shows_the_same_light(extent_px: int, cell_px: int, offset_px: int, cut: int) -> None:
    bits = gray_bits(extent_px, cell_px, offset_px)
    if bits - cut < 1:
        return
    size = Size(extent_px, 4)
    for bit in range(bits - cut):
        before = Gray(Axis.COLUMN, bit, bits, cell_px, offset_px)
        after = Gray(Axis.COLUMN, bit, bits - cut, cell_px << cut, offset_px)
        np.testing.assert_array_equal(gray_profile(after, size), gray_profile(before, size))


@pytest.mark.parametrize("lacking", [(("left", 5),), (("left", 5), ("right", 5)), (("right", 4),)])
def test_finer_bits_go_with_the_missing_one_in_every_camera(lacking: tuple[tuple[str, int], ...]) -> None:
    whole, capture = scan_without(), scan_without(*lacking)
    kept = lacking[0][1]
    cut, (told,) = trim_incomplete_codes(capture)
    assert f"bit {kept + 1} of the 6 of the column code" in told
    assert f"cells of {2 << 6 - kept} px instead of 2" in told
    expected = {}
    for key, pattern in shown_by_frame(whole).items():
        if isinstance(pattern, Gray):
            if pattern.bit >= kept:
                continue
            pattern = Gray(Axis.COLUMN, pattern.bit, kept, 2 << (6 - kept), 1, pattern.inverted)
        expected[key] = pattern
    assert shown_by_frame(cut) == expected
    assert {p.bit for p in cut.patterns if isinstance(p, Gray)} == set(range(kept))
    other = scan_without(("left", 5), rows=True)
    rows = [p for p in other.patterns if isinstance(p, Gray) and p.axis is Axis.ROW]
    cut_of_both, (_,) = trim_incomplete_codes(other)
    assert [p for p in cut_of_both.patterns if isinstance(p, Gray) and p.axis is Axis.ROW] == rows
    assert [s.time_s for s in cut.shots] == sorted(s.time_s or 0.0 for s in cut.shots)


@pytest.mark.parametrize(
    "capture",
    [
        scan_without(),
        scan_without(lines=True, rows=True),
        # Cells of four pixels number lines that are eight apart, and wider ones do not.
        scan_without(("left", 4), lines=True),
        scan_without(("left", 5 - MAX_MISSING_BITS)),
        scan_without(("left", 0)),
        Capture(PROJECTOR, (White(), Black(), LineShift(Axis.COLUMN, 0, 8, 1)), {}, ()),
    ],
    ids=["whole", "both axes", "lines", "too coarse", "nothing left", "no code"],
)
def test_all_else_is_left_as_it_is(capture: Capture) -> None:
    assert trim_incomplete_codes(capture) == (capture, ())

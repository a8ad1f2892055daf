"""Whatever is written as a bundle or calibration is read back as it was."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.bundle import (
    parse_calibration,
    read_bundle,
    read_opencv_calibration,
    write_bundle,
    write_calibration,
    write_opencv_calibration,
)
from slrig.model import (
    Axis,
    Black,
    Calibration,
    CameraFormat,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    Pattern,
    Pinhole,
    Shot,
    Size,
    SolveRecord,
    White,
)
from tests.samples import noise

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,8}", fullmatch=True).filter(lambda name: name != "projector")
sizes = st.builds(Size, st.integers(1, 24), st.integers(1, 24))
finite = st.floats(-1e6, 1e6)
axes = st.sampled_from(Axis)


@st.composite
def _grays(draw: st.DrawFn) -> Gray:
    bits = draw(st.integers(1, 24))
    numbers = draw(st.tuples(st.integers(0, bits - 1), st.integers(1, 300), st.integers(0, 300)))
    return Gray(draw(axes), numbers[0], bits, numbers[1], numbers[2], draw(st.booleans()))


@st.composite
def _line_shifts(draw: st.DrawFn) -> LineShift:
    period_px = draw(st.integers(4, 64))
    width_px = draw(st.integers(1, period_px - 1))
    return LineShift(draw(axes), draw(st.integers(0, period_px - 1)), period_px, width_px)


patterns: st.SearchStrategy[Pattern] = st.one_of(st.just(White()), st.just(Black()), _grays(), _line_shifts())


@st.composite
def _captures(draw: st.DrawFn) -> Capture:
    cameras = draw(st.dictionaries(names, st.builds(CameraFormat, sizes, st.integers(1, 16)), min_size=1, max_size=3))
    shown = draw(st.lists(patterns, min_size=1, max_size=5))
    times = st.none() | st.floats(0, 1e5)
    exposures = st.none() | st.floats(1e-6, 10)
    shots = tuple(
        Shot(pattern, name, noise(cameras[name], draw(st.integers(0, 99))), draw(exposures), draw(times))
        for pattern, name in draw(
            st.lists(
                st.tuples(st.integers(0, len(shown) - 1), st.sampled_from(sorted(cameras))), min_size=1, max_size=6
            )
        )
    )
    return Capture(draw(sizes), tuple(shown), cameras, shots)


@st.composite
def _pinholes(draw: st.DrawFn) -> Pinhole:
    axis = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3)))
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    # Cayley's transform: a rotation from any skew matrix.
    rotation = np.linalg.solve(np.eye(3) + skew, np.eye(3) - skew)
    focal = st.floats(1, 1e5)
    matrix = np.array([[draw(focal), draw(finite), draw(finite)], [0, draw(focal), draw(finite)], [0, 0, 1.0]])
    distortion = np.array(draw(st.tuples(*[finite] * 5)))
    return Pinhole(draw(sizes), matrix, distortion, rotation, np.array(draw(st.tuples(*[finite] * 3))))


calibrations = st.builds(
    Calibration, st.dictionaries(names, _pinholes(), min_size=1, max_size=3), st.none() | _pinholes()
)
# FileStorage itself loses spaces at the end of a text and quotes around it.
texts = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Zs", "Zl", "Zp"), include_characters=" "),
    min_size=1,
    max_size=40,
)
texts = texts.filter(lambda text: text == text.strip() and text[0] not in "\"'")


@st.composite
def _solved_calibrations(draw: st.DrawFn) -> Calibration:
    calibration = draw(calibrations)
    count = 15 * (len(calibration.cameras) + (calibration.projector is not None))
    root = np.random.default_rng(draw(st.integers(0, 99))).normal(size=(count, count))
    root *= np.geomspace(1e-12, draw(st.floats(1e-3, 1e12)), count)[:, None]
    box = np.array(draw(st.tuples(*[finite] * 6))).reshape(2, 3)
    # Offsets of whole minutes, as ISO 8601 has them: local mean times before 1972 have seconds.
    moment = draw(st.datetimes(min_value=datetime(1972, 2, 1), timezones=st.timezones())).isoformat()  # noqa: DTZ001
    solved = SolveRecord(draw(texts), moment, root @ root.T, box, draw(st.floats(0, 1e60)))
    return replace(calibration, solved=solved)


@settings(max_examples=3, deadline=None)
@given(_captures())
def test_a_bundle_comes_back_as_it_was_written(capture: Capture) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_bundle(Path(folder) / "scan", capture)
        read = read_bundle(Path(folder) / "scan")
    assert read.calibration is None
    assert read.capture.projector == capture.projector
    assert read.capture.patterns == capture.patterns
    assert read.capture.cameras == capture.cameras
    for got, want in zip(read.capture.shots, capture.shots, strict=True):
        assert (got.pattern, got.camera, got.exposure_s, got.time_s) == (
            want.pattern,
            want.camera,
            want.exposure_s,
            want.time_s,
        )
        assert got.image.dtype == want.image.dtype
        np.testing.assert_array_equal(got.image, want.image)


def _same(got: Calibration, want: Calibration) -> None:
    assert list(got.cameras) == list(want.cameras)
    assert (got.projector is None) == (want.projector is None)
    pairs = [(got.cameras[name], want.cameras[name]) for name in want.cameras]
    if got.projector is not None and want.projector is not None:
        pairs.append((got.projector, want.projector))
    assert (got.solved is None) == (want.solved is None)
    if got.solved is not None and want.solved is not None:
        assert (got.solved.id, got.solved.solved_at) == (want.solved.id, want.solved.solved_at)
        assert got.solved.expected_error_mm == want.solved.expected_error_mm
        np.testing.assert_array_equal(got.solved.covariance, want.solved.covariance)
        np.testing.assert_array_equal(got.solved.volume_mm, want.solved.volume_mm)
    for one, other in pairs:
        assert one.size == other.size
        arrays: list[tuple[FloatArray, FloatArray]] = [
            (one.matrix, other.matrix),
            (one.distortion, other.distortion),
            (one.rotation, other.rotation),
            (one.translation_mm, other.translation_mm),
        ]
        for left, right in arrays:
            np.testing.assert_array_equal(left, right)


@settings(max_examples=8, deadline=None)
@given(calibrations | _solved_calibrations(), st.sampled_from(["json", "yml", "yaml", "xml"]))
def test_a_calibration_comes_back_bit_by_bit(calibration: Calibration, ending: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"calibration.{ending}"
        if ending == "json":
            write_calibration(path, calibration)
        else:
            write_opencv_calibration(path, calibration)
            _same(read_opencv_calibration(path), calibration)
        _same(parse_calibration(path), calibration)

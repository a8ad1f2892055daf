"""Frames that are read one after another: the same results in whatever order they are listed, and few in memory."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.bundle.images import read_with_colour as read_frame_pages
from slrig.bundle.reading import MOST_READERS, open_bundle
from slrig.capture.evidence import check_capture
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.errors import BundleError
from slrig.model import Axis, Black, Capture, LineShift, Pixels, Shot, White
from slrig.model.header import CaptureHeader
from slrig.scan.acquisition import capture_frames
from slrig.scan.measured import measured
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from slrig.scan.stream import ScanStream

RIG = Path(__file__).parents[3] / "config" / "rigs" / "sphere.toml"


@pytest.fixture(scope="module")
def both_axes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of columns and rows, without its truth."""
    folder = tmp_path_factory.mktemp("both") / "bundle"
    with open_rig(read_rig(RIG)) as rig:
        plan = ScanPlan(PatternPlan(rows=True))
        capture_frames(rig, plan, folder, progress=lambda *_: None, cancelled=lambda: False).finish()
    for each in (*folder.glob("truth*"), folder / "visible_points.npy"):
        each.unlink()
    return folder


def mesh_of(bundle: Path, output: Path) -> tuple[bytes, dict[str, Any]]:
    report: dict[str, Any] = reconstruct_bundle(
        bundle, output, plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False
    )
    return (output / "mesh.ply").read_bytes(), report


def test_lines_before_the_code_and_black_before_white_change_nothing(both_axes: Path, tmp_path: Path) -> None:
    bundle = read_bundle(both_axes)
    capture = bundle.capture

    def rank(shot: Shot) -> int:
        pattern = capture.patterns[shot.pattern]
        if isinstance(pattern, LineShift):
            return 1
        return {Black(): -1, White(): 0}.get(pattern, 2) if shot.pattern < 2 else 2

    assert {capture.patterns[0], capture.patterns[1]} == {White(), Black()}
    shots = tuple(sorted(capture.shots, key=rank))
    assert shots != capture.shots
    write_bundle(tmp_path / "sorted", replace(capture, shots=shots), bundle.calibration)
    mesh, report = mesh_of(both_axes, tmp_path / "as played")
    other, other_report = mesh_of(tmp_path / "sorted", tmp_path / "out")
    assert other == mesh
    assert other_report["evidence"] == report["evidence"]


def test_what_frames_prove_is_what_they_prove_together(both_axes: Path, tmp_path: Path) -> None:
    bundle = read_bundle(both_axes)
    capture = bundle.capture
    # A frame of another pattern in place of a line frame is a contradiction.
    wrong = next(i for i, s in enumerate(capture.shots) if isinstance(capture.patterns[s.pattern], LineShift))
    shots = list(capture.shots)
    shots[wrong] = replace(shots[wrong], image=shots[wrong + 1].image)
    write_bundle(tmp_path / "bundle", replace(capture, shots=tuple(shots)), bundle.calibration)
    told = check_capture(replace(capture, shots=tuple(shots)))
    assert told.faults
    walked, _ = measured(tmp_path / "bundle", None, None, lambda *_: None, axis=None)
    assert walked.sections["identity"] == str(told)
    assert walked.sections["evidence"]["contradictions"] == list(told.faults)  # type: ignore[index]


def test_frames_are_let_go_when_they_are_not_needed(both_axes: Path) -> None:
    bundle = read_bundle(both_axes)
    assert bundle.calibration is not None
    header = CaptureHeader.of(bundle.capture)
    stream = ScanStream(header, bundle.calibration, entered=lambda *_: None, axis=Axis.COLUMN)
    held: list[tuple[Axis | None, weakref.ref[Pixels]]] = []
    most = 0
    for shot in bundle.capture.shots:
        image = shot.image.copy()
        held.append((getattr(header.patterns[shot.pattern], "axis", None), weakref.ref(image)))
        stream.take(replace(shot, image=image))
        del image
        gc.collect()
        alive = [axis for axis, each in held if each() is not None]
        assert set(alive) <= {Axis.COLUMN}
        most = max(most, len(alive))
    # The last of them is used and let go at once.
    assert most == len([axis for axis, _ in held if axis is Axis.COLUMN]) - 1
    assert not any(each() is not None for _, each in held)
    assert stream.finish()[0].curves.stripe_points > 1000


def test_axes_of_two_exposures_wait_for_one_another(both_axes: Path, tmp_path: Path) -> None:
    bundle = read_bundle(both_axes)
    capture = bundle.capture

    def exposed(shot: Shot) -> Shot:
        row = getattr(capture.patterns[shot.pattern], "axis", None) is Axis.ROW
        return replace(shot, exposure_s=0.05 if row else 0.02)

    shots = tuple(exposed(shot) for shot in capture.shots)
    write_bundle(tmp_path / "bundle", replace(capture, shots=shots), bundle.calibration)
    _, report = mesh_of(tmp_path / "bundle", tmp_path / "out")
    assert report["mesh"]["points"] > 1000


def test_frames_are_read_a_few_ahead(both_axes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def read_pages(path: Path, *rest: Any, **options: Any) -> Any:
        read.append(path)
        return read_frame_pages(path, *rest, **options)

    monkeypatch.setattr("slrig.bundle.reading.read_with_colour", read_pages)
    files = open_bundle(both_axes)
    assert not read
    whole = read_bundle(both_axes).capture
    read.clear()
    order = [5, 3, 12, 0, 20, 21, 22, 23, 24]
    for taken, (index, shot) in enumerate(zip(order, files.shots(order), strict=True), start=1):
        assert len(read) <= taken + MOST_READERS + 1
        assert np.array_equal(shot.image, whole.shots[index].image)
        assert (shot.pattern, shot.camera, shot.time_s) == (
            whole.shots[index].pattern, whole.shots[index].camera, whole.shots[index].time_s,
        )  # fmt: skip
    assert len(read) == len(order)


def test_the_outline_has_everything_but_pixels(both_axes: Path) -> None:
    outline, whole = open_bundle(both_axes).outline, read_bundle(both_axes).capture
    assert CaptureHeader.of(outline) == CaptureHeader.of(whole)
    assert not any(shot.image.any() for shot in outline.shots)
    assert sum(shot.image.base.nbytes for shot in outline.shots if shot.image.base is not None) < 1000
    assert isinstance(outline, Capture)


def test_the_first_frame_that_cannot_be_read_is_told(both_axes: Path, tmp_path: Path) -> None:
    bundle = read_bundle(both_axes)
    write_bundle(tmp_path / "bundle", bundle.capture, bundle.calibration)
    for number in (7, 4):
        (tmp_path / "bundle" / "frames" / bundle.capture.shots[0].camera / f"{number:03d}.png").write_bytes(b"")
    with pytest.raises(BundleError, match=r"004\.png"):
        list(open_bundle(tmp_path / "bundle").shots(range(len(bundle.capture.shots))))

"""The walk from a bundle to its mesh: its files, what it refuses, frames that came live, frames in memory."""

from __future__ import annotations

import gc
import json
import platform
import re
import shutil
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from slrig.bundle import BundleWriter, read_bundle, read_calibration, write_bundle, write_calibration
from slrig.bundle.description import read_description
from slrig.bundle.images import read_with_colour as read_frame_pages
from slrig.bundle.reading import MAX_READERS, open_bundle
from slrig.bundle.sidecars import TurntableAngle, write_health, write_notes, write_turntable_angle
from slrig.capture.verifier import check_capture
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.errors import (
    BundleError,
    CalibrationError,
    InvalidInputError,
    NothingToReconstructError,
    PatternError,
    ScanCancelledError,
    SlrigError,
)
from slrig.jobs.listener import Listener
from slrig.jobs.records import versions
from slrig.model import (
    Axis,
    Black,
    Calibration,
    Capture,
    Gray,
    LineShift,
    Pixels,
    Refusal,
    Shot,
    Size,
    SolveRecord,
    White,
)
from slrig.model.capture import CaptureHeader
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import write_converted
from slrig.scan.measured import measured
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle, reconstruct_into
from slrig.scan.report import calibration_report
from slrig.scan.stream import LiveScan, ScanStream
from tests.core import parametrize_core
from tests.golden.test_light_axis import BALL, Device, rig_file
from tests.prepared_bundles import prepared_bundle

Read = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_bundle(tmp_path_factory, "ball")


@pytest.fixture(scope="module")
def both_axes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_bundle(tmp_path_factory, "ball by both axes")


@pytest.fixture(scope="module")
def read(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Read:
    """The folder of a mesh that was made of the bundle, and its report."""
    output = tmp_path_factory.mktemp("read") / "out"
    return output, run(recorded, output)


def run(
    bundle: Path, output: Path, *, live: LiveScan | None = None, calibration: Path | None = None, **options: Any
) -> dict[str, Any]:
    return reconstruct_bundle(
        bundle,
        output,
        plan=ReconstructionPlan(**options),
        calibration=calibration,
        live=live,
    )


def changed(recorded: Path, folder: Path, change: Callable[[Shot, Capture], Shot | None]) -> Path:
    """A copy of the bundle with each frame changed, or left out."""
    bundle = read_bundle(recorded)
    capture = bundle.capture
    shots = (change(shot, capture) for shot in capture.shots)
    kept = Capture(capture.projector, capture.patterns, capture.cameras, tuple(s for s in shots if s is not None))
    write_bundle(folder, kept, bundle.calibration)
    return folder


def refused(error: type[SlrigError], bundle: Path, output: Path) -> str:
    """The message of a refusal that left nothing behind."""
    with pytest.raises(error) as caught:
        run(bundle, output)
    assert not output.exists()
    assert [path.name for path in output.parent.iterdir() if path.name.startswith(".")] == []
    return str(caught.value)


def test_a_scan_of_the_rendered_rig_is_a_mesh_with_its_files(read: Read) -> None:
    output, report = read
    names = {path.name for path in output.iterdir()}
    assert {"mesh.ply", "mesh.glb", "points.ply", "report.json", "preview.png"} <= names
    written = json.loads((output / "report.json").read_text())
    for camera, told in written["cameras"].items():
        causes = cv2.imread(str(output / f"causes-{camera}.png"), cv2.IMREAD_UNCHANGED)
        assert causes is not None
        assert causes.shape == tuple(reversed(written["frames"]["cameras_px"][camera]))
        counts = np.bincount(causes.ravel(), minlength=len(written["causes"]))
        named = {each["name"]: int(count) for each, count in zip(written["causes"], counts, strict=True)}
        assert named.pop("none") > 0
        assert {name: count for name, count in named.items() if name} == told["refused_pixels"]
        picture = cv2.imread(str(output / f"rejected-{camera}.png"))
        assert picture is not None
        width, height = told["rejected_png_px"]
        row, column = (each[len(each) // 2] for each in np.nonzero(causes == Refusal.NOT_LIT))
        at = (int((row + 0.5) / causes.shape[0] * height), int((column + 0.5) / causes.shape[1] * width))
        assert tuple(picture[at]) == (30, 26, 24)
    assert written["mesh"]["initial"] == report["mesh"]["initial"]
    assert written["computed"] == {"where": "local", "host": platform.node(), "versions": dict(versions())}
    initial = written["mesh"]["initial"]
    assert initial["triangles"] == initial["strip_triangles"] - initial["dropped_triangles"]


@pytest.mark.slow
def test_results_of_an_earlier_run_are_replaced_and_other_folders_are_not(recorded: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(recorded, tmp_path / "bundle")
    assert "turntable" not in run(bundle, tmp_path / "out")
    # What the bundle says of the stage is said by every reconstruction of it.
    write_turntable_angle(bundle, TurntableAngle(angle_deg=45.0, turned_by="hand"))
    run(bundle, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["turntable"] == {"angle_deg": 45.0, "turned_by": "hand"}
    other = tmp_path / "holiday"
    other.mkdir()
    (other / "picture.jpg").write_bytes(b"not ours")
    with pytest.raises(InvalidInputError, match="name a new folder"):
        run(recorded, other)
    assert [path.name for path in other.iterdir()] == ["picture.jpg"]


@pytest.mark.slow
def test_holes_are_kept_on_request(recorded: Path, tmp_path: Path) -> None:
    filled = run(recorded, tmp_path / "filled")["mesh"]["initial"]
    kept = run(recorded, tmp_path / "kept", keep_holes=True)["mesh"]["initial"]
    assert kept["strip_triangles"] == filled["strip_triangles"]
    assert filled["dropped_at_bridges"] == 0
    assert kept["triangles"] <= filled["triangles"]


def test_what_the_calibration_or_the_code_lacks_is_named(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(PatternError, match="no Gray-code frames of the row axis"):
        run(recorded, tmp_path / "out", axis=Axis.ROW)
    bundle = shutil.copytree(recorded, tmp_path / "bundle")
    path = bundle / "calibration.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"projector": None}))
    words = refused(CalibrationError, bundle, tmp_path / "out")
    assert "alone, without a projector: it has no depth, and cannot scan; calibrate the camera together with" in words
    path.unlink()
    assert "calibration.json" in refused(CalibrationError, bundle, tmp_path / "out")
    assert "calibration (--calibration)" in refused(CalibrationError, bundle, tmp_path / "out")
    next((bundle / "frames").rglob("*.*")).unlink()
    shutil.copy(recorded / "calibration.json", path)
    refused(BundleError, bundle, tmp_path / "out")


def flat(level: int) -> Callable[[Shot, Capture], Shot]:
    def change(shot: Shot, capture: Capture) -> Shot:
        value = level * capture.cameras[shot.camera].full_scale // 255
        return replace(shot, image=np.full_like(shot.image, value))

    return change


def without(*kinds: str, bit: int | None = None) -> Callable[[Shot, Capture], Shot | None]:
    """Leaves out frames of these kinds, and those of one bit; an inverted Gray frame is of kind "inverse"."""

    def change(shot: Shot, capture: Capture) -> Shot | None:
        pattern = capture.patterns[shot.pattern]
        gray = isinstance(pattern, Gray)
        kind = "inverse" if gray and pattern.inverted else pattern.kind  # type: ignore[union-attr]
        dropped = kind in kinds or (gray and pattern.bit == bit)  # type: ignore[union-attr]
        return None if dropped else shot

    return change


@parametrize_core(
    ("change", "error", "words"),
    [
        (flat(0), NothingToReconstructError, "no pixel could be decoded.*lens cap"),
        (flat(255), NothingToReconstructError, "no pixel could be decoded.*expose for a shorter time"),
        (without(bit=2), PatternError, r"bits \[2\]"),
        (without("white", "inverse"), PatternError, "bits have no threshold"),
    ],
    ids=["dark", "bright", "a missing bit", "no white and no inverses"],
    core=[0, 1],
)
def test_frames_that_tell_nothing_are_refused(
    recorded: Path,
    tmp_path: Path,
    change: Callable[[Shot, Capture], Shot | None],
    error: type[SlrigError],
    words: str,
) -> None:
    bundle = changed(recorded, tmp_path / "changed", change)
    message = refused(error, bundle, tmp_path / "out")
    assert re.search(words, message)
    assert str(bundle) in message


def test_a_code_that_names_columns_that_the_projector_has_not_is_refused(recorded: Path, tmp_path: Path) -> None:
    bundle = read_bundle(recorded)
    narrow = replace(bundle.capture, projector=Size(160, bundle.capture.projector.height_px))
    write_bundle(tmp_path / "narrow", narrow, None)
    calibration = json.loads((recorded / "calibration.json").read_text())
    calibration["projector"]["size_px"][0] = 160
    (tmp_path / "narrow" / "calibration.json").write_text(json.dumps(calibration))
    words = refused(NothingToReconstructError, tmp_path / "narrow", tmp_path / "out")
    named = re.search(r"names columns 0 to (\d+), the projector has 160", words)
    assert named is not None
    assert 160 < int(named[1]) < 256
    assert "a bit that is inverted" in words
    assert "lens cap" not in words


@pytest.mark.slow
def test_a_rotation_of_the_inverse_direction_is_no_fault_of_the_light(recorded: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(recorded, tmp_path / "bundle")
    known = read_calibration(bundle / "calibration.json")
    camera, projector = next(iter(known.cameras.values())), known.projector
    assert projector is not None
    turn = projector.rotation @ camera.rotation.T
    shift = projector.translation_mm - turn @ camera.translation_mm
    wrong = replace(projector, rotation=turn.T @ camera.rotation, translation_mm=turn.T @ camera.translation_mm + shift)
    write_calibration(bundle / "calibration.json", replace(known, projector=wrong))
    words = refused(NothingToReconstructError, bundle, tmp_path / "out")
    assert "of the points have no place" in words
    assert "R transposed" in words
    assert "The calibration does not fit these frames" in words
    assert "lens cap" not in words


@pytest.mark.slow
def test_lines_that_were_never_shown_are_made_up_for_by_code_edges_and_told(recorded: Path, tmp_path: Path) -> None:
    dark = {shot.camera: shot.image for shot in read_bundle(recorded).capture.shots if shot.pattern == 1}

    def no_lines(shot: Shot, capture: Capture) -> Shot:
        is_line = isinstance(capture.patterns[shot.pattern], LineShift)
        return replace(shot, image=dark[shot.camera]) if is_line else shot

    bundle = changed(recorded, tmp_path / "no-lines", no_lines)
    write_notes(bundle, ["what its capture told"])
    report = run(bundle, tmp_path / "out")
    assert report["notes"][0] == "what its capture told"
    assert any("does not resolve the shifted lines on 100%" in note for note in report["notes"])
    assert all(camera["lit_without_lines"] > 0.99 for camera in report["cameras"].values())


def test_a_projector_smaller_than_the_code_is_refused(recorded: Path, tmp_path: Path) -> None:
    bundle = read_bundle(recorded)
    small = replace(bundle.capture, projector=Size(100, 80))
    write_bundle(tmp_path / "small", small, None)
    calibration = json.loads((recorded / "calibration.json").read_text())
    calibration["projector"]["size_px"] = [100, 80]
    (tmp_path / "small" / "calibration.json").write_text(json.dumps(calibration))
    assert "projector is smaller than the code" in refused(PatternError, tmp_path / "small", tmp_path / "out")


def test_a_cancelled_reconstruction_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    calls: list[None] = []

    def cancelled() -> bool:
        calls.append(None)
        return len(calls) > 3

    with pytest.raises(ScanCancelledError):
        reconstruct_bundle(recorded, tmp_path / "out", Listener(cancelled=cancelled), plan=ReconstructionPlan())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("shifts", [(0,), (0, 2, 4, 6), (0, 1, 2, 5)])
def test_some_of_the_line_shifts_make_a_coarser_mesh(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, shifts: tuple[int, ...]
) -> None:
    truthful = prepared_bundle(tmp_path_factory, "whole ball with its truth")

    def some(shot: Shot, capture: Capture) -> Shot | None:
        pattern = capture.patterns[shot.pattern]
        return None if isinstance(pattern, LineShift) and pattern.shift not in shifts else shot

    bundle = changed(truthful, tmp_path / "some", some)
    for name in ("truth.ply", "visible_points.npy"):
        shutil.copy(truthful / name, bundle / name)
    truth = run(bundle, tmp_path / "out")["truth"]
    assert truth["rms_mm"] < 0.05
    assert truth["complete_0.3mm"] > 0.90


def test_truth_is_compared_in_the_world_of_the_calibration_in_use(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    bundle = prepared_bundle(tmp_path_factory, "ball with its truth")
    true = read_calibration(bundle / "calibration.json")
    assert true.projector is not None
    eye = true.cameras["left"]
    # As a rig calibrates itself: the world is its first camera.
    lamp = replace(
        true.projector,
        rotation=true.projector.rotation @ eye.rotation.T,
        translation_mm=true.projector.rotation @ eye.centre_mm + true.projector.translation_mm,
    )
    own = Calibration({"left": replace(eye, rotation=np.eye(3), translation_mm=np.zeros(3))}, lamp)
    write_calibration(tmp_path / "own.json", own)
    found = run(bundle, tmp_path / "out", calibration=tmp_path / "own.json")["truth"]
    assert found["gross_fraction"] == 0
    assert found["rms_mm"] < 0.05
    assert found["complete_0.3mm"] > 0.9


def seen_live(bundle: Path, *, upside_down: bool = False, last_exposure_s: float | None = None) -> LiveScan:
    """What a reconstruction holds that was fed while this bundle was captured."""
    recorded = read_bundle(bundle)
    assert recorded.calibration is not None
    live = LiveScan(CaptureHeader.from_capture(recorded.capture), recorded.calibration)
    *others, last = recorded.capture.shots
    for shot in (*others, replace(last, exposure_s=last_exposure_s or last.exposure_s)):
        live.take(replace(shot, image=shot.image[::-1]) if upside_down else shot)
    live.end(check_capture(recorded.capture))
    return live


def assert_alike(output: Path, report: dict[str, object], read: Read) -> None:
    """A reconstruction came to the same as that of the bundle, but for its seconds."""
    names = [name for name in ("mesh.ply", "points.ply", "preview.png") if (read[0] / name).exists()]
    assert "mesh.ply" in names
    for name in names:
        assert (output / name).read_bytes() == (read[0] / name).read_bytes(), name
    for part in ("notes", "axis", "frames", "evidence", "calibration", "plan", "cameras", "redundancy"):
        assert report[part] == read[1][part], part


def test_frames_taken_live_give_the_bytes_that_the_bundle_gives(recorded: Path, read: Read, tmp_path: Path) -> None:
    live = run(recorded, tmp_path / "live", live=seen_live(recorded))
    assert "wait for frames" in live["stages_s"]
    assert_alike(tmp_path / "live", live, read)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["repeats", "no line frames", "two cameras"])
def test_other_frames_taken_live_do_so_too(
    recorded: Path, tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, change: str
) -> None:
    two = change == "two cameras"
    bundle = read_bundle(prepared_bundle(tmp_path_factory, "ball by two cameras") if two else recorded)
    capture = bundle.capture
    shots = list(capture.shots)
    if change == "repeats":
        shots += [shot for shot in shots if isinstance(capture.patterns[shot.pattern], LineShift)]
    elif change == "no line frames":
        shots = [shot for shot in shots if not isinstance(capture.patterns[shot.pattern], LineShift)]
    write_bundle(tmp_path / "bundle", replace(capture, shots=tuple(shots)), bundle.calibration)
    live = run(tmp_path / "bundle", tmp_path / "live", live=seen_live(tmp_path / "bundle"))
    assert_alike(tmp_path / "live", live, (tmp_path / "read", run(tmp_path / "bundle", tmp_path / "read")))


def test_frames_that_were_judged_as_they_were_captured_are_not_judged_again(
    recorded: Path, read: Read, tmp_path: Path
) -> None:
    (tmp_path / "judged").mkdir()
    told: list[str] = []
    judged = reconstruct_into(
        recorded, tmp_path / "judged", Listener(report=lambda stage, *_: told.append(stage)),
        plan=ReconstructionPlan(), judged=seen_live(recorded).evidence,
    )  # fmt: skip
    # Each stage is entered once, though frames are read one by one between them.
    assert told[0] == "read bundle"
    assert sorted(set(told)) == sorted(told)
    assert "check frames" not in judged["stages_s"]  # type: ignore[operator]
    assert "check frames" in read[1]["stages_s"]
    assert_alike(tmp_path / "judged", dict(judged), read)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["another calibration", "other frames", "two exposures", "an end that never came"])
def test_frames_taken_live_that_are_not_those_of_the_bundle_are_passed_over(
    recorded: Path, tmp_path: Path, what: str
) -> None:
    live = seen_live(recorded, upside_down=True)
    bundle = recorded
    if what == "another calibration":
        shutil.copytree(recorded, tmp_path / "bundle")
        bundle = tmp_path / "bundle"
        path = bundle / "calibration.json"
        described = json.loads(path.read_text())
        described["projector"]["translation_mm"][0] += 0.001
        path.write_text(json.dumps(described))
    elif what == "other frames":
        live.take(read_bundle(recorded).capture.shots[0])
    elif what == "two exposures":
        live = seen_live(recorded, upside_down=True, last_exposure_s=0.5)
    else:
        live.evidence = None
    report = run(bundle, tmp_path / "out", live=live)
    # Upside down there would be hardly anything.
    assert report["mesh"]["points"] > 1000
    assert "check frames" in report["stages_s"]


# Frames are read one after another: the same in whatever order they are listed, and few in memory


@pytest.mark.slow
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
    played = tmp_path / "as played", run(both_axes, tmp_path / "as played")
    other = run(tmp_path / "sorted", tmp_path / "out")
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == (played[0] / "mesh.ply").read_bytes()
    assert other["evidence"] == played[1]["evidence"]


@pytest.mark.slow
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
    header = CaptureHeader.from_capture(bundle.capture)
    stream = ScanStream(header, bundle.calibration, entered=lambda *_: None, axis=Axis.COLUMN)
    held: list[tuple[Axis | None, weakref.ref[Pixels]]] = []
    most = 0
    # Only what comes from now on is looked through below.
    gc.freeze()
    for shot in bundle.capture.shots:
        image = shot.image.copy()
        held.append((getattr(header.patterns[shot.pattern], "axis", None), weakref.ref(image)))
        stream.take(replace(shot, image=image))
        del image
        gc.collect()
        alive = [axis for axis, each in held if each() is not None]
        assert set(alive) <= {Axis.COLUMN, Axis.ROW}
        most = max(most, alive.count(Axis.COLUMN))
    gc.unfreeze()
    # The last of them is used and let go at once.
    assert most == len([axis for axis, _ in held if axis is Axis.COLUMN]) - 1
    # Rows are compared with the stripes of all columns.
    assert {axis for axis, each in held if each() is not None} == {Axis.ROW}
    found = stream.finish()
    assert found[0].curves.stripe_points > 1000
    assert not any(each() is not None for _, each in held)


@pytest.mark.slow
def test_axes_of_two_exposures_wait_for_one_another(both_axes: Path, tmp_path: Path) -> None:
    def exposed(shot: Shot, capture: Capture) -> Shot:
        row = getattr(capture.patterns[shot.pattern], "axis", None) is Axis.ROW
        return replace(shot, exposure_s=0.05 if row else 0.02)

    bundle = changed(both_axes, tmp_path / "bundle", exposed)
    assert run(bundle, tmp_path / "out")["mesh"]["points"] > 1000


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
        assert len(read) <= taken + MAX_READERS + 1
        assert np.array_equal(shot.image, whole.shots[index].image)
        assert (shot.pattern, shot.camera, shot.time_s) == (
            whole.shots[index].pattern, whole.shots[index].camera, whole.shots[index].time_s,
        )  # fmt: skip
    assert len(read) == len(order)


def test_the_outline_has_everything_but_pixels(both_axes: Path) -> None:
    outline, whole = open_bundle(both_axes).outline, read_bundle(both_axes).capture
    assert CaptureHeader.from_capture(outline) == CaptureHeader.from_capture(whole)
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


# ---- Which axis a recording of both is triangulated by: the calibration's, unless what the frames hold says otherwise


# The baseline lies across columns a little more than across rows.
CAMERA: Device = {
    "size_px": (240, 200), "focal_px": (1100.0, 1100.0), "position_mm": (-130.0, -110.0, -560.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.6, "saturation_s": 0.02,
}  # fmt: skip
PROJECTOR: Device = {
    "size_px": (96, 96), "focal_px": (480.0, 480.0), "position_mm": (0.0, 0.0, -600.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.3,
}  # fmt: skip


@pytest.fixture(scope="module")
def slanted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slanted")
    with open_rig(read_rig(rig_file(folder / "rig", BALL, PROJECTOR, CAMERA))) as rig:
        plan = ScanPlan(patterns=PatternPlan(rows=True, line_shift=False, gray_cell_px=1))
        capture_frames(rig, plan, folder / "bundle").finish()
    return folder / "bundle"


def smeared(recorded: Path, folder: Path, axis: Axis, width: int, *, from_px: int = 60) -> Path:
    """A copy whose code of an axis is smeared across its stripes from a column of the image on."""

    def change(shot: Shot, capture: Capture) -> Shot:
        pattern = capture.patterns[shot.pattern]
        if not isinstance(pattern, Gray) or pattern.axis is not axis:
            return shot
        image = cv2.blur(shot.image, (width, 1) if axis is Axis.COLUMN else (1, width))
        image[:, :from_px] = shot.image[:, :from_px]
        return replace(shot, image=np.asarray(image, dtype=shot.image.dtype))

    return changed(recorded, folder, change)


@pytest.mark.slow
def test_the_axis_that_decodes_far_more_is_used_and_told(slanted: Path, tmp_path: Path) -> None:
    walked, _ = measured(slanted, None, None, lambda *_: None, axis=None)
    assert walked.axis is Axis.COLUMN
    assert not any("triangulated by" in note for note in walked.notes)
    worse = smeared(slanted, tmp_path / "worse", Axis.COLUMN, 121)
    walked, found = measured(worse, None, None, lambda *_: None, axis=None)
    assert walked.axis is Axis.ROW
    (note,) = (note for note in walked.notes if note.startswith("triangulated by rows"))
    assert "the columns, which cross the baseline more steeply, decode" in note
    assert len(found.merged.curves.points_mm) > 1000
    asked, _ = measured(worse, None, None, lambda *_: None, axis=Axis.COLUMN)
    assert asked.axis is Axis.COLUMN


@pytest.mark.slow
def test_both_axes_are_tried_and_the_first_kept_where_the_other_is_worse(slanted: Path, tmp_path: Path) -> None:
    worse = smeared(
        smeared(slanted, tmp_path / "worse", Axis.COLUMN, 121), tmp_path / "worst", Axis.ROW, 191, from_px=0
    )
    stages: list[str] = []
    walked, _ = measured(worse, None, None, lambda stage, _fraction, _detail: stages.append(stage), axis=None)
    assert stages.count("triangulate") == 2
    assert walked.axis is Axis.COLUMN


# ---- A scan carries its calibration: which one, how old, and its share of every vertex's standard deviation


BOX = np.array([[-40.0, -40, -40], [40, 40, 40]])


def stating(calibration: Calibration, scale: float = 1.0, solved_at: str = "2026-01-02T03:04:05+00:00") -> Calibration:
    """The calibration with an error of its own: the projector's principal point and place, in px and mm."""
    deviations = np.zeros(30)
    deviations[[15 + 2, 15 + 12, 15 + 14]] = 0.05 * scale, 0.02 * scale, 0.03 * scale
    return replace(calibration, solved=SolveRecord("solve-7", solved_at, np.diag(deviations**2), BOX, 0.0123))


def vertices(path: Path) -> dict[str, NDArray[Any]]:
    data = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    return {name: data[name].ravel() for name in data.dtype.names}


@pytest.fixture(scope="module")
def solved(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Read:
    folder = tmp_path_factory.mktemp("solved")
    write_calibration(folder / "solved.json", stating(read_calibration(recorded / "calibration.json")))
    return folder / "out", run(recorded, folder / "out", calibration=folder / "solved.json")


@pytest.mark.slow
def test_every_vertex_states_its_share(recorded: Path, read: Read, solved: Read) -> None:
    output, report = solved
    for name in ("mesh.ply", "points.ply"):
        before, found = vertices(read[0] / name), vertices(output / name)
        assert [key for key in found if key not in before] == ["sigma_calibration_mm"]
        share = found["sigma_calibration_mm"]
        assert np.isfinite(share).all()
        assert (share > 0).all()
        assert found["sigma_mm"] == pytest.approx(np.hypot(before["sigma_mm"], share), rel=1e-5)
        for key in before:
            # The points themselves are the same.
            assert key == "sigma_mm" or np.array_equal(found[key], before[key], equal_nan=True)
    data = vertices(output / "mesh.ply")
    told = report["calibration"]
    assert read[1]["calibration"]["absent"]
    assert told["id"] == "solve-7"
    assert told["solved_at"] == "2026-01-02T03:04:05+00:00"
    assert told["expected_error_mm"] == 0.0123
    assert told["sigma_share"] == pytest.approx(
        np.median((data["sigma_calibration_mm"] / data["sigma_mm"]) ** 2), rel=1e-4
    )
    assert told["sigma_calibration_mm"] == pytest.approx(np.median(data["sigma_calibration_mm"]), rel=1e-4)
    captured_at = read_description(recorded).captured_at
    assert captured_at is not None
    assert told["age_days"] == pytest.approx(captured_at.timestamp() / 86400 - 1767323045 / 86400, abs=1e-3)
    write_converted(output, "mesh.stl")
    write_converted(read[0], "mesh.stl")
    assert (output / "mesh.stl").read_bytes() == (read[0] / "mesh.stl").read_bytes()


@pytest.mark.parametrize(("of", "error_mm"), [("solve-7", 0.05), ("another", 0.0123)])
def test_the_report_has_the_expected_error_as_it_was_then(
    of: str, error_mm: float, recorded: Path, tmp_path: Path
) -> None:
    shutil.copyfile(recorded / "bundle.json", tmp_path / "bundle.json")
    write_health(tmp_path, {"calibration": of, "expected_error_mm": 0.05})
    calibration = stating(read_calibration(recorded / "calibration.json"))
    told = calibration_report(calibration, tmp_path, np.ones(3, dtype=np.float32), np.ones(3))
    assert told["expected_error_mm"] == error_mm


def test_a_calibration_that_says_nothing_of_its_error_has_an_id_and_words(recorded: Path) -> None:
    calibration = read_calibration(recorded / "calibration.json")
    told = calibration_report(calibration, recorded, np.ones(3, dtype=np.float32), None)
    assert told.pop("id") == calibration.digest
    assert "says nothing of its own error" in str(told.pop("absent"))
    assert told == dict.fromkeys(("solved_at", "age_days", "expected_error_mm", "sigma_share"))


@pytest.mark.parametrize(
    ("solved_at", "words"),
    [
        ("2026-01-02T03:04:05", "without the offset from UTC"),
        ("last week", "says 'last week' where the date of its solve should be"),
    ],
)
def test_an_age_that_is_not_known_is_null_with_the_reason(recorded: Path, solved_at: str, words: str) -> None:
    calibration = stating(read_calibration(recorded / "calibration.json"), solved_at=solved_at)
    told = calibration_report(calibration, recorded, np.ones(3, dtype=np.float32), np.full(3, 0.5))
    assert told["age_days"] is None
    assert words in str(told["age_absent"])
    assert told["sigma_share"] == 0.25


def test_a_bundle_that_does_not_say_when_it_was_captured(recorded: Path, tmp_path: Path) -> None:
    bundle = read_bundle(recorded)
    capture = bundle.capture
    with BundleWriter(tmp_path / "old", capture.projector, capture.patterns, capture.cameras) as writer:
        writer.add(capture.shots[0])
    assert "captured_at" not in (tmp_path / "old" / "bundle.json").read_text()
    calibration = stating(read_calibration(recorded / "calibration.json"))
    told = calibration_report(calibration, tmp_path / "old", np.ones(3, dtype=np.float32), np.full(3, np.nan))
    assert told["age_absent"] == "the bundle does not say when it was captured"
    assert told["sigma_share"] is None


def test_a_time_of_capture_without_offset_is_refused(recorded: Path, tmp_path: Path) -> None:
    data = json.loads((recorded / "bundle.json").read_text())
    (tmp_path / "bundle.json").write_text(json.dumps({**data, "captured_at": "2026-11-22T06:00:00"}))
    with pytest.raises(BundleError, match="captured_at"):
        read_description(tmp_path)

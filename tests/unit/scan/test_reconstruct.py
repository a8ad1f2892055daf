"""What the walk refuses, and that it leaves nothing behind when it does."""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.bundle.notes import write_notes
from slrig.bundle.stage import StageAngle, write_stage
from slrig.capture.evidence import EvidenceSummary, check_capture
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
from slrig.jobs.versions import versions
from slrig.model import Axis, Calibration, Capture, Gray, LineShift, Refusal, Shot, Size, White
from slrig.model.header import CaptureHeader
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle, reconstruct_into
from slrig.scan.stream import LiveScan

RIG = Path(__file__).parents[3] / "config" / "rigs" / "sphere.toml"


@pytest.fixture(scope="module")
def truthful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("truthful") / "bundle"
    with open_rig(read_rig(RIG)) as rig:
        capture_frames(rig, ScanPlan(), folder, progress=lambda *_: None, cancelled=lambda: False).finish()
    return folder


@pytest.fixture(scope="module")
def recorded(truthful: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without its truth: to compare with it takes longer than all the rest."""
    folder = tmp_path_factory.mktemp("recorded") / "bundle"
    shutil.copytree(truthful, folder, ignore=shutil.ignore_patterns("truth*", "visible_points.npy"))
    return folder


def run(bundle: Path, output: Path, **options: object) -> dict[str, object]:
    plan = ReconstructionPlan(**options)  # type: ignore[arg-type]
    return reconstruct_bundle(bundle, output, plan=plan, progress=lambda *_: None, cancelled=lambda: False)


def test_an_axis_that_was_not_played_is_named(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(PatternError, match="no Gray-code frames of the row axis"):
        run(recorded, tmp_path / "out", axis=Axis.ROW)


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


def test_a_scan_of_the_rendered_rig_is_a_mesh_with_its_files(recorded: Path, tmp_path: Path) -> None:
    report = run(recorded, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"mesh.ply", "mesh.glb", "points.ply", "report.json", "preview.png"} <= names
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    for camera, told in written["cameras"].items():
        causes = cv2.imread(str(tmp_path / "out" / f"causes-{camera}.png"), cv2.IMREAD_UNCHANGED)
        assert causes is not None
        assert causes.shape == tuple(reversed(written["frames"]["cameras_px"][camera]))
        counts = np.bincount(causes.ravel(), minlength=len(written["causes"]))
        named = {each["name"]: int(count) for each, count in zip(written["causes"], counts, strict=True)}
        assert named.pop("none") > 0
        assert named == told["refused_pixels"]
        picture = cv2.imread(str(tmp_path / "out" / f"rejected-{camera}.png"))
        assert picture is not None
        width, height = told["rejected_png_px"]
        row, column = (each[len(each) // 2] for each in np.nonzero(causes == Refusal.NOT_LIT))
        at = (int((row + 0.5) / causes.shape[0] * height), int((column + 0.5) / causes.shape[1] * width))
        assert tuple(picture[at]) == (30, 26, 24)
    assert written["mesh"]["initial"] == report["mesh"]["initial"]  # type: ignore[index]
    assert written["computed"] == {"where": "local", "host": platform.node(), "versions": dict(versions())}
    initial = written["mesh"]["initial"]
    assert initial["triangles"] == initial["strip_triangles"] - initial["dropped_triangles"]


@pytest.mark.slow
def test_results_of_an_earlier_run_are_replaced_and_other_folders_are_not(recorded: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(recorded, tmp_path / "bundle")
    assert "stage" not in run(bundle, tmp_path / "out")
    # What the bundle says of the stage is said by every reconstruction of it.
    write_stage(bundle, StageAngle(angle_deg=45.0, turned_by="hand"))
    run(bundle, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["stage"] == {"angle_deg": 45.0, "turned_by": "hand"}
    other = tmp_path / "holiday"
    other.mkdir()
    (other / "picture.jpg").write_bytes(b"not ours")
    with pytest.raises(InvalidInputError, match="name a new folder"):
        run(recorded, other)
    assert [path.name for path in other.iterdir()] == ["picture.jpg"]


@pytest.mark.slow
def test_holes_are_kept_on_request(recorded: Path, tmp_path: Path) -> None:
    filled = run(recorded, tmp_path / "filled")["mesh"]["initial"]  # type: ignore[index]
    kept = run(recorded, tmp_path / "kept", keep_holes=True)["mesh"]["initial"]  # type: ignore[index]
    assert kept["strip_triangles"] == filled["strip_triangles"]
    assert filled["dropped_at_bridges"] == 0
    assert kept["triangles"] <= filled["triangles"]


def test_a_missing_calibration_is_asked_for(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded, tmp_path / "bundle")
    (tmp_path / "bundle" / "calibration.json").unlink()
    message = refused(CalibrationError, tmp_path / "bundle", tmp_path / "out")
    assert "calibration.json" in message
    assert "calibration (--calibration)" in message


def test_one_camera_without_a_calibrated_projector_is_refused(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded, tmp_path / "bundle")
    path = tmp_path / "bundle" / "calibration.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"projector": None}))
    words = refused(CalibrationError, tmp_path / "bundle", tmp_path / "out")
    assert "alone, without a projector: it tells no depth, and cannot scan; calibrate the camera together with" in words


@pytest.mark.parametrize("level", [0, 255])
def test_frames_of_one_level_are_refused_with_their_figures(recorded: Path, tmp_path: Path, level: int) -> None:
    def flat(shot: Shot, capture: Capture) -> Shot:
        value = level * capture.cameras[shot.camera].full_scale // 255
        return replace(shot, image=np.full_like(shot.image, value))

    bundle = changed(recorded, tmp_path / "flat", flat)
    message = refused(NothingToReconstructError, bundle, tmp_path / "out")
    assert "no pixel could be decoded" in message
    assert "lens cap" in message
    assert str(bundle) in message


def test_lines_that_were_never_shown_are_made_up_for_by_code_edges_and_told(recorded: Path, tmp_path: Path) -> None:
    dark = {shot.camera: shot.image for shot in read_bundle(recorded).capture.shots if shot.pattern == 1}

    def no_lines(shot: Shot, capture: Capture) -> Shot:
        is_line = isinstance(capture.patterns[shot.pattern], LineShift)
        return replace(shot, image=dark[shot.camera]) if is_line else shot

    bundle = changed(recorded, tmp_path / "no-lines", no_lines)
    write_notes(bundle, ["what its capture told"])
    report = run(bundle, tmp_path / "out")
    assert report["notes"][0] == "what its capture told"  # type: ignore[index]
    assert any("does not resolve the shifted lines on 100%" in note for note in report["notes"])  # type: ignore[attr-defined]
    assert all(camera["lit_without_lines"] > 0.99 for camera in report["cameras"].values())  # type: ignore[attr-defined]


def test_a_missing_bit_is_named(recorded: Path, tmp_path: Path) -> None:
    def without_bit_two(shot: Shot, capture: Capture) -> Shot | None:
        pattern = capture.patterns[shot.pattern]
        return None if isinstance(pattern, Gray) and pattern.bit == 2 else shot

    bundle = changed(recorded, tmp_path / "missing", without_bit_two)
    assert "bits [2]" in refused(PatternError, bundle, tmp_path / "out")


@pytest.mark.slow
def test_without_white_and_black_the_inverses_do(recorded: Path, tmp_path: Path) -> None:
    def no_pair(shot: Shot, capture: Capture) -> Shot | None:
        return None if capture.patterns[shot.pattern].kind in ("white", "black") else shot

    report = run(changed(recorded, tmp_path / "no-pair", no_pair), tmp_path / "out")
    assert report["mesh"]["points"] > 1000  # type: ignore[index]


def test_nothing_tells_lit_from_dark_without_white_black_and_inverses(recorded: Path, tmp_path: Path) -> None:
    def bare(shot: Shot, capture: Capture) -> Shot | None:
        pattern = capture.patterns[shot.pattern]
        dropped = isinstance(pattern, White) or (isinstance(pattern, Gray) and pattern.inverted)
        return None if dropped else shot

    bundle = changed(recorded, tmp_path / "bare", bare)
    assert "nothing tells lit from dark" in refused(PatternError, bundle, tmp_path / "out")


def test_a_projector_smaller_than_the_code_is_refused(recorded: Path, tmp_path: Path) -> None:
    bundle = read_bundle(recorded)
    small = replace(bundle.capture, projector=Size(100, 80))
    write_bundle(tmp_path / "small", small, None)
    calibration = json.loads((recorded / "calibration.json").read_text())
    calibration["projector"]["size_px"] = [100, 80]
    (tmp_path / "small" / "calibration.json").write_text(json.dumps(calibration))
    assert "projector is smaller than the code" in refused(PatternError, tmp_path / "small", tmp_path / "out")


def test_a_missing_frame_file_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded, tmp_path / "bundle")
    next((tmp_path / "bundle" / "frames").rglob("*.*")).unlink()
    refused(BundleError, tmp_path / "bundle", tmp_path / "out")


def test_a_cancelled_reconstruction_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    calls: list[None] = []

    def cancelled() -> bool:
        calls.append(None)
        return len(calls) > 3

    with pytest.raises(ScanCancelledError):
        reconstruct_bundle(
            recorded, tmp_path / "out", plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=cancelled
        )
    assert list(tmp_path.iterdir()) == []


def test_a_cancelled_capture_leaves_nothing(tmp_path: Path) -> None:
    with open_rig(read_rig(RIG)) as rig, pytest.raises(ScanCancelledError):
        capture_frames(rig, ScanPlan(), tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: True).finish()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def both_axes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Columns and rows, by a rig whose camera stands above its projector."""
    folder = tmp_path_factory.mktemp("both")
    text = RIG.read_text()
    for old, new in (
        ("[-150.0, -12.0, -560.0]", "[5.0, -160.0, -560.0]"),
        ("[105.0, -10.0, -590.0]", "[0.0, 90.0, -590.0]"),
        ("../scenes", str(RIG.parents[1] / "scenes")),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "rig.toml").write_text(text)
    with open_rig(read_rig(folder / "rig.toml")) as rig:
        plan = ScanPlan(PatternPlan(rows=True))
        capture_frames(rig, plan, folder / "bundle", progress=lambda *_: None, cancelled=lambda: False).finish()
    for name in ("truth.ply", "visible_points.npy"):
        assert (folder / "bundle" / name).exists()
    return folder / "bundle"


@pytest.mark.slow
def test_the_axis_that_the_camera_stands_beside_is_used(both_axes: Path, tmp_path: Path) -> None:
    report = run(both_axes, tmp_path / "out")
    assert report["axis"] == "row"
    assert report["truth"]["rms_mm"] < 0.05  # type: ignore[index]
    assert report["truth"]["complete_0.3mm"] > 0.90  # type: ignore[index]


@pytest.mark.slow
def test_rows_alone_are_enough(both_axes: Path, tmp_path: Path) -> None:
    def rows(shot: Shot, capture: Capture) -> Shot | None:
        return shot if getattr(capture.patterns[shot.pattern], "axis", Axis.ROW) is Axis.ROW else None

    bundle = changed(both_axes, tmp_path / "rows", rows)
    for name in ("truth.ply", "visible_points.npy"):
        shutil.copy(both_axes / name, bundle / name)
    report = run(bundle, tmp_path / "out")
    assert report["axis"] == "row"
    assert report["truth"]["rms_mm"] < 0.05  # type: ignore[index]


@pytest.mark.slow
@pytest.mark.parametrize("shifts", [(0,), (0, 2, 4, 6), (0, 1, 2, 5)])
def test_some_of_the_line_shifts_make_a_coarser_mesh(truthful: Path, tmp_path: Path, shifts: tuple[int, ...]) -> None:
    def some(shot: Shot, capture: Capture) -> Shot | None:
        pattern = capture.patterns[shot.pattern]
        return None if isinstance(pattern, LineShift) and pattern.shift not in shifts else shot

    bundle = changed(truthful, tmp_path / "some", some)
    for name in ("truth.ply", "visible_points.npy"):
        shutil.copy(truthful / name, bundle / name)
    truth = run(bundle, tmp_path / "out")["truth"]
    assert truth["rms_mm"] < 0.05  # type: ignore[index]
    assert truth["complete_0.3mm"] > 0.90  # type: ignore[index]


def seen_live(bundle: Path, *, upside_down: bool = False, last_exposure_s: float | None = None) -> LiveScan:
    """What a reconstruction holds that was fed while this bundle was captured."""
    recorded = read_bundle(bundle)
    assert recorded.calibration is not None
    live = LiveScan(CaptureHeader.of(recorded.capture), recorded.calibration)
    *others, last = recorded.capture.shots
    for shot in (*others, replace(last, exposure_s=last_exposure_s or last.exposure_s)):
        live.take(replace(shot, image=shot.image[::-1]) if upside_down else shot)
    live.end(check_capture(recorded.capture))
    return live


def reports_alike(one: dict[str, object], other: dict[str, object]) -> bool:
    """Whether two reports differ in seconds only."""
    parts = ("notes", "axis", "frames", "evidence", "calibration", "plan", "cameras", "redundancy")
    return all(one[part] == other[part] for part in parts)


@pytest.mark.parametrize(
    "change",
    ["none", *(pytest.param(each, marks=pytest.mark.slow) for each in ("repeats", "a bracket", "no line frames"))],
)
def test_frames_taken_live_give_the_bytes_that_the_bundle_gives(recorded: Path, tmp_path: Path, change: str) -> None:
    bundle = read_bundle(recorded)
    capture = bundle.capture
    shots = list(capture.shots)
    if change == "repeats":
        shots += [shot for shot in shots if isinstance(capture.patterns[shot.pattern], LineShift)]
    elif change == "a bracket":
        shots = [replace(shot, exposure_s=exposure_s) for exposure_s in (0.01, 0.02) for shot in shots]
    elif change == "no line frames":
        shots = [shot for shot in shots if not isinstance(capture.patterns[shot.pattern], LineShift)]
    write_bundle(tmp_path / "bundle", replace(capture, shots=tuple(shots)), bundle.calibration)
    plan = ReconstructionPlan()
    live = reconstruct_bundle(
        tmp_path / "bundle", tmp_path / "live", plan=plan, progress=lambda *_: None, cancelled=lambda: False,
        live=seen_live(tmp_path / "bundle"),
    )  # fmt: skip
    assert "wait for frames" in live["stages_s"]  # type: ignore[operator]
    read = run(tmp_path / "bundle", tmp_path / "read")
    for name in ("mesh.ply", "points.ply", "preview.png", "rejected-camera.png"):
        path = tmp_path / "live" / name
        assert not path.exists() or path.read_bytes() == (tmp_path / "read" / name).read_bytes()
    assert (tmp_path / "live" / "mesh.ply").exists()
    assert reports_alike(live, read)


def test_frames_that_were_judged_as_they_were_captured_are_not_judged_again(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "judged").mkdir()
    told: list[str] = []
    judged = reconstruct_into(
        recorded, tmp_path / "judged", plan=ReconstructionPlan(), progress=lambda stage, *_: told.append(stage),
        cancelled=lambda: False, judged=seen_live(recorded).evidence,
    )  # fmt: skip
    read = run(recorded, tmp_path / "read")
    # Each stage is entered once, though frames are read one by one between them.
    assert told[0] == "read bundle"
    assert sorted(set(told)) == sorted(told)
    assert "check frames" not in judged["stages_s"]  # type: ignore[operator]
    assert "check frames" in read["stages_s"]  # type: ignore[operator]
    assert reports_alike(judged, read)
    assert (tmp_path / "judged" / "mesh.ply").read_bytes() == (tmp_path / "read" / "mesh.ply").read_bytes()


@pytest.mark.slow
def test_two_cameras_taken_live_give_the_bytes_that_the_bundle_gives(tmp_path: Path) -> None:
    with open_rig(read_rig(RIG.with_name("two_cameras.toml"))) as rig:
        capture_frames(rig, ScanPlan(), tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: False).finish()
    live = reconstruct_bundle(
        tmp_path / "bundle", tmp_path / "live", plan=ReconstructionPlan(), progress=lambda *_: None,
        cancelled=lambda: False, live=seen_live(tmp_path / "bundle"),
    )  # fmt: skip
    read = run(tmp_path / "bundle", tmp_path / "read")
    assert (tmp_path / "live" / "mesh.ply").read_bytes() == (tmp_path / "read" / "mesh.ply").read_bytes()
    assert reports_alike(live, read)


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
    report = reconstruct_bundle(
        bundle, tmp_path / "out", plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False,
        live=live,
    )  # fmt: skip
    # Upside down there would be hardly anything.
    assert report["mesh"]["points"] > 1000  # type: ignore[index]
    assert "check frames" in report["stages_s"]  # type: ignore[operator]


def test_capture_shows_each_frame_that_it_records(tmp_path: Path) -> None:
    class Sink:
        def __init__(self) -> None:
            self.told: list[object] = []

        def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
            self.told += [header, calibration]

        def take(self, shot: Shot) -> None:
            self.told.append(shot)

        def end(self, evidence: EvidenceSummary) -> None:
            self.told.append(evidence)

    sink = Sink()
    with open_rig(read_rig(RIG)) as rig:
        calibration = rig.calibration
        capture_frames(
            rig, ScanPlan(), tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: False, frames=sink
        ).finish()
    written = read_bundle(tmp_path / "bundle").capture
    header, known, *shots, evidence = sink.told
    assert header == CaptureHeader.of(written)
    assert known is calibration
    assert evidence == check_capture(written)
    for shot, again in zip(shots, written.shots, strict=True):
        assert isinstance(shot, Shot)
        assert (shot.pattern, shot.camera, shot.exposure_s) == (again.pattern, again.camera, again.exposure_s)
        np.testing.assert_array_equal(shot.image, again.image)

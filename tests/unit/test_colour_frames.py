"""White and black in colour: from a camera into a bundle, out of it again, and up to where a mesh is made."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.replay import ReplayHead
from slrig.bundle import read_bundle, read_capture, write_bundle
from slrig.bundle.reading import open_bundle
from slrig.devices import ProjectorInfo
from slrig.errors import BundleError, UnsupportedByDeviceError
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    Gray,
    NoiseModel,
    PatternSequence,
    Pixels,
    Primary,
    Shot,
    Size,
    White,
)
from slrig.model.capture import CaptureHeader
from slrig.patterns.sequence import encode
from slrig.reconstruction.fusion import FusedFrames, fuse_colour
from slrig.scan.plan import ScanPlan, in_colour
from slrig.scan.stream import CameraResult, ScanStream
from tests.samples import CAMERA, noise, sample_calibration, sample_capture
from tests.unit.capture.fake_rig import CameraFaults, FakeRig, fake_rig
from tests.unit.scan.test_acquisition import Sink, captured

ENDS = White | Black
PROJECTOR = ProjectorInfo("projector", "plain", "1", Size(64, 48), plays=False, latency_s=0.0)


def is_end(capture: Capture, shot: Shot) -> bool:
    return isinstance(capture.patterns[shot.pattern], ENDS)


def coloured_capture(bit_depth: int = 8) -> Capture:
    """The sample, its white and black frames of the left camera in colour."""
    capture, form = sample_capture(bit_depth=bit_depth), CameraFormat(CAMERA, bit_depth)
    colour = np.dstack([noise(form, seed) for seed in (1, 2, 3)])
    shots = tuple(
        replace(shot, colour=colour) if shot.camera == "left" and is_end(capture, shot) else shot
        for shot in capture.shots
    )
    return replace(capture, shots=shots)


@pytest.mark.parametrize("bit_depth", [8, 12])
def test_colour_comes_back_and_grey_files_stay_as_they_are(tmp_path: Path, bit_depth: int) -> None:
    write_bundle(tmp_path / "grey", sample_capture(bit_depth=bit_depth))
    write_bundle(tmp_path / "colour", capture := coloured_capture(bit_depth))
    for file in (tmp_path / "grey").rglob("*.png"):
        assert (tmp_path / "colour" / file.relative_to(tmp_path / "grey")).read_bytes() == file.read_bytes()
    read = read_bundle(tmp_path / "colour").capture
    for got, want in zip(read.shots, capture.shots, strict=True):
        np.testing.assert_array_equal(got.image, want.image)
        assert (got.colour is None) == (want.colour is None)
        if got.colour is not None and want.colour is not None:
            np.testing.assert_array_equal(got.colour, want.colour)
            assert got.colour.dtype == got.image.dtype
    # What a calibration is solved from does not take it.
    assert all(shot.colour is None for shot in read_capture(tmp_path / "colour").shots)


def with_entry(folder: Path, **keys: object) -> Path:
    """The bundle in a folder, its first frame's entry with these keys."""
    path = folder / "bundle.json"
    data = json.loads(path.read_text())
    data["frames"][0] |= keys
    path.write_text(json.dumps(data))
    return folder


@pytest.mark.parametrize("file", ["../secret.png", "/etc/passwd", "a\\b.png", ""])
def test_a_colour_file_lies_inside_the_bundle(tmp_path: Path, file: str) -> None:
    write_bundle(tmp_path / "scan", sample_capture())
    with pytest.raises(BundleError, match=r"frames\[0\]\.colour_file: expected a path inside the bundle"):
        read_bundle(with_entry(tmp_path / "scan", colour_file=file))


def test_a_colour_file_that_is_a_link_out_of_the_bundle_is_refused(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", coloured_capture())
    path = tmp_path / "scan" / "frames" / "left" / "000-colour.png"
    path.rename(tmp_path / "outside.png")
    path.symlink_to(tmp_path / "outside.png")
    with pytest.raises(BundleError, match="a link that leads out"):
        read_bundle(tmp_path / "scan")


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (noise(CameraFormat(CAMERA, 8), 0), "expected a colour image"),
        (np.zeros((4, 5, 3), np.uint8), "expected 40 x 30 pixels"),
        (np.zeros((*CAMERA.shape, 3), np.uint16), "expected 8-bit samples"),
        (None, "expected a frame file"),
    ],
)
def test_a_colour_file_that_is_no_such_picture_is_refused(tmp_path: Path, image: Pixels | None, told: str) -> None:
    write_bundle(tmp_path / "scan", sample_capture())
    if image is not None:
        assert cv2.imwrite(str(tmp_path / "scan" / "c.png"), image)
    with pytest.raises(BundleError, match=told):
        read_bundle(with_entry(tmp_path / "scan", colour_file="c.png"))


def test_frames_from_elsewhere_that_are_in_colour_keep_it_of_white_and_black_alone(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", capture := coloured_capture())
    rng = np.random.default_rng(5)
    # A camera of 7 bits whose colours do not all fit: their grey does, as before.
    path = tmp_path / "scan" / "bundle.json"
    data = json.loads(path.read_text())
    data["cameras"]["right"]["bit_depth"] = 7
    for entry in data["frames"]:
        entry.pop("colour_file", None)
        picture = rng.integers(0, 127, (*CAMERA.shape, 3), dtype=np.uint8)
        picture[0, 0, 0] = 255 if entry["camera"] == "right" else 0
        picture[0, 0, 1:] = 0
        assert cv2.imwrite(str(tmp_path / "scan" / entry["file"]), picture)
    path.write_text(json.dumps(data))
    for shot in read_bundle(tmp_path / "scan").capture.shots:
        assert (shot.colour is not None) == (shot.camera == "left" and is_end(capture, shot))
        if shot.colour is not None:
            np.testing.assert_array_equal(cv2.cvtColor(shot.colour, cv2.COLOR_BGR2GRAY), shot.image)


def test_a_writer_refuses_colour_of_another_type_or_beyond_full_scale(tmp_path: Path) -> None:
    shot = coloured_capture(12).shots[0]
    assert shot.colour is not None
    for wrong in (shot.colour.astype(np.uint8), np.full_like(shot.colour, 5000)):
        capture = replace(sample_capture(bit_depth=12), shots=(replace(shot, colour=wrong),))
        with pytest.raises(BundleError, match="expected 40 x 30 uint16 samples up to 4095"):
            write_bundle(tmp_path / "scan", capture)
    with pytest.raises(ValueError, match=r"Shot\.colour"):
        replace(shot, colour=shot.colour[..., :2])


def coloured_rig(**faults: Any) -> FakeRig:
    """A rig whose left camera has colour."""
    fake = fake_rig(faults={"left": CameraFaults(**faults)})
    fake.cameras["left"].coloured = 0
    return fake


@pytest.mark.slow
def test_a_scan_keeps_colour_of_white_and_black_where_a_camera_has_it_and_makes_no_other(tmp_path: Path) -> None:
    captured(fake := coloured_rig(), tmp_path / "bundle", sink := Sink())
    capture = read_bundle(tmp_path / "bundle").capture
    for shots in (sink.shots, capture.shots):
        assert sum(shot.colour is not None for shot in shots) == fake.cameras["left"].coloured == 3
        for shot in shots:
            assert (shot.colour is not None) == (shot.camera == "left" and is_end(capture, shot))
            if shot.colour is not None:
                np.testing.assert_array_equal(shot.colour[..., 1], shot.image)


@pytest.mark.slow
def test_colour_of_a_refused_frame_is_not_kept(tmp_path: Path) -> None:
    captured(coloured_rig(garbled=frozenset({0})), tmp_path / "bundle")
    assert [path.name for path in (tmp_path / "bundle" / "refused").glob("*colour*")] == []
    listed = {each.colour_file for each in open_bundle(tmp_path / "bundle")._description.frames} - {None}
    there = {str(path.relative_to(tmp_path / "bundle")) for path in (tmp_path / "bundle").rglob("*-colour.png")}
    assert there == listed
    assert len(listed) == 3


def test_colour_is_left_out_or_refused_by_the_plan(tmp_path: Path) -> None:
    captured(fake := coloured_rig(), tmp_path / "grey", plan=ScanPlan(colour=False))
    assert fake.cameras["left"].coloured == 0
    assert not list((tmp_path / "grey").rglob("*-colour.png"))
    with pytest.raises(UnsupportedByDeviceError, match=r"colour \(--colour\): asked for, and camera 'right' has none"):
        captured(coloured_rig(), tmp_path / "refused", plan=ScanPlan(colour=True))
    assert not (tmp_path / "refused").exists()
    infos = {name: camera.info for name, camera in coloured_rig().cameras.items() if name == "left"}
    assert in_colour(ScanPlan(colour=True), infos, PROJECTOR) == {"left"}


def test_coloured_light_is_refused_in_words_before_there_is_any(tmp_path: Path) -> None:
    asked = ScanPlan(coloured_light=True)
    with pytest.raises(UnsupportedByDeviceError, match=r"coloured_light \(--coloured-light\): .* no lights of its own"):
        captured(fake := fake_rig(), tmp_path / "refused", plan=asked)
    assert fake.projector.shows == 0
    assert not (tmp_path / "refused").exists()
    cameras = {name: camera.info for name, camera in coloured_rig().cameras.items()}
    lit = replace(PROJECTOR, lights=True)
    assert in_colour(asked, cameras, lit) == {"left"}
    with pytest.raises(UnsupportedByDeviceError, match="every camera has colour already"):
        in_colour(asked, {"left": cameras["left"]}, lit)
    assert in_colour(replace(asked, colour=False), {"left": cameras["left"]}, lit) == set()


def test_a_recording_in_coloured_light_is_replayed_and_its_patterns_have_names(tmp_path: Path) -> None:
    whole = replace(capture := coloured_capture(), patterns=(*capture.patterns, Primary("green")))
    shot = replace(whole.shots[0], pattern=len(capture.patterns), colour=None)
    write_bundle(tmp_path / "lit", replace(whole, shots=(*whole.shots, shot)))
    listed = json.loads((tmp_path / "lit" / "bundle.json").read_text())["patterns"]
    assert listed[-1] == {"colour": "green", "kind": "primary"}
    assert read_bundle(tmp_path / "lit").capture.patterns == whole.patterns
    assert ReplayHead(read_bundle(tmp_path / "lit")).projector.info.lights
    write_bundle(tmp_path / "grey", capture)
    assert not ReplayHead(read_bundle(tmp_path / "grey")).projector.info.lights


def sequence_of(fake: FakeRig) -> PatternSequence:
    bits = [Gray(Axis.COLUMN, bit, 5, cell_px=4, inverted=inverted) for bit in range(5) for inverted in (False, True)]
    return encode((White(), Black(), *bits), fake.projector.size)


@pytest.mark.parametrize("exposures_s", [pytest.param((None,), marks=pytest.mark.slow), (0.01, 0.0401, 0.04)])
def test_white_and_black_in_colour_reach_the_place_where_a_mesh_is_made(exposures_s: tuple[float | None, ...]) -> None:
    fake = fake_rig(noise_dn=0.5)
    scene, sequence = fake.cameras["left"].scene, sequence_of(fake)
    hue = np.array([0.5, 1.0, 0.25])
    shots = []
    for exposure_s in exposures_s:
        for index, profile in enumerate(sequence.profiles):
            image = scene.image(profile)
            # A bracket's short exposure clips nothing, and has a quarter of the light.
            grey = (image // 4 if exposure_s == 0.01 else image).astype(np.uint8)
            colour = np.rint(grey[..., None] * hue).astype(np.uint8) if index < 2 else None
            shots.append(Shot(index, "left", grey, exposure_s, colour=colour))
    capture = Capture(sequence.projector, sequence.patterns, {"left": scene.format}, tuple(shots))
    devices = sample_calibration()
    calibration = replace(devices, cameras={"left": replace(devices.cameras["left"], size=scene.camera)})

    def streamed(shots: Iterable[Shot]) -> CameraResult:
        stream = ScanStream(
            CaptureHeader.from_capture(capture), calibration, entered=lambda *_: None, axis=Axis.COLUMN,
            one_exposure=len(exposures_s) == 1,
        )  # fmt: skip
        for shot in shots:
            stream.take(shot)
        [seen] = stream.finish()
        return seen

    seen, mono = streamed(capture.shots), streamed(replace(shot, colour=None) for shot in capture.shots)
    white, black = (scene.image(sequence.profiles[index]).astype(np.float64) for index in range(2))
    assert seen.contrast.shape == (*scene.camera.shape, 3)
    # Red, green and blue, as colours are written.
    assert np.abs(seen.contrast - (white - black)[..., None] * hue[::-1]).mean() < 1.5
    assert mono.contrast.shape == (*scene.camera.shape, 1)
    np.testing.assert_array_equal(mono.white, seen.white)
    np.testing.assert_array_equal(mono.curves.refusal, seen.curves.refusal)


def fused(light: list[float]) -> FusedFrames:
    """Of a bracket, what fusing colour asks for."""
    none: Any = None
    return FusedFrames(none, NoiseModel(1.0, 0.0), np.array(light), np.array(light), none)


def test_a_channel_that_the_longest_exposure_clips_comes_from_the_others() -> None:
    # Light of the longest exposure's units: blue everywhere within scale, green beyond the longest, red beyond both.
    light: NDArray[np.float64] = np.array([[[100.0, 400.0, 4000.0]]])
    frames = [[np.clip(light * share, 0, 255).astype(np.uint8)] for share in (1.0, 0.25)]
    np.testing.assert_allclose(fuse_colour(frames, fused([1.0, 0.25]), 255.0), [[[100.0, 400.0, 255 * 4.0]]])

"""Scan bundles: what is written comes back, whole or not at all, and other people's bundles can be read."""

from __future__ import annotations

import json
import resource
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from slrig.bundle import (
    BundleWriter,
    read_bundle,
    read_truth,
    write_bundle,
    write_calibration,
    write_truth,
)
from slrig.errors import BundleError, ScanCancelledError, StorageError
from slrig.model import CameraFormat, CameraTruth, Capture, Gray, LineShift, Shot, Surface, Truth
from tests.samples import CAMERA, noise, pinhole, sample_calibration, sample_capture


@contextmanager
def _disk_that_refuses_more_than(most_bytes: int) -> Iterator[None]:
    """Let the kernel refuse to let a file of this process grow beyond `most_bytes`."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def _writer(folder: Path, capture: Capture) -> BundleWriter:
    return BundleWriter(folder, capture.projector, capture.patterns, capture.cameras, sample_calibration())


def _write_all(folder: Path, capture: Capture, shots: Iterable[Shot]) -> None:
    with _writer(folder, capture) as writer:
        for shot in shots:
            writer.add(shot)


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_a_bundle_comes_back(tmp_path: Path, bit_depth: int) -> None:
    capture = sample_capture(bit_depth=bit_depth)
    write_bundle(tmp_path / "scan", capture, sample_calibration())
    read = read_bundle(tmp_path / "scan")
    assert read.folder == tmp_path / "scan"
    assert read.capture.patterns == capture.patterns
    for got, want in zip(read.capture.shots, capture.shots, strict=True):
        assert got.image.dtype == want.image.dtype
        np.testing.assert_array_equal(got.image, want.image)
    assert read.calibration is not None
    np.testing.assert_array_equal(read.calibration.cameras["left"].matrix, pinhole().matrix)


def test_frames_are_on_disk_as_they_come(tmp_path: Path) -> None:
    capture = sample_capture()
    with _writer(tmp_path / "scan", capture) as writer:
        for count, shot in enumerate(capture.shots, start=1):
            writer.add(shot)
            assert len(list(tmp_path.rglob("*.png"))) == count
        assert not (tmp_path / "scan").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]


def test_an_error_leaves_nothing(tmp_path: Path) -> None:
    capture = sample_capture()

    def cancelled() -> Iterator[Shot]:
        yield capture.shots[0]
        message = "stop"
        raise ScanCancelledError(message)

    with pytest.raises(ScanCancelledError):
        _write_all(tmp_path / "scan", capture, cancelled())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("most_bytes", [500, 1800])
def test_a_full_disk_leaves_nothing(tmp_path: Path, most_bytes: int) -> None:
    # A frame has some 1300 bytes and bundle.json more than 1800: the limit is met in a frame, or at the very end.
    capture = sample_capture()
    with pytest.raises(StorageError, match="the disk refused"), _disk_that_refuses_more_than(most_bytes):
        write_bundle(tmp_path / "scan", capture)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    write_calibration(path, sample_calibration())
    before = path.read_bytes()
    with (
        pytest.raises(StorageError, match=r"calibration\.json: the disk refused.*free some space"),
        _disk_that_refuses_more_than(100),
    ):
        write_calibration(path, sample_calibration(cameras=("other",)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(StorageError, match=r"file/scan: the disk refused"):
        write_bundle(tmp_path / "file" / "scan", sample_capture())


def test_a_bundle_is_never_overwritten(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", sample_capture())
    before = (tmp_path / "scan/bundle.json").read_bytes()
    with pytest.raises(BundleError, match="one that exists"):
        write_bundle(tmp_path / "scan", sample_capture(cameras=("left",)))
    assert (tmp_path / "scan/bundle.json").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]


def test_a_bundle_holds_a_frame(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="found none"), _writer(tmp_path / "scan", sample_capture()):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("shot", "part"),
    [
        (Shot(0, "middle", np.zeros(CAMERA.shape, np.uint8)), "camera 'middle'"),
        (Shot(5, "left", np.zeros(CAMERA.shape, np.uint8)), "pattern 5"),
        (Shot(0, "left", np.zeros((3, 4), np.uint8)), "found 4 x 3 uint8"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint8), exposure_s=0.0), "exposure 0.0 s"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint8), time_s=float("nan")), "time nan s"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint16)), "uint16"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(tmp_path: Path, shot: Shot, part: str) -> None:
    with pytest.raises(BundleError, match=part), _writer(tmp_path / "scan", sample_capture()) as writer:
        writer.add(shot)
    assert list(tmp_path.iterdir()) == []


def test_samples_beyond_full_scale_are_refused(tmp_path: Path) -> None:
    capture = sample_capture(bit_depth=10)
    with pytest.raises(BundleError, match=r"up to 1023.*up to 1024"), _writer(tmp_path / "scan", capture) as writer:
        writer.add(Shot(0, "left", np.full(CAMERA.shape, 1024, np.uint16)))


@pytest.mark.parametrize("name", ["", "../left", "a/b", "left\n", ".left", "é", "x" * 65, "projector"])
def test_a_camera_must_have_a_name_fit_for_files(tmp_path: Path, name: str) -> None:
    capture = sample_capture()
    with pytest.raises(BundleError, match="rename the camera"):
        BundleWriter(tmp_path / "scan", capture.projector, capture.patterns, {name: CameraFormat(CAMERA, 8)})


def _described(folder: Path, frames: list[dict[str, object]], bit_depth: int = 8) -> None:
    folder.mkdir()
    (folder / "bundle.json").write_text(
        json.dumps(
            {
                "format": "slrig-bundle",
                "version": 1,
                "projector": {"size_px": [32, 24]},
                "cameras": {"cam0": {"size_px": [CAMERA.width_px, CAMERA.height_px], "bit_depth": bit_depth}},
                "patterns": [
                    {"kind": "white"},
                    {"kind": "gray", "axis": "row", "bit": 0, "bits": 5},
                    {"kind": "line_shift", "axis": "column", "shift": 1, "period_px": 8},
                ],
                "frames": frames,
            }
        )
    )


def test_optional_keys_may_be_absent(tmp_path: Path) -> None:
    _described(tmp_path / "scan", [{"pattern": 0, "camera": "cam0", "file": "a.png"}] * 2)
    assert cv2.imwrite(str(tmp_path / "scan/a.png"), np.full(CAMERA.shape, 7, np.uint8))
    capture = read_bundle(tmp_path / "scan").capture
    gray, line = capture.patterns[1:]
    assert isinstance(gray, Gray)
    assert (gray.cell_px, gray.offset_px, gray.inverted) == (1, 0, False)
    assert isinstance(line, LineShift)
    assert line.line_width_px == 1
    assert [(shot.exposure_s, shot.time_s) for shot in capture.shots] == [(None, None)] * 2


def test_pages_of_a_tiff_are_frames(tmp_path: Path) -> None:
    frames: list[dict[str, object]] = [
        {"pattern": 0, "camera": "cam0", "file": "all.tif", "page": page} for page in (3, 0, 4, 0)
    ]
    _described(tmp_path / "scan", frames, bit_depth=12)
    images = [noise(CameraFormat(CAMERA, 12), seed) for seed in range(5)]
    with tifffile.TiffWriter(tmp_path / "scan/all.tif", bigtiff=True, byteorder=">") as tiff:
        for image in images:
            tiff.write(image, photometric="minisblack", compression="zlib", predictor=True, contiguous=False)
    shots = read_bundle(tmp_path / "scan").capture.shots
    for shot, page in zip(shots, (3, 0, 4, 0), strict=True):
        np.testing.assert_array_equal(shot.image, images[page])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_colour_becomes_grey(tmp_path: Path, kind: type[np.unsignedinteger], ending: str) -> None:
    bits = 8 * np.dtype(kind).itemsize
    _described(tmp_path / "scan", [{"pattern": 0, "camera": "cam0", "file": f"a.{ending}"}], bit_depth=bits)
    rng = np.random.default_rng(3)
    bgr = rng.integers(0, 2**bits, (*CAMERA.shape, 3)).astype(kind)
    assert cv2.imwrite(str(tmp_path / f"scan/a.{ending}"), bgr)
    image = read_bundle(tmp_path / "scan").capture.shots[0].image
    np.testing.assert_allclose(image, bgr.astype(float) @ [0.114, 0.587, 0.299], atol=1e-4 * 2**bits + 0.5)
    assert image.dtype == kind


def test_another_calibration_may_take_the_place_of_the_bundles_own(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", sample_capture(), sample_calibration())
    (tmp_path / "scan/calibration.json").write_text("broken")
    write_calibration(tmp_path / "better.json", sample_calibration(cameras=("right",)))
    read = read_bundle(tmp_path / "scan", calibration_file=tmp_path / "better.json")
    assert read.calibration is not None
    assert list(read.calibration.cameras) == ["right"]


def _truth() -> Truth:
    rng = np.random.default_rng(5)
    depth_mm = rng.uniform(400, 600, CAMERA.shape)
    depth_mm[0, :5] = np.nan
    camera = CameraTruth(depth_mm, rng.uniform(0, 30, (*CAMERA.shape, 2)), rng.normal(size=(50, 3)))
    other = CameraTruth(depth_mm + 1, rng.uniform(0, 30, (*CAMERA.shape, 2)), rng.normal(size=(20, 3)))
    # Two triangles that share no vertex, though two of their corners coincide: they must stay apart.
    vertices_mm = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 0], [0, 10, 0], [-10, 0, 1.0]])
    return Truth(Surface(vertices_mm, np.array([[0, 1, 2], [3, 4, 5]], np.int32)), {"b": camera, "a": other})


def test_truth_comes_back(tmp_path: Path) -> None:
    truth = _truth()
    write_truth(tmp_path, truth)
    read = read_truth(tmp_path)
    assert read is not None
    np.testing.assert_allclose(read.surface.vertices_mm, truth.surface.vertices_mm, rtol=1e-6)
    np.testing.assert_array_equal(read.surface.faces, truth.surface.faces)
    np.testing.assert_array_equal(read.visible_points_mm, truth.cameras["b"].visible_points_mm)
    assert set(read.cameras) == {"a", "b"}
    for name, camera in truth.cameras.items():
        np.testing.assert_allclose(read.cameras[name].depth_mm, camera.depth_mm, rtol=1e-6)
        np.testing.assert_allclose(read.cameras[name].projector_px, camera.projector_px, rtol=1e-6)
        np.testing.assert_array_equal(read.cameras[name].visible_points_mm, camera.visible_points_mm)
    assert (tmp_path / "truth.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")


def test_a_bundle_may_have_no_truth(tmp_path: Path) -> None:
    assert read_truth(tmp_path) is None


@pytest.mark.parametrize("name", ["truth.ply", "visible_points.npy", "truth-a.npz"])
@pytest.mark.parametrize("kept", [0.0, 0.5])
def test_cut_truth_is_refused(tmp_path: Path, name: str, kept: float) -> None:
    write_truth(tmp_path, _truth())
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(kept * len(data))])
    with pytest.raises(BundleError, match=rf"{name}: expected truth"):
        read_truth(tmp_path)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "frames", "calibrated", "truth"),
    [
        pytest.param("bundles/gauge", 60, True, True, marks=pytest.mark.slow),
        ("captures/skull", 12, True, False),
        pytest.param("captures/boards/pose_0", 42, False, False, marks=pytest.mark.slow),
    ],
)
def test_bundles_of_others_are_read(shared: Path, name: str, frames: int, calibrated: bool, truth: bool) -> None:
    bundle = read_bundle(shared / name)
    assert len(bundle.capture.shots) == frames
    assert (bundle.calibration is not None) == calibrated
    whites = [
        shot.image.mean() for shot in bundle.capture.shots if bundle.capture.patterns[shot.pattern].kind == "white"
    ]
    blacks = [
        shot.image.mean() for shot in bundle.capture.shots if bundle.capture.patterns[shot.pattern].kind == "black"
    ]
    assert min(whites) > max(blacks)
    found = read_truth(shared / name)
    assert (found is not None) == truth
    if found is not None:
        low, high = found.surface.vertices_mm.min(axis=0), found.surface.vertices_mm.max(axis=0)
        assert (found.visible_points_mm >= low - 0.01).all()
        assert (found.visible_points_mm <= high + 0.01).all()
        assert found.cameras == {}

"""Scan bundles: what is written comes back, whole or not at all, and other people's bundles can be read."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from slrig.bundle import BundleWriter, read_bundle, read_truth, storage, write_bundle, write_calibration, write_truth
from slrig.bundle.sidecars import RefusedFrame, read_refused
from slrig.bundle.storage import write_file
from slrig.errors import BundleError, ScanEvidenceError, StorageError
from slrig.model import Black, CameraFormat, CameraTruth, Capture, Gray, LineShift, Shot, Size, Surface, Truth, White
from tests.samples import CAMERA, noise, sample_calibration, sample_capture


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


def test_frames_are_on_disk_as_they_come(tmp_path: Path) -> None:
    capture = sample_capture()
    with _writer(tmp_path / "scan", capture) as writer:
        for count, shot in enumerate(capture.shots, start=1):
            writer.add(shot)
            assert len(list(tmp_path.rglob("*.png"))) == count
        assert not (tmp_path / "scan").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]


@pytest.mark.parametrize("most_bytes", [500, 1800])
def test_a_full_disk_leaves_nothing(tmp_path: Path, most_bytes: int) -> None:
    # A frame has some 1300 bytes and bundle.json more than 1800: the limit is met in a frame, or at the very end.
    capture = sample_capture()
    with (
        pytest.raises(StorageError, match=r"disk refused.*free some space"),
        _disk_that_refuses_more_than(most_bytes),
    ):
        write_bundle(tmp_path / "scan", capture)
    assert list(tmp_path.iterdir()) == []


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
        (Shot(0, "middle", np.zeros(CAMERA.shape, np.uint16)), "camera 'middle'"),
        (Shot(5, "left", np.zeros(CAMERA.shape, np.uint16)), "pattern 5"),
        (Shot(0, "left", np.zeros((3, 4), np.uint16)), "found 4 x 3 uint16"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint16), exposure_s=0.0), "exposure 0.0 s"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint16), time_s=float("nan")), "time nan s"),
        (Shot(0, "left", np.zeros(CAMERA.shape, np.uint8)), "uint8"),
        (Shot(0, "left", np.full(CAMERA.shape, 1024, np.uint16)), r"up to 1023.*up to 1024"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(tmp_path: Path, shot: Shot, part: str) -> None:
    capture = sample_capture(bit_depth=10)
    with pytest.raises(BundleError, match=part), _writer(tmp_path / "scan", capture) as writer:
        writer.add(shot)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["", "../left", "a/b", "left\n", ".left", "é", "x" * 65, "projector"])
def test_a_camera_must_have_a_name_fit_for_files(tmp_path: Path, name: str) -> None:
    capture = sample_capture()
    with pytest.raises(BundleError, match="rename the camera"):
        BundleWriter(tmp_path / "scan", capture.projector, capture.patterns, {name: CameraFormat(CAMERA, 8)})


def _describe(folder: Path, frames: list[dict[str, object]], bit_depth: int = 8) -> None:
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
    _describe(tmp_path / "scan", [{"pattern": 0, "camera": "cam0", "file": "a.png"}] * 2)
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
    _describe(tmp_path / "scan", frames, bit_depth=12)
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
    _describe(tmp_path / "scan", [{"pattern": 0, "camera": "cam0", "file": f"a.{ending}"}], bit_depth=bits)
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
    surface = Surface(vertices_mm, np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    return Truth(surface, {"b": camera, "a": other}, sample_calibration())


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


@pytest.mark.parametrize("name", ["truth.ply", "visible_points.npy", "truth-a.npz", "truth-calibration.json"])
@pytest.mark.parametrize("kept", [0.0, 0.5])
def test_cut_truth_is_refused(tmp_path: Path, name: str, kept: float) -> None:
    write_truth(tmp_path, _truth())
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(kept * len(data))])
    with pytest.raises(BundleError, match=rf"{name}: expected truth"):
        read_truth(tmp_path)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda ply: ply.replace(b"binary_little_endian", b"ascii"), "another PLY file"),
        (lambda ply: ply[:-4] + b"\xff\xff\xff\x7f", "no triangles of its vertices"),
        (lambda ply: ply[:-13] + b"\x04" + ply[-12:], "no triangles of its vertices"),
    ],
)
def test_a_surface_that_slrig_did_not_write_is_refused(
    tmp_path: Path, change: Callable[[bytes], bytes], cause: str
) -> None:
    write_truth(tmp_path, _truth())
    (tmp_path / "truth.ply").write_bytes(change((tmp_path / "truth.ply").read_bytes()))
    with pytest.raises(BundleError, match=f"expected truth of the bundle, found: .*{cause}"):
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
    patterns, shots = bundle.capture.patterns, bundle.capture.shots
    whites, blacks = (
        [shot.image.mean() for shot in shots if patterns[shot.pattern].kind == kind] for kind in ("white", "black")
    )
    assert min(whites) > max(blacks)
    found = read_truth(shared / name)
    assert (found is not None) == truth
    if found is not None:
        low, high = found.surface.vertices_mm.min(axis=0), found.surface.vertices_mm.max(axis=0)
        assert (found.visible_points_mm >= low - 0.01).all()
        assert (found.visible_points_mm <= high + 0.01).all()
        assert found.cameras == {}


# ---- Frames that were refused lie beside a bundle and not in it; a capture that was cut short leaves what it has


FORMATS = {"left": CameraFormat(Size(64, 48), 8), "right": CameraFormat(Size(64, 48), 8)}


def shot(pattern: int, camera: str = "left", *, level: int = 0, time_s: float = 0.0) -> Shot:
    return Shot(pattern, camera, np.full((48, 64), level, np.uint8), 0.01, time_s)


def writer(folder: Path) -> BundleWriter:
    return BundleWriter(folder, Size(64, 40), (White(), Black(), White()), FORMATS)


def listed(folder: Path) -> list[tuple[int, str, int]]:
    return [(each.pattern, each.camera, int(each.image[0, 0])) for each in read_bundle(folder).capture.shots]


def test_a_frame_that_was_shot_again_takes_the_place_of_the_first(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.add(shot(0, level=10))
        bundle.add(shot(1, level=11, time_s=0.1))
        bundle.refuse(RefusedFrame(1, "left", 1, "it equals pattern 0", delivered=True))
        bundle.add(shot(2, level=12))
        bundle.add(shot(1, level=21, time_s=0.3))
    assert listed(folder) == [(0, "left", 10), (1, "left", 21), (2, "left", 12)]
    (entry,) = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert entry == {
        "pattern": 1, "camera": "left", "attempt": 1, "cause": "it equals pattern 0", "file": "refused/000.png",
        "exposure_s": 0.01, "time_s": 0.1,
    }  # fmt: skip
    image = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image[0, 0] == 11
    assert read_refused(folder) == (RefusedFrame(1, "left", 1, "it equals pattern 0"),)


def test_a_frame_that_failed_first_keeps_its_place(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.refuse(RefusedFrame(0, "left", 1, "damaged", shot(0, level=99)))
        bundle.refuse(RefusedFrame(0, "right", 1, "no frame came"))
        bundle.add(shot(1, level=11))
        bundle.add(shot(0, "right", level=20))
        bundle.add(shot(0, level=10))
    assert listed(folder) == [(0, "left", 10), (0, "right", 20), (1, "left", 11)]
    entries = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert [each.get("file") for each in entries] == ["refused/000.png", None]
    assert [path.name for path in sorted((folder / "refused").iterdir())] == ["000.png", "refused.json"]


def test_only_the_withdrawn_frame_is_withdrawn(tmp_path: Path) -> None:
    # The same pattern at two exposures, as a bracket has it: a frame that did not come leaves the other one alone.
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.add(shot(0, level=10))
        bundle.refuse(RefusedFrame(0, "left", 1, "no frame came"))
        bundle.add(shot(0, level=40))
    assert listed(folder) == [(0, "left", 10), (0, "left", 40)]


def test_a_bundle_without_refused_frames_has_no_such_folder(tmp_path: Path) -> None:
    with writer(tmp_path / "bundle") as bundle:
        bundle.add(shot(0))
    assert not (tmp_path / "bundle" / "refused").exists()
    assert read_refused(tmp_path / "bundle") == ()


def cut_short(folder: Path, *, keep: bool, taken: bool = True) -> None:
    with writer(folder) as bundle:
        if taken:
            bundle.add(shot(0, level=10))
            bundle.add(shot(1, level=11))
        bundle.refuse(RefusedFrame(1, "left", 1, "stale", delivered=taken))
        if keep:
            bundle.keep("pattern 1 failed 3 times")
        message = "pattern 1 failed 3 times"
        raise ScanEvidenceError(message)


def test_a_capture_that_was_cut_short_keeps_its_frames_on_request(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError):
        cut_short(folder, keep=True)
    assert listed(folder) == [(0, "left", 10)]
    assert json.loads((folder / "refused" / "refused.json").read_text())["ended"] == "pattern 1 failed 3 times"
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_capture_that_failed_at_its_first_frame_leaves_the_cause(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError):
        cut_short(folder, keep=True, taken=False)
    with pytest.raises(BundleError, match=r"there is no bundle\.json in it"):
        read_bundle(folder)
    assert [each.cause for each in read_refused(folder)] == ["stale"]


def test_other_errors_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(ScanEvidenceError):
        cut_short(tmp_path / "bundle", keep=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"format": "slrig-refused", "version": 2, "frames": []}', "version"),
        ('{"format": "slrig-refused", "frames": [{"pattern": -1}]}', "pattern"),
        ("[", "expected JSON"),
    ],
)
def test_a_list_that_slrig_did_not_write_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "refused").mkdir()
    (tmp_path / "refused" / "refused.json").write_text(text)
    with pytest.raises(BundleError, match=words):
        read_refused(tmp_path)


# ---- Files that are whole or absent


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_file(path, b"first, and longer")
    write_file(path, b"second")
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("cause", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EIO])
def test_a_disk_that_refuses_leaves_the_old_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: int) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"before")

    def refuse(_: int) -> None:
        raise OSError(cause, os.strerror(cause))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(StorageError, match=r"mesh\.ply: the disk refused") as caught:
        write_file(path, b"after")
    assert os.strerror(cause) in str(caught.value)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interruption_leaves_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.bin", b"x")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"nowhere.*create the folder first"):
        write_file(tmp_path / "nowhere" / "a.bin", b"x")


def test_on_windows_no_folder_is_opened_and_files_are_synced_writable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[Path, int]] = []
    system_open = os.open

    def as_windows(path: Path, flags: int) -> int:
        assert not path.is_dir()
        opened.append((path, flags))
        return system_open(path, flags)

    monkeypatch.setattr(storage, "_WINDOWS", True)
    monkeypatch.setattr(os, "open", as_windows)
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    storage.sync_file(tmp_path / "mesh.ply")
    storage.sync_folder(tmp_path)
    assert opened == [(tmp_path / "mesh.ply", os.O_RDWR)]

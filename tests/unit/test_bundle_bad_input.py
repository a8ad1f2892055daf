"""Each kind of bad bundle gives one error that names the file, what was expected, what was found, and the remedy."""

from __future__ import annotations

import json
import re
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from slrig.bundle import images, read_bundle, read_capture, write_bundle
from slrig.errors import BundleError, CalibrationError
from tests.samples import CAMERA, sample_calibration, sample_capture

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_bundle(tmp_path / "scan", sample_capture(), sample_calibration())
    return tmp_path / "scan"


def _edit(path: Path, change: Edit) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def _fault(folder: Path, *parts: str) -> str:
    """The one error that reading gives; it must hold every part."""
    with pytest.raises(BundleError) as caught:
        read_bundle(folder)
    message = str(caught.value)
    for part in parts:
        assert part in message
    return message


def _png(width: int, height: int, bits: int, colour: int, pixels: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def _compressed_zeros(count: int) -> bytes:
    """A valid zlib stream of `count` zero bytes, at the cost of one mebibyte."""
    block = bytes(2**20)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    whole, rest = divmod(count, len(block))
    checksum = 1
    for _ in range(whole):
        checksum = zlib.adler32(block, checksum)
    tail = zlib.compressobj(9, zlib.DEFLATED, -15)
    end = tail.compress(bytes(rest)) + tail.flush()
    checksum = zlib.adler32(bytes(rest), checksum)
    return b"\x78\xda" + packed * whole + end + struct.pack(">I", checksum)


def test_the_compressed_zeros_are_a_valid_stream() -> None:
    assert zlib.decompress(_compressed_zeros(3 * 2**20 + 17)) == bytes(3 * 2**20 + 17)


def test_an_enormous_png_is_refused_from_its_header(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    side = 20_000
    bomb = _png(side, side, 8, 0, _compressed_zeros(side * (side + 1)))
    assert len(bomb) < 2**20
    (folder / "frames/left/002.png").write_bytes(bomb)
    unpacked = []
    real = images._inflated

    def inflated(packed: bytearray | memoryview, most_bytes: int) -> bytes | None:
        unpacked.append(most_bytes)
        return real(packed, most_bytes)

    monkeypatch.setattr(images, "_inflated", inflated)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _fault(folder, "frames/left/002.png", "expected 40 x 30", "found 20000 x 20000", "replace the frame")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < 64 * 1024
    assert unpacked
    assert max(unpacked) < side


def test_an_enormous_camera_is_refused_from_the_description(folder: Path) -> None:
    _edit(folder / "bundle.json", lambda data: data["cameras"]["left"].update(size_px=[20_000, 20_000]))
    _fault(
        folder, "bundle.json", "cameras.left.size_px", "at most 67108864 pixels", "found 20000 x 20000", "crop or bin"
    )


def test_more_samples_than_memory_are_refused_from_the_description(folder: Path) -> None:
    def repeat(data: dict[str, Any]) -> None:
        data["cameras"]["left"]["size_px"] = [8000, 8000]
        data["frames"] = data["frames"] * 20

    _edit(folder / "bundle.json", repeat)
    _fault(folder, "at most 4.3 GB of samples", "found 6.4 GB in 200 frames", "split the bundle")


@pytest.mark.parametrize("kept", [0, 7, 20, 60, 0.5, 0.99])
def test_a_cut_png_is_told_as_cut(folder: Path, kept: float) -> None:
    path = folder / "frames/left/003.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(kept if kept >= 1 else kept * len(data))])
    _fault(folder, "frames/left/003.png", "expected", "found", "frame")


def test_a_damaged_png_is_told_as_damaged(folder: Path) -> None:
    path = folder / "frames/left/003.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    _fault(folder, "frames/left/003.png", "expected a sound PNG file", "found a wrong checksum", "copy the frame again")


def test_a_png_with_too_few_rows_is_refused(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    width, height = CAMERA.width_px, CAMERA.height_px
    (folder / "frames/left/003.png").write_bytes(_png(width, height, 8, 0, zlib.compress(bytes((width + 1) * 5))))
    _fault(folder, "frames/left/003.png", "found data that cannot be decoded")
    capfd.readouterr()


def test_a_missing_frame_is_named(folder: Path) -> None:
    (folder / "frames/right/001.png").unlink()
    _fault(folder, "frames/right/001.png", "expected a frame file", "No such file", "remove its entry")


def test_the_first_bad_frame_in_order_is_the_one_told(folder: Path) -> None:
    for name in ("right/004", "left/001", "right/001"):
        (folder / f"frames/{name}.png").unlink()
    assert "frames/left/001.png" in _fault(folder)


def test_a_frame_of_another_size_is_refused(folder: Path) -> None:
    assert cv2.imwrite(str(folder / "frames/left/000.png"), np.zeros((40, 30), np.uint8))
    _fault(folder, "frames/left/000.png", "expected 40 x 30", "found 30 x 40", "correct size_px")


def test_two_bit_depths_in_one_camera_are_refused(folder: Path) -> None:
    assert cv2.imwrite(str(folder / "frames/left/004.png"), np.zeros(CAMERA.shape, np.uint16))
    _fault(folder, "frames/left/004.png", "expected 8-bit samples", "found 16-bit samples", "correct bit_depth")


def test_samples_beyond_full_scale_are_refused(tmp_path: Path) -> None:
    write_bundle(tmp_path / "scan", sample_capture(bit_depth=12))
    _edit(tmp_path / "scan/bundle.json", lambda data: data["cameras"]["left"].update(bit_depth=10))
    _fault(tmp_path / "scan", "samples of 0 to 1023", "found a sample of", "right-align the samples")


@pytest.mark.parametrize(("shape", "kind"), [((30, 40, 4), "an alpha channel")])
def test_a_png_with_alpha_is_refused(folder: Path, shape: tuple[int, ...], kind: str) -> None:
    assert cv2.imwrite(str(folder / "frames/left/000.png"), np.zeros(shape, np.uint8))
    _fault(folder, "expected a grey or colour PNG", kind, "save the frame as grey")


def test_another_kind_of_file_is_refused(folder: Path) -> None:
    (folder / "frames/left/000.png").write_bytes(b"GIF89a a film")
    _fault(folder, "expected a PNG, TIFF, BMP or JPEG file", "begins with", "save the frame as PNG")


def _with_tiff(folder: Path, page: int, **writing: Any) -> Path:
    path = folder / "frames/left.tif"
    pages = [np.full(CAMERA.shape, value, np.uint8) for value in range(5)]
    with tifffile.TiffWriter(path) as tiff:
        for image in pages:
            tiff.write(image, **{"photometric": "minisblack", "contiguous": False, **writing})
    _edit(folder / "bundle.json", lambda data: data["frames"][0].update(file="frames/left.tif", page=page))
    return path


def test_a_page_that_is_not_there_is_refused(folder: Path) -> None:
    _with_tiff(folder, 5)
    _fault(folder, "frames/left.tif", "expected a page 5", "found 5 pages", "correct `page`")


@pytest.mark.parametrize("kept", [6, 0.1, 0.5, 0.9])
def test_a_cut_tiff_is_refused(folder: Path, kept: float) -> None:
    path = _with_tiff(folder, 4)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept if kept >= 1 else kept * len(data))])
    _fault(folder, "frames/left.tif", "expected", "found")


def test_a_tiff_with_unsound_data_is_refused(folder: Path) -> None:
    path = _with_tiff(folder, 1, compression="zlib")
    with tifffile.TiffFile(path) as tiff:
        place = tiff.pages[1].dataoffsets[0]
    data = bytearray(path.read_bytes())
    data[place : place + 12] = b"\xff" * 12
    path.write_bytes(data)
    _fault(folder, "frames/left.tif", "data that cannot be unpacked", "copy the frame again")


def test_a_tiff_that_unpacks_to_too_much_is_refused(folder: Path) -> None:
    path = _with_tiff(folder, 0, compression="zlib")
    with tifffile.TiffFile(path) as tiff:
        tags = tiff.pages[0].tags
        places = [tags[name].valueoffset for name in ("StripOffsets", "StripByteCounts")]
    bomb = _compressed_zeros(2**29)
    data = bytearray(path.read_bytes())
    for place, value in zip(places, (len(data), len(bomb)), strict=True):
        data[place : place + 4] = struct.pack("<I", value)
    path.write_bytes(bytes(data) + bomb)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _fault(folder, "frames/left.tif", "data that cannot be unpacked")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < 64 * 1024


def test_a_tiff_of_fractions_is_refused(folder: Path) -> None:
    path = _with_tiff(folder, 0)
    tifffile.imwrite(path, np.zeros(CAMERA.shape, np.float32), photometric="minisblack")
    _fault(folder, "expected unsigned grey or colour samples", "save the frame as grey")


def test_an_enormous_tiff_is_refused_from_its_header(folder: Path) -> None:
    path = _with_tiff(folder, 0)
    data = path.read_bytes()
    with tifffile.TiffFile(path) as tiff:
        tags = tiff.pages[0].tags
        places = [tags[name].valueoffset for name in ("ImageWidth", "ImageLength")]
    changed = bytearray(data)
    for place in places:
        changed[place : place + 2] = struct.pack("<H", 20_000)
    path.write_bytes(changed)
    _fault(folder, "expected 40 x 30", "found 20000 x 20000")


def test_a_png_has_one_page(folder: Path) -> None:
    _edit(folder / "bundle.json", lambda data: data["frames"][0].update(page=1))
    _fault(folder, "frames/left/000.png", "page 0 only", "found page 1", "use a TIFF")


BAD_DESCRIPTIONS: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "unknown key": (lambda data: data.update(projektor={}), ("projektor: unknown key", "did you mean 'projector'?")),
    "unknown key inside": (
        lambda data: data["patterns"][2].update(cel_px=2),
        ("patterns[2].cel_px: unknown key", "did you mean 'cell_px'?"),
    ),
    "missing key": (lambda data: data.pop("cameras"), ("cameras: missing; add it",)),
    "missing key inside": (lambda data: data["patterns"][4].pop("period_px"), ("patterns[4].period_px: missing",)),
    "other format": (lambda data: data.update(format="images"), ("format:", "'slrig-bundle'", "found 'images'")),
    "other version": (lambda data: data.update(version=2), ("version:", "found 2")),
    "text for a number": (lambda data: data["frames"][1].update(pattern="1"), ("frames[1].pattern:", "found '1'")),
    "yes for a number": (lambda data: data["frames"][1].update(page=True), ("frames[1].page:", "found True")),
    "no frames": (lambda data: data.update(frames=[]), ("frames:", "at least 1 item")),
    "no patterns": (lambda data: data.update(patterns=[]), ("patterns:", "at least 1 item")),
    "no cameras": (lambda data: data.update(cameras={}), ("cameras:", "at least 1 item")),
    "unknown pattern kind": (lambda data: data["patterns"][0].update(kind="phase"), ("patterns[0]", "'phase'")),
    "impossible pattern": (lambda data: data["patterns"][2].update(bit=9), ("patterns[2]", "bit 9 of 5")),
    "impossible shift": (lambda data: data["patterns"][4].update(shift=8), ("patterns[4]", "shift 8")),
    "pattern out of range": (
        lambda data: data["frames"][3].update(pattern=5),
        ("frames[3].pattern: expected 0 to 4, found 5", "number the patterns from 0"),
    ),
    "unknown camera": (
        lambda data: data["frames"][3].update(camera="middle"),
        ("frames[3].camera: expected one of left, right, found 'middle'",),
    ),
    "camera name with a slash": (
        lambda data: data["cameras"].update({"../left": data["cameras"]["left"]}),
        ("cameras", "../left"),
    ),
    "camera named as the projector": (
        lambda data: data["cameras"].update(projector=data["cameras"]["left"]),
        ("cameras", "expected a camera's own name, found 'projector'", "rename the camera"),
    ),
    "a file above the folder": (
        lambda data: data["frames"][0].update(file="frames/../../secret.png"),
        ("frames[0].file", "inside the bundle", "secret.png"),
    ),
    "an absolute file": (
        lambda data: data["frames"][0].update(file="/etc/passwd"),
        ("frames[0].file", "inside the bundle", "'/etc/passwd'"),
    ),
    "a file with backslashes": (
        lambda data: data["frames"][0].update(file="frames\\left\\000.png"),
        ("frames[0].file", "forward slashes"),
    ),
    "no exposure": (lambda data: data["frames"][0].update(exposure_s=0), ("frames[0].exposure_s", "found 0")),
    "a thin camera": (lambda data: data["cameras"]["left"].update(size_px=[40]), ("cameras.left.size_px",)),
    "a vast projector": (lambda data: data["projector"].update(size_px=[1, 10**6]), ("projector.size_px[1]",)),
    "a deep camera": (lambda data: data["cameras"]["left"].update(bit_depth=17), ("cameras.left.bit_depth", "17")),
}


@pytest.mark.parametrize("case", BAD_DESCRIPTIONS)
def test_a_bad_description_is_told_with_its_path(folder: Path, case: str) -> None:
    change, parts = BAD_DESCRIPTIONS[case]
    _edit(folder / "bundle.json", change)
    _fault(folder, str(folder / "bundle.json"), *parts)


def test_every_fault_of_a_description_is_in_one_message(folder: Path) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["projector"]["size"] = 3
        data["cameras"]["right"]["bit_depth"] = "8"
        data["frames"][0].pop("file")

    _edit(folder / "bundle.json", spoil)
    message = _fault(folder, "projector.size: unknown key", "cameras.right.bit_depth", "frames[0].file: missing")
    assert len(message.splitlines()) == 4


def test_very_many_faults_are_counted(folder: Path) -> None:
    _edit(folder / "bundle.json", lambda data: data.update(frames=[{}] * 50))
    message = _fault(folder, "and 130 more")
    assert len(message.splitlines()) == 22


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ("expected JSON", "line 1")),
        ("not json", ("expected JSON", "line 1")),
        ('{"format": "slrig-bundle",\n "version": 1', ("expected JSON", "line 2", "may be cut")),
        ('{"version": NaN}', ("found NaN", "must be finite")),
        ('{"version": -Infinity}', ("found -Infinity",)),
        ('{"version": 1e999}', ("version",)),
        ('{"version": 1, "version": 2}', ("'version' twice",)),
        ("[" * 100_000, ("nested too deeply",)),
        ("[]", ("top level",)),
        ("1" * 5000, ("bundle.json",)),
    ],
    ids=["empty", "text", "cut", "nan", "infinity", "overflow", "twice", "deep", "list", "long number"],
)
def test_what_is_no_description_is_told(folder: Path, text: str, parts: tuple[str, ...]) -> None:
    (folder / "bundle.json").write_text(text)
    _fault(folder, "bundle.json", *parts)


def test_a_huge_description_is_not_read(folder: Path) -> None:
    with (folder / "bundle.json").open("r+b") as file:
        file.truncate(2**34)
    _fault(folder, "bundle.json", "at most 16777216 bytes", "found a larger file")


def test_a_description_that_is_not_text_is_told(folder: Path) -> None:
    (folder / "bundle.json").write_bytes(b'{"format": "\xff"}')
    _fault(folder, "expected UTF-8", "0xff at 12")


def test_a_folder_without_description_is_told(tmp_path: Path) -> None:
    _fault(tmp_path, "bundle.json", "found a folder without it")
    _fault(tmp_path / "nowhere", "found no such folder", "give the folder that holds it")


def test_a_link_out_of_the_bundle_is_refused(folder: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.png"
    (folder / "frames/left/000.png").rename(outside)
    (folder / "frames/left/000.png").symlink_to(outside)
    _fault(folder, "frames/left/000.png", "found a link that leads out", "copy the frame into the bundle")


@pytest.mark.parametrize("who", ["cameras.left", "projector"])
def test_a_calibration_of_another_size_is_refused(folder: Path, who: str) -> None:
    def resize(data: dict[str, Any]) -> None:
        device = data["projector"] if who == "projector" else data["cameras"]["left"]
        device["size_px"] = [64, 48]

    _edit(folder / "calibration.json", resize)
    with pytest.raises(CalibrationError, match=rf"(?s)calibration\.json: .*{re.escape(who)}: expected .*found 64 x 48"):
        read_bundle(folder)


def test_a_calibration_of_other_cameras_is_refused(folder: Path) -> None:
    _edit(folder / "calibration.json", lambda data: data["cameras"].update(middle=data["cameras"].pop("left")))
    _edit(folder / "calibration.json", lambda data: data["cameras"].pop("right"))
    with pytest.raises(CalibrationError, match="expected left, right, found middle"):
        read_bundle(folder)


def test_a_bad_calibration_does_not_stop_who_only_needs_frames(folder: Path) -> None:
    (folder / "calibration.json").write_text("{")
    assert len(read_capture(folder).shots) == 10
    with pytest.raises(CalibrationError, match=r"calibration\.json: expected JSON"):
        read_bundle(folder)


def test_a_bundle_without_calibration_is_read(folder: Path) -> None:
    (folder / "calibration.json").unlink()
    assert read_bundle(folder).calibration is None


def test_what_opencv_refuses_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # libtiff is stricter than our check of the header in a tag or two; harmed files of the campaign met it.
    def refuse(*_: object) -> None:
        message = "OpenCV TIFF: failed TIFFGetField(tif, TIFFTAG_PHOTOMETRIC, &photometric)"
        raise cv2.error(message)

    _with_tiff(folder, 0)
    monkeypatch.setattr(cv2, "imdecodemulti", refuse)
    _fault(folder, "data that cannot be decoded")

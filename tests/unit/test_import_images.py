"""Images in stacks, arrays and videos, with alpha and in words of 16 bits, are imported as those of a folder are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from slrig.bundle import read_bundle
from slrig.errors import BundleError
from slrig.importers.captures import ImageAssignment, ImageNaming, assign_images, import_capture
from slrig.importers.images import list_images
from slrig.importers.orders import ProjectorCode, opencv_sequence
from slrig.model import Black, Capture, Pixels, Size, White
from slrig.patterns import encode

CODE = ProjectorCode(Size(16, 12))
PATTERNS = opencv_sequence(CODE, 18, (White(), Black()), references_first=False)
WHITE, BLACK = 16, 17


def photographed() -> list[Pixels]:
    """A camera's images of OpenCV's sequence, of an object with a texture, with samples up to 210."""
    sequence = encode(PATTERNS, CODE.size)
    shade = cv2.GaussianBlur(np.random.default_rng(2).uniform(0.0, 1.5, (96, 128)), None, 4.0)
    images = [np.kron(sequence.image(index), np.ones((8, 8))) * shade * 0.76 + 16 for index in range(len(PATTERNS))]
    return [np.rint(image).astype(np.uint8) for image in images]


def taken(source: Path, bundle: Path, naming: ImageNaming) -> ImageAssignment:
    found = assign_images(source, CODE, naming)
    import_capture(source, bundle, CODE, found)
    return found


def imported(source: Path, listed: Path | None = None) -> tuple[Capture, list[str]]:
    naming = ImageNaming("opencv") if listed is None else ImageNaming(listed=listed)
    bundle = (source if source.is_dir() else source.parent) / "bundle"
    found = taken(source, bundle, naming)
    return read_bundle(bundle).capture, found.notes


def tiff_stack(path: Path, images: Sequence[Pixels]) -> Path:
    tifffile.imwrite(path / "scan.tif", np.stack(images), photometric="minisblack")
    return path / "scan.tif"


def pillow_stack(path: Path, images: Sequence[Pixels]) -> Path:
    first, *rest = map(Image.fromarray, images)
    first.save(path / "scan.tiff", save_all=True, append_images=rest, compression="tiff_adobe_deflate")
    return path / "scan.tiff"


def array(path: Path, images: Sequence[Pixels]) -> Path:
    np.save(path / "scan.npy", np.stack(images))
    return path / "scan.npy"


def columns_first(path: Path, images: Sequence[Pixels]) -> Path:
    np.save(path / "scan.npy", np.asfortranarray(np.stack(images, axis=2), dtype=np.float64))
    return path / "scan.npy"


def archive(path: Path, images: Sequence[Pixels]) -> Path:
    np.savez_compressed(path / "scan.npz", images=np.stack(images), K=np.eye(3), seconds=np.arange(18.0))
    return path / "scan.npz"


def archive_of_images(path: Path, images: Sequence[Pixels]) -> Path:
    np.savez(path / "scan.npz", *images)
    return path / "scan.npz"


def opaque_png(path: Path, images: Sequence[Pixels]) -> Path:
    for number, image in enumerate(images):
        alpha = Image.fromarray(np.full_like(image, 255))
        channels = [Image.fromarray(image)] * (1 if number % 2 else 3)
        Image.merge("LA" if number % 2 else "RGBA", [*channels, alpha]).save(path / f"{number}.png")
    return path


def opaque_by_opencv(path: Path, images: Sequence[Pixels]) -> Path:
    for number, image in enumerate(images):
        ending = (".bmp", ".tif", ".png")[number % 3]
        assert cv2.imwrite(str(path / f"{number}{ending}"), np.dstack([image] * 3 + [np.full_like(image, 255)]))
    return path


def video(path: Path, images: Sequence[Pixels], *, colour: bool = False, bits: int = 8) -> Path:
    height_px, width_px = images[0].shape[:2]
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(colour)]
    options += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U] if bits == 16 else []
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path / "scan.avi"), cv2.CAP_FFMPEG, code, 30.0, (width_px, height_px), options)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path / "scan.avi"


SOURCES = [
    tiff_stack, pillow_stack, array, columns_first, archive, archive_of_images, opaque_png, opaque_by_opencv, video
]  # fmt: skip


@pytest.mark.parametrize("save", SOURCES, ids=lambda save: save.__name__)
def test_images_of_any_source_are_those_of_a_folder(
    tmp_path: Path, save: Callable[[Path, Sequence[Pixels]], Path]
) -> None:
    images = photographed()
    capture, _ = imported(save(tmp_path, images))
    assert list(capture.patterns) == PATTERNS
    assert list(capture.cameras) == ["cam0"]
    for shot, image in zip(capture.shots, images, strict=True):
        assert np.array_equal(shot.image, image)
        assert shot.colour is None


def test_a_stack_of_each_camera_and_an_image_by_its_page(tmp_path: Path) -> None:
    images = photographed()
    for camera in ("left", "right"):
        tiff_stack(tmp_path, images).rename(tmp_path / f"{camera}.tif")
    listed = {WHITE: "white", BLACK: "black", 0: "column 0", 1: "column 0 inverted"}
    lines = [f"right.tif page {page},{words},eye" for page, words in listed.items()]
    (tmp_path / "list.csv").write_text("\n".join(("file,pattern,camera", *lines)))
    capture, _ = imported(tmp_path, tmp_path / "list.csv")
    for shot, page in zip(capture.shots, listed, strict=True):
        assert np.array_equal(shot.image, images[page])
    found = taken(tmp_path, tmp_path / "other", ImageNaming("opencv"))
    assert {name: len(each) for name, each in found.cameras.items()} == {"left": 18, "right": 18}


def test_a_page_that_contradicts_is_named(tmp_path: Path) -> None:
    images = photographed()
    images[5] = images[4]
    found = taken(tiff_stack(tmp_path, images), tmp_path / "bundle", ImageNaming("opencv"))
    assert any("scan.tif page 5 is a copy of image scan.tif page 4" in fault for fault in found.faults)


def test_transparent_images_are_refused(tmp_path: Path) -> None:
    images = photographed()
    opaque_png(tmp_path, images)
    Image.merge("LA", [Image.fromarray(images[3]), Image.fromarray(images[3])]).save(tmp_path / "3.png")
    with pytest.raises(BundleError, match=r"3.png: expected an opaque image, found \d+ transparent pixels"):
        imported(tmp_path)


@pytest.mark.parametrize(
    ("bits", "shift", "depth", "words"),
    [
        (12, 0, 12, "taken as 12 bits"),
        pytest.param(14, 0, 14, "taken as 14 bits", marks=pytest.mark.slow),
        pytest.param(10, 6, 16, "samples of 10 bits in steps of 64", marks=pytest.mark.slow),
        (12, 4, 16, "samples of 12 bits in steps of 16"),
        (16, 0, 16, ""),
    ],
)
def test_bits_and_alignment_of_samples_are_found(tmp_path: Path, bits: int, shift: int, depth: int, words: str) -> None:
    chance = np.random.default_rng(5)
    deep = [
        np.clip(image * (2.0**bits / 256) + chance.normal(0, 2.0**bits / 300, image.shape), 0, 2**bits - 1)
        .round().astype(np.uint16) << shift
        for image in photographed()
    ]  # fmt: skip
    tifffile.imwrite(tmp_path / "scan.tif", np.stack(deep), photometric="minisblack")
    capture, notes = imported(tmp_path / "scan.tif")
    assert capture.cameras["cam0"].bit_depth == depth
    assert [words in note for note in notes] == ([True] if words else [])
    assert np.array_equal(capture.shots[3].image, deep[3])


def test_raw_samples_of_a_colour_sensor_are_named(tmp_path: Path) -> None:
    filtered = np.ones((96, 128))
    filtered[::2, ::2], filtered[1::2, 1::2] = 0.55, 0.7
    for name, gains in (("grey", np.ones((96, 128))), ("raw", filtered)):
        (tmp_path / name).mkdir()
        images = [np.rint(image * gains).astype(np.uint8) for image in photographed()]
        _, notes = imported(array(tmp_path / name, images))
        assert ["Bayer" in note for note in notes] == ([True] if name == "raw" else [])


def test_a_video_of_16_bits_keeps_them(tmp_path: Path) -> None:
    deep = [image.astype(np.uint16) * 301 for image in photographed()]
    capture, _ = imported(video(tmp_path, deep, bits=16))
    assert np.array_equal(capture.shots[7].image, deep[7])


def test_colour_in_a_video_and_in_an_array_is_kept_of_white_and_black(tmp_path: Path) -> None:
    coloured = [np.dstack([image, image // 2, image // 3]) for image in photographed()]
    for source in (video(tmp_path, coloured, colour=True), tmp_path / "scan.npy"):
        if source.suffix == ".npy":
            np.save(source, np.stack(coloured)[..., ::-1])
        capture, _ = imported(source)
        (tmp_path / "bundle").rename(tmp_path / f"{source.suffix}-bundle")
        for shot, image in zip(capture.shots, coloured, strict=True):
            assert np.array_equal(shot.image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
            assert (shot.colour is None) == (shot.pattern < WHITE)
        kept = capture.shots[WHITE].colour
        assert kept is not None
        assert np.array_equal(kept, coloured[WHITE])


@pytest.mark.parametrize(
    ("held", "noise_dn"),
    [(3, 3.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((3, 0.0), (6, 0.0), (6, 3.0)))],
)
def test_a_video_that_holds_each_pattern_is_averaged(tmp_path: Path, held: int, noise_dn: float) -> None:
    chance = np.random.default_rng(4)
    images, frames = photographed(), []
    for number, image in enumerate([images[-1], *images, images[-1]]):
        idle = number in (0, 19)
        frames += [image.astype(float)] * (20 * held if idle else held + int(chance.integers(2)))
        following = images[min(number, BLACK)]
        if not idle:
            # The exposure of one frame falls into the change.
            share = chance.uniform(0.2, 0.8)
            frames.append(share * image + (1 - share) * following)
    noisy = [
        np.clip(frame + chance.normal(0, noise_dn, frame.shape), 0, 255).round().astype(np.uint8) for frame in frames
    ]
    found = taken(video(tmp_path, noisy), tmp_path / "bundle", ImageNaming("opencv"))
    assert f"scan.avi: {len(frames)} frames, 19 images" in found.notes[0]
    assert found.unassigned == ["scan.avi frame 0"]
    capture = read_bundle(tmp_path / "bundle").capture
    assert list(capture.patterns) == PATTERNS
    off = [shot.image / 257.0 - image for shot, image in zip(capture.shots, images, strict=True)]
    averaged = held - 1.5
    assert np.std(off) < 1.1 * noise_dn / averaged**0.5 + 0.01
    assert np.abs(np.mean(off)) < 0.01


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("scan.avi", b"#EXTM3U\nhttp://example.org/a.ts\n", "expected a video as AVI"),
        ("scan.avi", b"RIFF\0\0\0\0AVI LIST", "expected a video that OpenCV can decode"),
        ("scan.npy", b"\x93NUMPY", "expected arrays of numbers"),
        ("scan.npz", b"PK\3\4", "expected arrays of numbers"),
        ("scan.gif", b"GIF89a", r"expected a folder of images, or a file of \.avi"),
    ],
)
def test_a_file_that_holds_no_images_is_refused(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(BundleError, match=words):
        list_images(tmp_path / name)


@pytest.mark.parametrize(
    "values",
    [np.zeros(5), np.zeros((2, 3, 4, 5, 6)), np.full((40, 50), -1.0), np.full((40, 50), np.nan), np.array(["a"])],
)
def test_an_array_that_is_not_of_images_is_refused(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "scan.npy", values)
    with pytest.raises(BundleError, match=r"expected (arrays of numbers of shape|samples from 0)"):
        list_images(tmp_path / "scan.npy")

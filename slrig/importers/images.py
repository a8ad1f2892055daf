"""Images of a capture, wherever they lie: files, pages of a TIFF, arrays of NumPy, frames of a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import natural_sort_key, read_frame_format, read_page_formats, read_with_colour
from slrig.errors import BundleError
from slrig.importers.stacks import STACKS, read_stack
from slrig.importers.video import VIDEOS, read_video
from slrig.model import CameraFormat, Pixels, Size

IMAGES = {".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg"}
ENDINGS = IMAGES | STACKS | VIDEOS

_USUAL_BITS = (10, 12, 14, 16)  # of samples in words of 16
_MIN_MOSAIC = 0.05  # of the mean of a block, between the green sites of a mosaic and the others
_MAX_GREEN_DIFFERENCE = 0.02  # of the same, between the green sites
_SAMPLED_ROWS = 64  # of an image, whose samples tell the step of the values


@dataclass(frozen=True, slots=True, eq=False)
class SourceImage:
    """One image of a camera, read when it is needed.

    path : file that holds it. name : name of the file, with the page, array or frame after it; stem : the same without
    ending, with the number last. page : of a TIFF; form : its format, if it is known. array : (H, W) or, in BGR,
    (H, W, 3), of a file that is not an image file. is_stretched : the samples of `array` fill all 16 bits.
    may_be_idle : it may show what was there before or after the patterns.
    """

    path: Path
    name: str
    stem: str
    page: int = 0
    form: CameraFormat | None = None
    array: NDArray[Any] | None = None
    is_stretched: bool = False
    may_be_idle: bool = False

    @classmethod
    def from_file(cls, path: Path) -> SourceImage:
        """Return the first image of a file."""
        return cls(path, path.name, path.stem)

    @property
    def place(self) -> Path:
        """Folder and name of the image."""
        return self.path.parent / self.name

    def read_format(self) -> CameraFormat:
        """Return extent and bits of the samples, 8 or 16. Raises BundleError."""
        if self.array is None:
            return self.form or read_frame_format(self.path)
        height_px, width_px = self.array.shape[:2]
        return CameraFormat(Size(width_px, height_px), 8 * self.array.dtype.itemsize)

    def read(self, camera: CameraFormat, *, coloured: bool = False) -> tuple[Pixels, Pixels | None]:
        """Return the image in grey, (H, W) uint8 or uint16, and, if asked for and there is any, in colour, (H, W, 3) of
        blue, green and red. Raises BundleError: the file is damaged, or does not have the format of the camera.
        """
        if self.array is None:
            pages = (self.page,)
            grey, colour = read_with_colour(self.path, pages, camera, colour_pages=pages if coloured else ())
            return grey[self.page], colour.get(self.page)
        image: Pixels = np.ascontiguousarray(self.array, dtype=f"u{self.array.dtype.itemsize}")
        colours = image if image.ndim == 3 else None
        if colours is not None:
            image = np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY))
        if int(image.max()) > camera.full_scale:
            raise BundleError(
                f"{self.place}: expected samples of 0 to {camera.full_scale} for --bit-depth "
                f"{camera.bit_depth}, found {int(image.max())}; correct it"
            )
        return image, colours if coloured else None


def list_images(place: Path) -> tuple[list[SourceImage], list[str]]:
    """Return the images in a folder, not below it, or of one file, in natural order, and how they were found in words.

    In a folder with image files other files are ignored. Pages of a TIFF that have the format of its first page are
    images. Raises BundleError: a file of another kind was given, or a stack or video cannot be read.
    """
    known = (IMAGES, STACKS, VIDEOS)
    if place.is_file():
        kind = next((each for each in known if place.suffix.lower() in each), None)
        if kind is None:
            endings = ", ".join(sorted(ENDINGS))
            raise BundleError(f"{place}: expected a folder of images, or a file of {endings}; save it as one of these")
        files = [place]
    else:
        there = [each for each in place.iterdir() if each.name[0] != "." and each.is_file()]
        by_kind = [[each for each in there if each.suffix.lower() in kind] for kind in known]
        files = sorted(next(filter(None, by_kind), []), key=natural_sort_key)
    images: list[SourceImage] = []
    notes: list[str] = []
    for file in files:
        suffix = file.suffix.lower()
        if suffix in IMAGES:
            images += _list_pages(file)
            continue
        found = read_video(file) if suffix in VIDEOS else read_stack(file)
        notes += [found.summary] if found.summary else []
        for words, array in found.images.items():
            name, stem = f"{file.name} {words}".strip(), f"{file.stem} {words}".strip()
            is_idle = words in found.idle
            images.append(SourceImage(file, name, stem, 0, None, array, found.is_stretched, is_idle))
    return images, notes


def list_images_below(place: Path) -> tuple[list[SourceImage], list[str]]:
    """Return what `list_images` does, of all folders in a folder too, ordered by place."""
    folders = [place, *(each for each in place.rglob("*") if each.is_dir())] if place.is_dir() else [place]
    listed = [list_images(each) for each in folders]
    images = sorted((image for found, _ in listed for image in found), key=lambda each: natural_sort_key(each.place))
    return images, [note for _, notes in listed for note in notes]


def without_idle_ends(images: Sequence[SourceImage]) -> Iterator[Sequence[SourceImage]]:
    """Yield the images, then without those at either end that may be idle: recordings begin before the patterns."""
    for stop, start in product((len(images), len(images) - 1), (0, 1)):
        if not any(not each.may_be_idle for each in (*images[:start], *images[stop:])):
            yield images[start:stop]


def _list_pages(path: Path) -> list[SourceImage]:
    first = SourceImage.from_file(path)
    if path.suffix.lower() not in (".tif", ".tiff"):
        return [first]
    try:
        formats = read_page_formats(path)
    except BundleError:
        # Whoever reads the image names the fault; it may be one that no pattern is known of.
        return [first]
    pages = [page for page, form in formats.items() if form == formats[0]]
    if len(pages) == 1:
        return [first]
    return [SourceImage(path, f"{path.name} page {page}", f"{path.stem} {page}", page, formats[0]) for page in pages]


def find_bit_depth(images: Iterable[SourceImage], camera: CameraFormat) -> tuple[int, str]:
    """Return the number of bits of samples in words of 16, and in words how they lie in them, empty for all 16.

    Samples of 10 to 14 bits lie in the lower bits, so that the brightest tells their number, or in the upper ones,
    where the step of the values does: those keep all 16. Raises BundleError.
    """
    from slrig.reconstruction import sample_format

    brightest, kept = 0, []
    for image in images:
        samples, colours = image.read(camera, coloured=True)
        brightest = max(brightest, int((samples if colours is None else colours).max()))
        kept.append(samples[:: max(1, len(samples) // _SAMPLED_ROWS)])
    step, full_scale = sample_format(kept, camera.full_scale)
    bits = next(each for each in _USUAL_BITS if brightest < 2**each)
    if step > 1:
        return bits, f"samples of {round(np.log2(full_scale / step + 1))} bits in steps of {step:g}, up to {brightest}"
    if bits == camera.bit_depth:
        return bits, ""
    return bits, f"samples up to {brightest}, taken as {bits} bits; if the camera has more, say --bit-depth"


def describe_mosaic(white: Pixels) -> str:
    """Return in words that an image in white light is a raw one of a colour sensor; empty for any other image.

    Behind a Bayer filter two sites of each block of 2 x 2 pixels, on a diagonal, are green and differ from the others.
    Grey sensors, and converted colours, have equal sites in the median over the bright blocks.
    """
    rows, columns = (side // 2 * 2 for side in white.shape)
    sites = [white[i:rows:2, j:columns:2].astype(np.float32) for i, j in ((0, 0), (1, 1), (0, 1), (1, 0))]
    mean = np.mean(sites, axis=0)
    is_bright = mean > np.median(mean)
    if not is_bright.any():
        return ""
    one, other, third, fourth = (float(np.median(site[is_bright] / mean[is_bright])) for site in sites)
    is_diagonal = min(abs(one - other), abs(third - fourth)) < _MAX_GREEN_DIFFERENCE
    if abs(one + other - third - fourth) < 2 * _MIN_MOSAIC or not is_diagonal:
        return ""
    return "raw samples of a colour sensor (Bayer), taken as grey: the mesh is as good, its colours are not"

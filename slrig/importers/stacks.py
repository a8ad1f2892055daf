"""Images in arrays of NumPy: .npy and .npz files."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import natural_sort_key, read_arrays
from slrig.errors import BundleError

STACKS = {".npy", ".npz"}
MAX_ARRAY_BYTES = 2**32

_WORD = 65535
_MIN_SIDE_PX = 16  # of images; smaller arrays are matrices


class ArrayImages(NamedTuple):
    """Images that are not image files, by their names within the file: (H, W) or (H, W, 3) of blue, green and red.

    is_stretched : samples of 8 bits or fractions fill all 16. summary : how the images were found. idle : names of
    images that may show what was there before or after the patterns.
    """

    images: Mapping[str, NDArray[Any]]
    is_stretched: bool
    summary: str = ""
    idle: Collection[str] = ()


def read_stack(path: Path) -> ArrayImages:
    """Return the images in a file of arrays, by key and number.

    An array is an image, (H, W) or (H, W, 3) of red, green and blue, or a stack of such along its first axis, or, grey,
    along a last one that is the shortest. Other arrays of an archive are ignored, and named in the summary.
    Raises BundleError: the file is damaged, or has no images.
    """
    try:
        arrays = read_arrays(path, MAX_ARRAY_BYTES)
    except (OSError, ValueError) as cause:
        message = f"{path}: expected arrays of numbers as np.save or np.savez write them, found {cause}; save it again"
        raise BundleError(message) from cause
    images: dict[str, NDArray[Any]] = {}
    others: list[str] = []
    for key in sorted(arrays, key=lambda each: natural_sort_key(Path(each))):
        parts = _split(arrays[key])
        if not parts:
            others.append(f"{key} {arrays[key].shape} {arrays[key].dtype}".strip())
            continue
        several = arrays[key].ndim > parts[0].ndim
        images |= {f"{key} {number}".strip() if several else key: part for number, part in enumerate(parts)}
    if not images:
        raise BundleError(
            f"{path}: expected arrays of numbers of shape (images, rows, columns), with 3 colours last or without, "
            f"found {', '.join(others) or 'none'}; save each camera as a file or key of its own"
        )
    samples, is_stretched = _as_samples(path, list(images.values()))
    summary = f"{path.name}: no images, ignored: {', '.join(others)}" if others else ""
    return ArrayImages(dict(zip(images, samples, strict=True)), is_stretched, summary)


def _split(array: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the images in an array, colours as blue, green and red; none if it is of something else."""
    shape = array.shape
    is_coloured = len(shape) in (3, 4) and shape[-1] == 3 and min(shape[-3:-1]) > 3
    if is_coloured:
        array = array[..., ::-1]
    elif len(shape) == 4 and shape[-1] == 1:
        array = array[..., 0]
    elif len(shape) == 3 and shape[2] < min(shape[:2]):
        array = np.moveaxis(array, 2, 0)
    dimensions = array.ndim - is_coloured
    images = [array] if dimensions == 2 else list(array) if dimensions == 3 else []
    is_large = bool(images) and min(images[0].shape[:2]) >= _MIN_SIDE_PX
    return images if is_large and array.dtype.kind in "buif" else []


def _as_samples(path: Path, images: Sequence[NDArray[Any]]) -> tuple[list[NDArray[Any]], bool]:
    """Return images as uint8 or uint16, and whether fractions were stretched to all 16 bits: of 1, or of 255.
    Raises BundleError: samples are negative, not finite or beyond 16 bits.
    """
    if all(image.dtype in (np.uint8, np.uint16) for image in images) and len({each.dtype for each in images}) == 1:
        return list(images), False
    if all(image.dtype.kind == "b" for image in images):
        return [image.astype(np.uint8) * np.uint8(255) for image in images], False
    least, most = min(float(image.min()) for image in images), max(float(image.max()) for image in images)
    if not (least >= 0 and most <= _WORD):
        message = f"{path}: expected samples from 0 to {_WORD}, found {least:g} to {most:g}; save those of the camera"
        raise BundleError(message)
    if all(image.dtype.kind != "f" or (image == np.rint(image)).all() for image in images):
        dtype = np.uint8 if most <= 255 else np.uint16
        return [image.astype(dtype) for image in images], False
    scale = _WORD if most <= 1 else 257 if most <= 255 else 1
    return [np.rint(image * float(scale)).astype(np.uint16) for image in images], scale > 1

"""Contents of the engine's flash, as listed in a file, and the pictures that a person writes into it.

The flash is written by TI's program (LightCrafter 4500 GUI, "Firmware": add pictures, build, upload), not by this
driver: a failed write may leave an engine that does not start. The list is `images.json`, next to the pictures:

    {"format": "slrig-dlpc350-images", "version": 1, "tag": "slrig-1a2b3c4d",
     "images": [{"flash_index": 0, "file": "slrig-1a2b3c4d-0.bmp", "sha256": "…", "planes": ["white", …]}]}

`flash_index` is the picture's position in the flash, `tag` the firmware tag given to TI's program (null: none). The
contents of a plane are read from the picture itself; `planes` describes them, and its length is the number of used
planes.

Plane n of a picture is bit n of green for n = 0 to 7, bit n - 8 of red up to 15, bit n - 16 of blue up to 23, the least
significant first: DLPU010, "Pattern Number Mapping", as copied at github.com/agmarrugo/bit-plane-image-coding; and the
LightCrafter 4500 user's guide (DLPU011), "Relationship Between Bit-Planes and 24-bit RGB Images". TI's program takes
pictures of 912 x 1140 pixels with 24 bits per pixel.

A pattern and its inverse share one plane, since the pattern table can invert. White, black, 8 Gray bits with their
inverses and 8 lines are 17 planes, one picture. Pictures are filled in the order of play, and a later one repeats a
pattern that returns (white): so each is loaded once, and two of them, 48 planes, are loaded before a sequence starts.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.pattern_engine.projector import Plane, describe_pattern, pattern_plane, plane_keys
from slrig.bundle import Strict, read_json, read_text, validate
from slrig.errors import ConfigError, StorageError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

MIRRORS = Size(912, 1140)
"""Columns and rows of the DLP4500, addressed as the controller addresses them."""
PLANES = 24

_FILE_HEADER = struct.Struct("<2sIHHI")
_PICTURE_HEADER = struct.Struct("<IiiHHIIiiII")
_CHANNELS = (1, 2, 0)
"""Positions of green, red and blue in a BMP's pixel."""


LIST_FILE = "images.json"
MAX_IMAGES = 64
"""Entries of the image table."""
EXPORT_FOLDER = "to_flash"
_MAX_LIST_BYTES = 1_000_000


def encode_picture(planes: Sequence[Plane]) -> bytes:
    """Return up to 24 planes as a BMP file of 24 bits per pixel; unused planes are dark."""
    pixels = np.zeros((*MIRRORS.shape, 3), np.uint8)
    for number, plane in enumerate(planes):
        pixels[..., _CHANNELS[number // 8]] |= plane.astype(np.uint8) << np.uint8(number % 8)
    # BMP rows run from the bottom up; 912 pixels of 3 bytes need no padding.
    data = pixels[::-1].tobytes()
    offset = _FILE_HEADER.size + _PICTURE_HEADER.size
    header = _PICTURE_HEADER.pack(40, MIRRORS.width_px, MIRRORS.height_px, 1, 24, 0, len(data), 2835, 2835, 0, 0)
    return _FILE_HEADER.pack(b"BM", offset + len(data), 0, 0, offset) + header + data


def decode_planes(picture: bytes, name: str) -> tuple[Plane, ...]:
    """Return the 24 planes of a BMP file. Raises ConfigError, naming it, unless it has 912 x 1140 pixels of 24 bits."""
    least = _FILE_HEADER.size + _PICTURE_HEADER.size
    kind, offset, width, height, bits, packing = b"", 0, 0, 0, 0, 0
    if len(picture) >= least:
        kind, _, _, _, offset = _FILE_HEADER.unpack_from(picture)
        _, width, height, _, bits, packing, *_ = _PICTURE_HEADER.unpack_from(picture, _FILE_HEADER.size)
    rows, columns = MIRRORS.shape
    size = rows * columns * 3
    fits = (kind, width, abs(height), bits, packing) == (b"BM", columns, rows, 24, 0)
    if not fits or len(picture) < offset + size:
        message = (
            f"{name}: expected a BMP file of {MIRRORS} pixels with 24 bits each, found {width} x {height} with {bits} "
            f"bits, {len(picture)} bytes; use the file that this driver wrote"
        )
        raise ConfigError(message)
    pixels = np.frombuffer(picture, np.uint8, size, offset).reshape(rows, columns, 3)
    upright: NDArray[Any] = pixels[::-1] if height > 0 else pixels
    channels = [np.ascontiguousarray(upright[..., channel]) for channel in _CHANNELS]
    return tuple(channels[number // 8] & np.uint8(1 << number % 8) != 0 for number in range(PLANES))


class _ImageEntry(Strict):
    flash_index: Annotated[int, Field(ge=0, lt=256)]
    file: Annotated[str, Field(min_length=1)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    planes: Annotated[list[str], Field(min_length=1, max_length=PLANES)]


class _ImageList(Strict):
    format: Literal["slrig-dlpc350-images"]
    version: Literal[1]
    tag: Annotated[str, Field(min_length=1, max_length=31)] | None = None
    images: Annotated[list[_ImageEntry], Field(max_length=MAX_IMAGES)]


@dataclass(frozen=True, slots=True)
class FlashedPlane:
    """Location of a pattern: the picture's index in the flash, the plane's number, and inversion."""

    image: int
    plane: int
    inverted: bool


@dataclass(frozen=True, slots=True)
class FlashedPicture:
    """One picture of the flash. numbers : plane number by the key of a plane; content : the BMP file."""

    flash_index: int
    content: bytes
    numbers: Mapping[bytes, int]
    planes: tuple[str, ...]

    def place(self, keys: tuple[bytes, bytes]) -> FlashedPlane | None:
        """Return the location of a plane or its inverse, given their keys; None if it is not here."""
        for inverted, key in enumerate(keys):
            if key in self.numbers:
                return FlashedPlane(self.flash_index, self.numbers[key], bool(inverted))
        return None


@dataclass(frozen=True, slots=True)
class FlashContents:
    """Contents of the flash. folder : of the list, which need not exist; tag : the firmware's, if known."""

    folder: Path
    tag: str | None = None
    pictures: tuple[FlashedPicture, ...] = ()

    def places(self, sequence: PatternSequence) -> tuple[FlashedPlane, ...]:
        """Return the location of each pattern, with as few changes of picture as possible. Raises
        UnsupportedByDeviceError if the flash lacks patterns; the message contains the remedy.
        """
        found = [self._candidates(pattern_plane(sequence, index)) for index in range(len(sequence))]
        missing = [index for index, candidates in enumerate(found) if not candidates]
        if missing:
            raise self._missing_error(sequence, missing)
        chosen: list[FlashedPlane] = []
        for index, candidates in enumerate(found):
            # Stay with the picture in the buffer; else choose the one that lasts longest.
            image = chosen[-1].image if chosen else -1
            if image not in candidates:
                image = max(candidates, key=lambda image: _run_length(found[index:], image))
            chosen.append(candidates[image])
        return tuple(chosen)

    def _candidates(self, plane: Plane) -> dict[int, FlashedPlane]:
        keys = plane_keys(plane)
        places = (picture.place(keys) for picture in self.pictures)
        return {place.image: place for place in places if place is not None}

    def _missing_error(self, sequence: PatternSequence, missing: Sequence[int]) -> UnsupportedByDeviceError:
        named = ", ".join(describe_pattern(sequence.patterns[index]) for index in missing[:3])
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        return UnsupportedByDeviceError(
            f"the engine's flash, as {self.folder / LIST_FILE} lists it, lacks {len(missing)} of {len(sequence)} "
            f"patterns ({named}{more}); flash it once with all patterns of this rig: slrig patterns RIG writes the "
            "pictures into "
            f"{self.folder / EXPORT_FOLDER}"
        )

    def write_patterns(self, sequence: PatternSequence) -> str:
        """Write pictures that hold a sequence, in addition to those in the flash; return the instructions. Raises as
        `write_pictures`.
        """
        written = write_pictures(self.folder / EXPORT_FOLDER, sequence, self.pictures)
        return (
            f"the pictures to flash are in {written.folder}: add them to the firmware with TI's LightCrafter 4500 "
            f'program, in the order of their numbers, with the firmware tag "{written.tag}", upload it, and set '
            "patterns in the [projector] table of the rig file to that folder"
        )


def _run_length(found: Sequence[Mapping[int, FlashedPlane]], image: int) -> int:
    """Number of consecutive patterns that are in a picture."""
    return next((count for count, candidates in enumerate(found) if image not in candidates), len(found))


def read_flash_list(folder: Path) -> FlashContents:
    """Read the list in a folder; without a list, return an empty flash. Raises ConfigError if the list has faults, or a
    picture does not match it.
    """
    path = folder / LIST_FILE
    if not path.exists():
        return FlashContents(folder)
    data = read_json(read_text(path, _MAX_LIST_BYTES, ConfigError), path, ConfigError)
    listed = validate(_ImageList, data, f"{path}: the list of the flashed pictures")
    indices = [image.flash_index for image in listed.images]
    if len(set(indices)) != len(indices):
        message = f"{path}: expected each flash_index once, found {indices}; correct the list"
        raise ConfigError(message)
    return FlashContents(folder, listed.tag, tuple(_read_picture(folder, image) for image in listed.images))


def _read_picture(folder: Path, image: _ImageEntry) -> FlashedPicture:
    path = folder / image.file
    try:
        content = path.read_bytes()
    except OSError as error:
        message = f"{path}: {LIST_FILE} names this picture, found: {error.strerror}; copy it there"
        raise ConfigError(message) from error
    if hashlib.sha256(content).hexdigest() != image.sha256:
        message = (
            f"{path}: this is not the picture that {LIST_FILE} lists (SHA-256 differs): the contents of the flash are "
            "unknown; copy the folder again, or write and flash new pictures"
        )
        raise ConfigError(message)
    return _build_picture(image.flash_index, content, tuple(image.planes), str(path))


def _build_picture(flash_index: int, content: bytes, planes: tuple[str, ...], name: str) -> FlashedPicture:
    numbers: dict[bytes, int] = {}
    for number, plane in enumerate(decode_planes(content, name)[: len(planes)]):
        numbers.setdefault(plane_keys(plane)[0], number)
    return FlashedPicture(flash_index, content, numbers, planes)


def write_pictures(folder: Path, sequence: PatternSequence, others: Sequence[FlashedPicture] = ()) -> FlashContents:
    """Write pictures with every pattern of a sequence, and their list, for TI's program.

    Parameters
    ----------
    folder
        Created if necessary; an existing list is replaced.
    sequence
        For 912 x 1140 mirrors.
    others
        Pictures that stay in the flash: they keep their positions, the new ones follow.

    Raises
    ------
    UnsupportedByDeviceError
        A pattern has shades of grey, or there are too many pictures.
    StorageError
        The files could not be written.
    """
    first = max((picture.flash_index for picture in others), default=-1) + 1
    made = [
        _build_picture(
            first + number, encode_picture([plane for plane, _ in group]), tuple(word for _, word in group), "made"
        )
        for number, group in enumerate(_group_planes(sequence))
    ]
    pictures = (*others, *made)
    if len(pictures) > MAX_IMAGES:
        message = (
            f"{len(made)} pictures in addition to the {len(others)} in the flash exceed its limit of {MAX_IMAGES}; "
            "start again: set patterns in the rig file to an empty folder"
        )
        raise UnsupportedByDeviceError(message)
    together = hashlib.sha256(b"".join(picture.content for picture in pictures)).hexdigest()
    tag = f"slrig-{together[:8]}"
    entries = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for picture in pictures:
            file = f"{tag}-{picture.flash_index}.bmp"
            (folder / file).write_bytes(picture.content)
            digest = hashlib.sha256(picture.content).hexdigest()
            entries.append(
                {"flash_index": picture.flash_index, "file": file, "sha256": digest, "planes": list(picture.planes)}
            )
        listed = {"format": "slrig-dlpc350-images", "version": 1, "tag": tag, "images": entries}
        (folder / LIST_FILE).write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        message = f"{folder}: cannot write pictures for the engine's flash ({error.strerror}); make room there"
        raise StorageError(message) from error
    return FlashContents(folder, tag, pictures)


def _group_planes(sequence: PatternSequence) -> list[list[tuple[Plane, str]]]:
    """Group planes into pictures: each holds all patterns from its first to its last one in the order of play."""
    groups: list[list[tuple[Plane, str]]] = [[]]
    contained: set[bytes] = set()
    for index, pattern in enumerate(sequence.patterns):
        plane = pattern_plane(sequence, index)
        keys = plane_keys(plane)
        if not contained.isdisjoint(keys):
            continue
        if len(groups[-1]) == PLANES:
            groups.append([])
            contained = set()
        contained.update(keys)
        groups[-1].append((plane, describe_pattern(pattern)))
    return groups

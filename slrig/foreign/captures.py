"""A folder of another program's images becomes a scan bundle: which camera, which pattern, one extent and depth."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slrig.bundle.calibration import check_calibration
from slrig.bundle.description import MOST_CAMERA_PX
from slrig.bundle.images import frame_format, read_with_colour
from slrig.bundle.storage import natural
from slrig.bundle.validation import read_text
from slrig.bundle.writing import BundleWriter
from slrig.disk import refusals_of
from slrig.errors import BundleError
from slrig.foreign.calibrations import read_any_calibration
from slrig.foreign.layouts import (
    Code,
    name_pattern,
    opencv_sequence,
    pattern_of_name,
    scan3d_sequence,
    slstudio_sequence,
)
from slrig.model import Axis, Black, CameraFormat, Gray, Pattern, Pixels, Shot, Size, White

IMAGES = {".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg"}
CALIBRATIONS = ("calibration.yml", "calibration.yaml", "calibration.xml", "calibration.json")
MOST_LIST_BYTES = 2**20
_DIFFERS = 0.02
"""Of full scale: by as much white and black differ where the projector's light falls."""
_FEWEST, _CLEARLY = 0.002, 0.98
"""Share of pixels that have to differ at all, and of those that have to differ the same way."""
_LEAST_OF_16_BITS = 2**14


@dataclass(frozen=True, slots=True)
class Naming:
    """How images are told apart: a program's own order, an order in words, a template of names, or a list file."""

    program: str | None = None
    order: str | None = None
    names: str | None = None
    white: str | None = None
    black: str | None = None
    listed: Path | None = None


@dataclass(slots=True)
class Imported:
    """What was found. left_out : names of images that no pattern is known of."""

    cameras: dict[str, list[tuple[Path, Pattern]]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def import_capture(
    folder: Path,
    output: Path,
    code: Code,
    naming: Naming,
    *,
    names: Sequence[str] = (),
    bit_depth: int | None = None,
    calibration_file: Path | None = None,
) -> tuple[Imported, Path | None]:
    """Write the images of `folder` as the bundle `output`; returns what was found, and the calibration that was used.

    names : of the cameras, in the natural order of what they are called in the folder. bit_depth : of samples in files
    of 16 bits. Raises BundleError, PatternError, CalibrationError: what was expected and found; StorageError.
    """
    with refusals_of(folder):
        found = _found(folder, code, naming)
    if names:
        if len(names) != len(found.cameras):
            have = ", ".join(found.cameras)
            raise BundleError(f"{folder}: expected {len(found.cameras)} names of cameras ({have}), found {len(names)}")
        found.cameras = dict(zip(names, found.cameras.values(), strict=True))
    formats = {name: _one_format(files, bit_depth) for name, files in found.cameras.items()}
    sizes = {name: each.size for name, each in formats.items()}
    beside = next((folder / each for each in CALIBRATIONS if (folder / each).is_file()), None)
    path, calibration = calibration_file or beside, None
    if path is not None:
        calibration = read_any_calibration(path, cameras=sizes, projector=code.size, shown=_shown_bits(found))
        check_calibration(calibration, code.size, sizes, str(path))
    patterns = list(dict.fromkeys(pattern for files in found.cameras.values() for _, pattern in files))
    with BundleWriter(output, code.size, patterns, formats, calibration) as writer:
        for name, files in found.cameras.items():
            _write_camera(writer, name, files, formats[name], patterns, told=bit_depth is not None)
    return found, path


def _found(folder: Path, code: Code, naming: Naming) -> Imported:
    if not folder.is_dir():
        raise BundleError(f"{folder}: expected a folder of images, found none; check the path")
    if naming.listed is not None:
        return _from_list(folder, code, naming.listed)
    if naming.names is not None:
        return _by_names(folder, code, naming)
    found = Imported()
    for name, files in _by_camera(folder).items():
        try:
            patterns = _sequence(code, naming, files)
        except BundleError as cause:
            raise BundleError(f"{folder}, {name}: {cause}") from cause
        if len(patterns) != len(files):
            raise BundleError(
                f"{folder}, {name}: expected {len(patterns)} images of '{naming.order}' on a projector of {code.size}, "
                f"found {len(files)} ({files[0].name} to {files[-1].name}); correct --pattern or --projector"
            )
        found.cameras[name] = list(zip(files, patterns, strict=True))
    return found


def _sequence(code: Code, naming: Naming, files: Sequence[Path]) -> list[Pattern]:
    if naming.order is not None:
        return code.sequence(naming.order)
    count = len(files)
    if naming.program == "opencv":
        form = frame_format(files[0])
        # Whoever saved the images chose where white and black stand, and which comes first.
        for ends_first, pair in ((False, files[-2:]), (True, files[:2])):
            images = [_read(each, form) for each in pair]
            brighter = _first_is_brighter(images[0], images[-1], form.full_scale)
            if brighter is not None:
                ends: tuple[Pattern, ...] = (White(), Black()) if brighter else (Black(), White())
                return opencv_sequence(code, count, ends, ends_first=ends_first)
        return opencv_sequence(code, count, (), ends_first=False)
    return (scan3d_sequence if naming.program == "scan3d" else slstudio_sequence)(code, count)


def _by_camera(folder: Path) -> dict[str, list[Path]]:
    """Images in natural order, by subfolder, or by what their names have before the last number."""
    images = _images(folder)
    if not images:
        inside = sorted((each for each in folder.iterdir() if each.is_dir() and each.name[0] != "."), key=natural)
        found = {each.name: files for each in inside if (files := _images(each))}
        if not found:
            raise BundleError(f"{folder}: expected images ({', '.join(sorted(IMAGES))}), found none in it or below it")
        return found
    groups: dict[str, list[Path]] = {}
    for image in images:
        groups.setdefault(re.sub(r"\d+\D*$", "", image.stem), []).append(image)
    if len(groups) == 1:
        return {"cam0": images}
    return {re.sub(r"[^A-Za-z0-9_-]+", "-", prefix).strip("_-") or "cam0": each for prefix, each in groups.items()}


def _images(folder: Path) -> list[Path]:
    found = (each for each in folder.iterdir() if each.suffix.lower() in IMAGES and each.name[0] != ".")
    return sorted(found, key=natural)


def _by_names(folder: Path, code: Code, naming: Naming) -> Imported:
    bit_names = name_pattern(str(naming.names))
    templates: tuple[tuple[str | None, Pattern], ...] = ((naming.white, White()), (naming.black, Black()))
    ends = [(name_pattern(template), pattern) for template, pattern in templates if template is not None]
    found = Imported()
    for image in sorted((each for each in folder.rglob("*") if each.suffix.lower() in IMAGES), key=str):
        name = image.relative_to(folder).as_posix()
        known = [(match, pattern) for each, pattern in ends if (match := each.fullmatch(name))]
        if match := bit_names.fullmatch(name):
            known.append((match, pattern_of_name(code, match)))
        if not known:
            found.left_out.append(name)
            continue
        named, pattern = known[0]
        found.cameras.setdefault(named.groupdict().get("camera") or "cam0", []).append((image, pattern))
    if not found.cameras:
        some = ", ".join(found.left_out[:5]) or "no image"
        raise BundleError(f"{folder}: expected images called as {naming.names}, found {some}; correct --names")
    _require_whole(folder, found)
    return found


def _from_list(folder: Path, code: Code, path: Path) -> Imported:
    """Images of a CSV file with the columns file, pattern and, where there are several, camera."""
    rows = csv.DictReader(read_text(path, MOST_LIST_BYTES, BundleError).splitlines(), skipinitialspace=True)
    columns = set(rows.fieldnames or ())
    if not {"file", "pattern"} <= columns <= {"file", "pattern", "camera"}:
        raise BundleError(f"{path}: expected the columns file, pattern and camera, found {', '.join(sorted(columns))}")
    found = Imported()
    for number, row in enumerate(rows, 2):
        if None in row or row["pattern"] is None:
            raise BundleError(f"{path}: expected {len(columns)} cells in line {number}, found others; correct it")
        try:
            pattern = code.of_words(row["pattern"])
        except BundleError as cause:
            raise BundleError(f"{path}, line {number}: {cause}") from cause
        found.cameras.setdefault(row.get("camera") or "cam0", []).append((folder / row["file"], pattern))
    if not found.cameras:
        raise BundleError(f"{path}: expected a line for each image, found none")
    _require_whole(folder, found)
    return found


def _require_whole(folder: Path, found: Imported) -> None:
    """Refuse a bit that is missing before one that is there, and a pattern of which a camera has two images."""
    for name, files in found.cameras.items():
        patterns = [pattern for _, pattern in files]
        twice = next((path for path, each in files if isinstance(each, Gray) and patterns.count(each) > 1), None)
        if twice is not None:
            raise BundleError(f"{folder}, {name}: expected one image for each bit, found two, one of them {twice.name}")
        for axis in Axis:
            bits = {each.bit for each in patterns if isinstance(each, Gray) and each.axis is axis}
            missing = sorted(set(range(max(bits, default=-1))) - bits)
            if missing:
                have, lack = max(bits), ", ".join(map(str, missing))
                raise BundleError(
                    f"{folder}, {name}: expected an image of each bit of the {axis} code from 0 to {have}, found none "
                    f"of bit {lack}; copy the missing ones, or correct the names"
                )


def _one_format(files: Sequence[tuple[Path, Pattern]], bit_depth: int | None) -> CameraFormat:
    first = frame_format(files[0][0])
    if first.size.width_px * first.size.height_px > MOST_CAMERA_PX:
        raise BundleError(
            f"{files[0][0]}: expected at most {MOST_CAMERA_PX} pixels, found {first.size}; crop the images"
        )
    for path, _ in files:
        each = frame_format(path)
        if each != first:
            raise BundleError(
                f"{path}: expected {first.size} of {first.bit_depth} bits as {files[0][0].name}, found {each.size} of "
                f"{each.bit_depth} bits; all images of a camera have one extent and depth"
            )
    if bit_depth is not None and (bit_depth > first.bit_depth or (bit_depth <= 8) != (first.bit_depth <= 8)):
        message = f"{files[0][0]}: expected --bit-depth to fit samples of {first.bit_depth} bits, found {bit_depth}"
        raise BundleError(message)
    return CameraFormat(first.size, bit_depth or first.bit_depth)


def _read(path: Path, form: CameraFormat) -> Pixels:
    return read_with_colour(path, (0,), form)[0][0]


def _write_camera(
    writer: BundleWriter,
    name: str,
    files: Sequence[tuple[Path, Pattern]],
    form: CameraFormat,
    patterns: Sequence[Pattern],
    *,
    told: bool,
) -> None:
    ends: dict[str, tuple[Path, Pixels]] = {}
    brightest = 0
    for path, pattern in files:
        coloured = (0,) if isinstance(pattern, White | Black) else ()
        grey, colour = read_with_colour(path, (0,), form, coloured=coloured)
        writer.add(Shot(patterns.index(pattern), name, grey[0], colour=colour.get(0)))
        brightest = max(brightest, int(grey[0].max()))
        if isinstance(pattern, White | Black):
            ends[pattern.kind] = (path, grey[0])
    if form.bit_depth > 8 and not told and brightest < _LEAST_OF_16_BITS:
        raise BundleError(
            f"{files[0][0].parent}, {name}: expected samples over all of 16 bits, found {brightest} at most: what "
            "is saturated cannot be told; say how many bits the camera has, as --bit-depth 12"
        )
    if len(ends) == 2:
        (white, lit), (black, dark) = ends["white"], ends["black"]
        if not _first_is_brighter(lit, dark, form.full_scale):
            raise BundleError(
                f"{white}: expected white, and {black.name} black, found it not brighter wherever they differ; correct "
                "the order. These may be phase shifts, which are not read: slrig takes Gray codes and shifted lines"
            )


def _first_is_brighter(first: Pixels, second: Pixels, full_scale: int) -> bool | None:
    """Whether one of two images is brighter wherever they differ; None where it is here the one, there the other."""
    difference = first.astype(np.int32) - second
    differs = np.abs(difference) > _DIFFERS * full_scale
    if differs.mean() < _FEWEST:
        return None
    share = float((difference[differs] > 0).mean())
    return True if share >= _CLEARLY else False if share <= 1 - _CLEARLY else None


def _shown_bits(found: Imported) -> Mapping[Axis, Gray]:
    """A bit of the code of each axis that was shown."""
    return {p.axis: p for files in found.cameras.values() for _, p in files if isinstance(p, Gray)}


def parse_size(words: str) -> Size:
    """The extent that `1024x768` names. Raises BundleError."""
    sides = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", words.casefold())
    if sides is None:
        raise BundleError(f"--projector: expected columns x rows as 1024x768, found {words[:40]!r}; correct it")
    return Size(int(sides[1]), int(sides[2]))

"""Import of a folder of images of another program as a scan bundle."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slrig.bundle import (
    MAX_CAMERA_PX,
    BundleWriter,
    check_calibration,
    read_text,
    write_file,
)
from slrig.capture import Evidence
from slrig.disk import storage_errors
from slrig.errors import BundleError, PatternError
from slrig.importers.calibrations import import_calibration
from slrig.importers.coded_images import CodedImages
from slrig.importers.exif import read_focal_px
from slrig.importers.folders import UnderstoodFolder, group_by_prefix, groupings, list_subfolders, understand_folder
from slrig.importers.images import (
    SourceImage,
    describe_mosaic,
    find_bit_depth,
    list_images,
    list_images_below,
    without_idle_ends,
)
from slrig.importers.orders import (
    ProjectorCode,
    compile_name_template,
    opencv_sequence,
    pattern_from_name,
    pattern_words,
    scan3d_sequence,
    slstudio_micro_sequence,
    slstudio_sequence,
)
from slrig.model import Axis, Black, CameraFormat, Gray, LengthUnit, Pattern, Pixels, Shot, Size, White
from slrig.patterns import gray_bits

CALIBRATIONS = tuple(f"calibration.{each}" for each in ("yml", "yaml", "xml", "json", "npz", "mat"))
MAX_LIST_BYTES = 2**20

_STRONG = 0.5  # of the difference that 1 % of the pixels exceed
_MIN_AGREEING_FRACTION = 0.98  # of the strongly differing pixels, brighter in the same image
_MAX_EXPLAINED = 2  # images of a known order that show another pattern: a copy, or two exchanged ones


@dataclass(frozen=True, slots=True)
class ImageNaming:
    """Source of each image's pattern: a program's order, an order as text, a template of file names, or a list file;
    without any, the images themselves.
    """

    program: str | None = None
    order: str | None = None
    names: str | None = None
    white: str | None = None
    black: str | None = None
    listed: Path | None = None


@dataclass(slots=True)
class ImageAssignment:
    """Images of each camera with their patterns. unassigned : names of images without a known pattern. faults : images
    that contradict one another, each cause once. notes : how stacks, videos and samples were taken. calibration_notes :
    what was read from the calibration's file. understood : what the images show, where they themselves tell it.
    """

    cameras: dict[str, list[tuple[SourceImage, Pattern]]] = field(default_factory=dict)
    unassigned: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    calibration_notes: tuple[str, ...] = ()
    understood: UnderstoodFolder | None = None


def assign_images(folder: Path, code: ProjectorCode, naming: ImageNaming) -> ImageAssignment:
    """Return which pattern each image of a folder shows. Raises BundleError, PatternError: images or naming do not fit;
    StorageError.
    """
    with storage_errors(folder):
        return _assign_images(folder, code, naming)


def import_capture(
    folder: Path,
    output: Path,
    code: ProjectorCode,
    images: ImageAssignment,
    *,
    names: Sequence[str] = (),
    bit_depth: int | None = None,
    calibration_file: Path | None = None,
    unit: LengthUnit | None = None,
    keys: Sequence[str] = (),
) -> Path | None:
    """Write the images of `folder`, or of a file of several, as the bundle `output`; return the calibration file that
    was used.

    The images are checked against one another. Those that contradict are named, and reconstruction does not use what is
    proven wrong; if they do not come in the order of their patterns, nothing is written.

    names : new names of the cameras, in the natural order of their names in the folder. bit_depth : of samples in
    files with 16 bits. unit, keys : as for `import_calibration`.

    Raises BundleError, PatternError, CalibrationError: the images, the naming or the calibration do not fit;
    StorageError.
    """
    if names:
        if len(names) != len(images.cameras):
            known = ", ".join(images.cameras)
            message = f"{folder}: expected {len(images.cameras)} names of cameras ({known}), found {len(names)}"
            raise BundleError(message)
        images.cameras = dict(zip(names, images.cameras.values(), strict=True))
    drop_constant_bits(images, code.size)
    formats = {}
    for name, files in images.cameras.items():
        formats[name], note = _common_format(files, bit_depth)
        images.notes += [f"{name}: {note}"] if note else []
    sizes = {name: each.size for name, each in formats.items()}
    default_file = next((_home(folder) / each for each in CALIBRATIONS if (_home(folder) / each).is_file()), None)
    path, calibration = calibration_file or default_file, None
    if path is not None:
        bits = {p.axis: p for files in images.cameras.values() for _, p in files if isinstance(p, Gray)}
        capture = CodedImages(images.cameras, formats, code.size, lambda image, form: image.read(form)[0])
        read = import_calibration(
            path, cameras=sizes, projector=code.size, bits=bits, capture=capture, unit=unit, keys=keys
        )
        calibration, images.calibration_notes = read.calibration, read.notes
        check_calibration(calibration, code.size, sizes, str(path))
    patterns = list(dict.fromkeys(pattern for files in images.cameras.values() for _, pattern in files))
    stated = {name: read_focal_px(files[0][0].path, formats[name].size) for name, files in images.cameras.items()}
    focal_px = {name: round(px, 1) for name, px in stated.items() if px is not None}
    images.notes += [f"{name}: its pictures state a focal length of {px:.0f} px" for name, px in focal_px.items()]
    with BundleWriter(output, code.size, patterns, formats, calibration, focal_px=focal_px) as writer:
        for name, files in images.cameras.items():
            images.faults += _write_camera(writer, name, files, formats[name], patterns)
            white = next((image for image, pattern in files if isinstance(pattern, White)), None)
            mosaic = describe_mosaic(white.read(formats[name])[0]) if white else ""
            images.notes += [f"{name}: {mosaic}"] if mosaic else []
    return path


def _home(source: Path) -> Path:
    """Return the folder of a source of images: itself, or that of a file of several."""
    return source if source.is_dir() else source.parent


def drop_constant_bits(images: ImageAssignment, size: Size) -> None:
    """Leave out the first bits of a code that has more than the projector's cells need: they are dark everywhere, and
    the others are those of the shorter code.
    """
    for name, files in images.cameras.items():
        kept: list[tuple[SourceImage, Pattern]] = []
        for image, pattern in files:
            if isinstance(pattern, Gray):
                needed = gray_bits(size.along(pattern.axis), pattern.cell_px, pattern.offset_px)
                more = max(pattern.bits - needed, 0)
                if pattern.bit < more:
                    images.notes.append(
                        f"{image.name}: left out, bit {pattern.bit} of {pattern.bits} is the same on all "
                        f"{size.along(pattern.axis)} {pattern.axis}s"
                    )
                    continue
                pattern = replace(pattern, bit=pattern.bit - more, bits=pattern.bits - more)
            kept.append((image, pattern))
        images.cameras[name] = kept


def _assign_images(folder: Path, code: ProjectorCode, naming: ImageNaming) -> ImageAssignment:
    if not folder.exists():
        raise BundleError(f"{folder}: expected a folder of images, or a file of several, found none; check the path")
    if naming.listed is not None:
        return _assign_from_list(folder, code, naming.listed)
    if naming.names is not None:
        return _assign_by_names(folder, code, naming)
    images, notes = list_images(folder)
    if not images:
        groups, notes = list_subfolders(folder)
    if naming.program is None and naming.order is None:
        assigned = _assign_by_looks(folder, code, images, {} if images else groups)
    else:
        assigned = _assign_by_order(folder, code, naming, group_by_prefix(images) if images else groups)
    assigned.notes = notes
    return assigned


def _assign_by_looks(
    folder: Path, code: ProjectorCode, images: Sequence[SourceImage], subfolders: dict[str, list[SourceImage]]
) -> ImageAssignment:
    """Find what images show; a known order of so many images counts where they do not contradict it."""
    known: ImageAssignment | None = None
    with suppress(BundleError, PatternError):
        known = _assign_by_order(folder, code, ImageNaming("opencv"), group_by_prefix(images) if images else subfolders)
    groups = groupings(images) if images else iter([subfolders])
    try:
        found = understand_folder(groups, code.size, cell_px=code.stated_cell_px, offset_px=code.stated_offset_px)
    except BundleError as cause:
        raise BundleError(f"{folder}: {cause}") from cause
    if known is not None and _fits(known, found):
        return known
    return ImageAssignment(found.assigned, [each.image.name for each in found.alone], understood=found)


def _fits(known: ImageAssignment, found: UnderstoodFolder) -> bool:
    """True if images show what a known order says, except a few that show the pattern of another image."""
    shown = {path: pattern for files in found.assigned.values() for path, pattern in files}
    differing = {path for files in known.cameras.values() for path, pattern in files if shown.get(path) != pattern}
    return differing <= found.faults and len(differing) <= _MAX_EXPLAINED


def _assign_by_order(
    folder: Path, code: ProjectorCode, naming: ImageNaming, groups: dict[str, list[SourceImage]]
) -> ImageAssignment:
    assigned = ImageAssignment()
    single = [files[0].name for files in groups.values() if len(files) == 1]
    if len(single) == len(groups) > 2:
        raise BundleError(
            f"{folder}: {len(single)} cameras of one image each: {single[0]}, {single[1]} … differ before their last "
            "number; say where a name has the camera and the number, as --names '*_{number}_{camera}.png'"
        )
    for name, files in groups.items():
        assigned.cameras[name], left_out = _assign_in_order(f"{folder}, {name}", code, naming, files)
        assigned.unassigned += left_out
    return assigned


def _assign_in_order(
    place: str, code: ProjectorCode, naming: ImageNaming, images: Sequence[SourceImage]
) -> tuple[list[tuple[SourceImage, Pattern]], list[str]]:
    """Return the images of a camera with their patterns, and the names of idle images that were left out."""
    faults = []
    for files in without_idle_ends(images):
        try:
            patterns = _pattern_sequence(code, naming, files)
        except BundleError as cause:
            faults.append(BundleError(f"{place}: {cause}"))
            continue
        if len(patterns) == len(files):
            return list(zip(files, patterns, strict=True)), [each.name for each in images if each not in files]
        message = (
            f"{place}: expected {len(patterns)} images of '{naming.order}' on a projector of {code.size}, "
            f"found {len(files)} ({files[0].name} to {files[-1].name}); correct --pattern or --projector"
        )
        faults.append(BundleError(message))
    raise faults[0]


def _pattern_sequence(code: ProjectorCode, naming: ImageNaming, files: Sequence[SourceImage]) -> list[Pattern]:
    if naming.order is not None:
        return code.parse_sequence(naming.order)
    count = len(files)
    if naming.program == "opencv":
        form = files[0].read_format()
        # OpenCV leaves the place and order of white and black to the program that saves the images.
        for references_first, pair in ((False, files[-2:]), (True, files[:2])):
            images = [each.read(form)[0] for each in pair]
            brighter = _first_is_brighter(images[0], images[-1])
            if brighter is not None:
                references: tuple[Pattern, ...] = (White(), Black()) if brighter else (Black(), White())
                return opencv_sequence(code, count, references, references_first=references_first)
        # With white and black elsewhere the images are shifted, which their comparison names.
        with suppress(BundleError):
            return opencv_sequence(code, count, (White(), Black()), references_first=False)
        return opencv_sequence(code, count, (), references_first=False)
    orders = {"scan3d": scan3d_sequence, "slstudio": slstudio_sequence, "slstudio-micro": slstudio_micro_sequence}
    return orders[naming.program or "opencv"](code, count)


def _assign_by_names(folder: Path, code: ProjectorCode, naming: ImageNaming) -> ImageAssignment:
    bit_names = compile_name_template(str(naming.names))
    if "number" in bit_names.groupindex:
        return _assign_by_numbers(folder, code, bit_names, str(naming.names))
    templates: tuple[tuple[str | None, Pattern], ...] = ((naming.white, White()), (naming.black, Black()))
    references = [(compile_name_template(template), pattern) for template, pattern in templates if template is not None]
    images, notes = list_images_below(folder)
    assigned = ImageAssignment(notes=notes)
    for image in sorted(images, key=lambda each: str(each.place)):
        name = image.place.relative_to(_home(folder)).as_posix()
        matches = [(match, pattern) for each, pattern in references if (match := each.fullmatch(name))]
        if match := bit_names.fullmatch(name):
            matches.append((match, pattern_from_name(code, match)))
        if not matches:
            assigned.unassigned.append(name)
            continue
        match, pattern = matches[0]
        assigned.cameras.setdefault(match.groupdict().get("camera") or "cam0", []).append((image, pattern))
    if not assigned.cameras:
        found = ", ".join(assigned.unassigned[:5]) or "no image"
        raise BundleError(f"{folder}: expected images called as {naming.names}, found {found}; correct --names")
    _require_complete_codes(folder, assigned)
    return assigned


def _assign_by_numbers(folder: Path, code: ProjectorCode, numbered: re.Pattern[str], template: str) -> ImageAssignment:
    """Find what images show that names put in order, by camera."""
    groups: dict[str, list[tuple[int, SourceImage]]] = {}
    unassigned = []
    images, notes = list_images_below(folder)
    for image in sorted(images, key=lambda each: str(each.place)):
        name = image.place.relative_to(_home(folder)).as_posix()
        if match := numbered.fullmatch(name):
            groups.setdefault(match.groupdict().get("camera") or "cam0", []).append((int(match["number"]), image))
        else:
            unassigned.append(name)
    if not groups:
        found = ", ".join(unassigned[:5]) or "no image"
        raise BundleError(f"{folder}: expected images called as {template}, found {found}; correct --names")
    ordered = {
        name: [image for _, image in sorted(files, key=lambda each: (each[0], each[1].name))]
        for name, files in groups.items()
    }
    understood = understand_folder([ordered], code.size, cell_px=code.stated_cell_px, offset_px=code.stated_offset_px)
    return ImageAssignment(understood.assigned, unassigned, notes=notes, understood=understood)


def _assign_from_list(folder: Path, code: ProjectorCode, path: Path) -> ImageAssignment:
    """Read a CSV file with the columns file, pattern and, for several cameras, camera."""
    rows = csv.DictReader(read_text(path, MAX_LIST_BYTES, BundleError).splitlines(), skipinitialspace=True)
    columns = set(rows.fieldnames or ())
    if not {"file", "pattern"} <= columns <= {"file", "pattern", "camera"}:
        raise BundleError(f"{path}: expected the columns file, pattern and camera, found {', '.join(sorted(columns))}")
    assigned = ImageAssignment()
    parts: dict[Path, SourceImage] = {}
    for number, row in enumerate(rows, 2):
        if None in row or row["pattern"] is None:
            raise BundleError(f"{path}: expected {len(columns)} cells in line {number}, found others; correct it")
        try:
            pattern = code.parse_pattern(row["pattern"])
        except BundleError as cause:
            raise BundleError(f"{path}, line {number}: {cause}") from cause
        place = _home(folder) / row["file"]
        if not parts and not place.is_file():
            images, assigned.notes = list_images_below(folder)
            parts = {image.place: image for image in images}
        image = parts.get(place) or SourceImage.from_file(place)
        assigned.cameras.setdefault(row.get("camera") or "cam0", []).append((image, pattern))
    if not assigned.cameras:
        raise BundleError(f"{path}: expected a line for each image, found none")
    _require_complete_codes(folder, assigned)
    return assigned


def write_list(path: Path, folder: Path, images: ImageAssignment) -> None:
    """Write the pattern of each image as a list file. Raises StorageError."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("file", "pattern", "camera"))
    for camera, files in images.cameras.items():
        rows.writerows(
            (image.place.relative_to(_home(folder)).as_posix(), pattern_words(pattern), camera)
            for image, pattern in files
        )
    write_file(path, text.getvalue().encode())


def _require_complete_codes(folder: Path, assigned: ImageAssignment) -> None:
    """Reject a code that lacks a bit coarser than its finest one, and two images of one bit."""
    for name, files in assigned.cameras.items():
        patterns = [pattern for _, pattern in files]
        duplicate = next((path for path, each in files if isinstance(each, Gray) and patterns.count(each) > 1), None)
        if duplicate is not None:
            message = f"{folder}, {name}: expected one image for each bit, found two, one of them {duplicate.name}"
            raise BundleError(message)
        for axis in Axis:
            bits = {each.bit for each in patterns if isinstance(each, Gray) and each.axis is axis}
            missing = sorted(set(range(max(bits, default=-1))) - bits)
            if missing:
                raise BundleError(
                    f"{folder}, {name}: expected an image of each bit of the {axis} code from 0 to {max(bits)}, found "
                    f"none of bit {', '.join(map(str, missing))}; copy the missing ones, or correct the names"
                )


def _common_format(files: Sequence[tuple[SourceImage, Pattern]], bit_depth: int | None) -> tuple[CameraFormat, str]:
    """Return the format of all images of a camera, and how their samples lie in words of 16 bits, if not as usual."""
    image = files[0][0]
    first = image.read_format()
    if first.size.width_px * first.size.height_px > MAX_CAMERA_PX:
        message = f"{image.place}: expected at most {MAX_CAMERA_PX} pixels, found {first.size}; crop the images"
        raise BundleError(message)
    for other, _ in files:
        each = other.read_format()
        if each != first:
            raise BundleError(
                f"{other.place}: expected {first.size} of {first.bit_depth} bits as {image.name}, found {each.size} of "
                f"{each.bit_depth} bits; all images of a camera have one extent and depth"
            )
    if bit_depth is not None and (bit_depth > first.bit_depth or (bit_depth <= 8) != (first.bit_depth <= 8)):
        message = f"{image.place}: expected --bit-depth to fit samples of {first.bit_depth} bits, found {bit_depth}"
        raise BundleError(message)
    if bit_depth is not None or first.bit_depth == 8 or image.is_stretched:
        return CameraFormat(first.size, bit_depth or first.bit_depth), ""
    found, note = find_bit_depth((each for each, _ in files), first)
    return CameraFormat(first.size, found), note


def _write_camera(
    writer: BundleWriter,
    name: str,
    files: Sequence[tuple[SourceImage, Pattern]],
    form: CameraFormat,
    patterns: Sequence[Pattern],
) -> tuple[str, ...]:
    """Write the images of a camera; return how they contradict one another, each cause once. Raises BundleError."""
    first = {pattern: image for image, pattern in reversed(files)}
    shown = list(dict.fromkeys(pattern for _, pattern in files))
    evidence = Evidence(shown, {name: form}, frame_names={name: [f"image {first[pattern].name}" for pattern in shown]})
    reference_frames: dict[str, tuple[SourceImage, Pixels]] = {}
    # White and black come first, so that the other images need not wait for them.
    references: tuple[White | Black, ...] = (White(), Black())
    for reference in (each for each in references if each in first):
        grey, _ = first[reference].read(form)
        reference_frames[reference.kind] = (first[reference], grey)
        evidence.add_shot(Shot(shown.index(reference), name, grey))
    for image, pattern in files:
        is_reference = isinstance(pattern, White | Black)
        grey, colour = image.read(form, coloured=is_reference)
        writer.add(Shot(patterns.index(pattern), name, grey, colour=colour))
        if image is first[pattern] and not is_reference:
            evidence.add_shot(Shot(shown.index(pattern), name, grey))
    summary = evidence.summary()
    if summary.misordered is not None:
        raise BundleError(
            f"{files[0][0].path.parent}: {summary.misordered}; rename the images in the order of their patterns, or "
            "list them with --list"
        )
    if len(reference_frames) == 2:
        (white, lit), (black, dark) = reference_frames["white"], reference_frames["black"]
        if not _first_is_brighter(lit, dark):
            raise BundleError(
                f"{white.place}: expected white, and {black.name} black, found it not brighter wherever they differ; "
                "correct the order. These may be phase shifts: describe them by --list or --pattern"
            )
    return summary.faults


def _first_is_brighter(first: Pixels, second: Pixels) -> bool | None:
    """Return True or False if one of two images is brighter wherever they differ most; None if neither is."""
    difference = first.astype(np.int32) - second
    strong = np.abs(difference) > _STRONG * np.percentile(np.abs(difference), 99)
    if not strong.any():
        return None
    fraction = float((difference[strong] > 0).mean())
    return True if fraction >= _MIN_AGREEING_FRACTION else False if fraction <= 1 - _MIN_AGREEING_FRACTION else None


def parse_size(text: str) -> Size:
    """Return the extent of a text such as `1024x768`. Raises BundleError."""
    sides = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text.casefold())
    if sides is None:
        raise BundleError(f"--projector: expected columns x rows as 1024x768, found {text[:40]!r}; correct it")
    return Size(int(sides[1]), int(sides[2]))

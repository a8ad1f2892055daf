"""Import of a folder of images of another program as a scan bundle."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from slrig.bundle import (
    DESCRIPTION,
    MAX_CAMERA_PX,
    BundleWriter,
    check_calibration,
    natural_sort_key,
    read_text,
)
from slrig.capture import Evidence
from slrig.disk import storage_errors
from slrig.errors import BundleError, PatternError
from slrig.importers.calibrations import centring_offset_px, import_calibration
from slrig.importers.coded_images import CodedImages
from slrig.importers.images import (
    ENDINGS,
    SourceImage,
    describe_mosaic,
    find_bit_depth,
    list_images,
    list_images_below,
    without_idle_ends,
)
from slrig.model import Axis, Black, CameraFormat, Gray, LengthUnit, LineShift, Pattern, Pixels, Shot, Size, White
from slrig.patterns import encode, gray_bits

SLSTUDIO_BITS = {Axis.COLUMN: 10, Axis.ROW: 6}
"""Number of first bits that SLStudio shows on any projector."""

CALIBRATIONS = tuple(f"calibration.{each}" for each in ("yml", "yaml", "xml", "json", "npz", "mat"))
MAX_LIST_BYTES = 2**20

_MIN_DIFFERENCE = 0.02  # of full scale, between white and black where the projector's light falls
_MIN_DIFFERENCE_TO_NOISE = 5.0  # of the same
_NOISE_ROWS = 128  # of an image, whose neighbouring pixels show the noise of a difference
_MIN_DIFFERING_FRACTION = 0.002  # of all pixels, for a comparison of two images
_MIN_AGREEING_FRACTION = 0.98  # of the differing pixels, brighter in the same image

_AXES = {word: axis for axis in Axis for word in (axis.value, f"{axis.value}s", axis.value[:3])} | {
    "x": Axis.COLUMN,
    "y": Axis.ROW,
}
_INVERTED = {
    **dict.fromkeys(("inverted", "inverse", "inv", "i", "neg", "1"), True),
    **dict.fromkeys(("normal", "direct", "plain", "n", "pos", "0", ""), False),
}
_CODE = re.compile(r"(\w+) (\d{1,3})(?: (\w+))?")
_LINE = re.compile(r"(\w+) line (\d{1,4}) of (\d{1,4})(?: width (\d{1,4}))?")
_FIELDS = {
    "camera": r"[A-Za-z0-9_-]+?",
    "axis": r"[A-Za-z]+",
    "bit": r"\d+",
    "power": r"\d+",
    "inverted": r"[A-Za-z0-9]*",
}
_FIELD = re.compile(r"\{(\w*)(?::0?(\d))?\}")
_UNSUPPORTED = {
    "xor": "codes combined with a base pattern (XOR-02 and others) are not supported: slrig measures edges of light in "
    "the images, which such a code does not have after separation",
    "phase": "phase shifts are not supported: slrig measures edges of Gray codes and shifted lines",
}
_UNSUPPORTED |= dict.fromkeys(("phases", "sine", "sinus", "cos", "fringe", "fringes", "shift"), _UNSUPPORTED["phase"])


class ProjectorCode:
    """The Gray codes of one projector, as given on the command line."""

    def __init__(self, size: Size, *, cell_px: int = 1, offset_px: int = 0) -> None:
        self.size, self._cell_px, self._offset_px = size, cell_px, offset_px

    def bits(self, axis: Axis) -> int:
        """Return the number of bits for all cells of the projector. Raises PatternError: invalid cells."""
        return gray_bits(self.size.along(axis), self._cell_px, self._offset_px)

    def centring_offset_px(self, axis: Axis) -> int:
        """Return the offset that centres the projector in a code with cells of 1 px."""
        return centring_offset_px(self.size.along(axis))

    def first_bits(self, axis: Axis, count: int, *, inverses: bool, offset_px: int | None = None) -> list[Pattern]:
        """Return the first `count` bits, each followed by its inverse if `inverses`."""
        bits = self.bits(axis)
        if not 1 <= count <= bits:
            message = f"expected 1 to {bits} bits of the {axis} code of a projector of {self.size}, found {count}"
            raise BundleError(f"{message}; correct --projector")
        cell_px, offset = self._cell_px << (bits - count), self._offset_px if offset_px is None else offset_px
        both = (False, True) if inverses else (False,)
        return [Gray(axis, bit, count, cell_px, offset, inverted) for bit in range(count) for inverted in both]

    def parse_pattern(self, text: str) -> Pattern:
        """Parse `white`, `black`, `column 3`, `row 0 inverted` or `column line 2 of 8 width 1`; bit 0 is the most
        significant. Raises BundleError, PatternError.
        """
        name = " ".join(text.casefold().split())
        if name in ("white", "black"):
            return White() if name == "white" else Black()
        line = _LINE.fullmatch(name)
        if line and line[1] in _AXES:
            return LineShift(_AXES[line[1]], int(line[2]), int(line[3]), int(line[4] or 1))
        code = _CODE.fullmatch(name)
        if code and code[1] in _AXES and (code[3] or "") in _INVERTED:
            return self.bit(_AXES[code[1]], int(code[2]), inverted=_INVERTED[code[3] or ""])
        return _reject_word(name, "`white`, `black`, `column 3`, `row 0 inverted` or `column line 2 of 8`")

    def bit(self, axis: Axis, bit: int, *, inverted: bool) -> Gray:
        """Return one bit of the whole code. Raises PatternError: it has no such bit."""
        return Gray(axis, bit, self.bits(axis), self._cell_px, self._offset_px, inverted)

    def parse_sequence(self, text: str) -> list[Pattern]:
        """Parse a sequence such as `white black columns rows-plain`; plain: without inverses. Raises BundleError."""
        patterns: list[Pattern] = []
        for word in text.casefold().replace(",", " ").split():
            name, _, suffix = word.partition("-")
            if word in ("white", "black"):
                patterns.append(White() if word == "white" else Black())
            elif name in ("columns", "rows") and suffix in ("", "plain"):
                axis = _AXES[name]
                patterns += self.first_bits(axis, self.bits(axis), inverses=not suffix)
            else:
                _reject_word(word, "white, black, columns, rows, columns-plain and rows-plain")
        if not patterns:
            raise BundleError("--pattern: expected white, black, columns or rows, found nothing")
        encode(patterns, self.size)
        return patterns


def opencv_sequence(
    code: ProjectorCode, images: int, reference_frames: Sequence[Pattern], *, references_first: bool
) -> list[Pattern]:
    """Return the sequence of OpenCV's `generate`: columns, then rows, each bit with its inverse.

    reference_frames : white and black in their order, or empty. Raises BundleError: no such sequence has this number of
    images.
    """
    bits = {axis: code.bits(axis) for axis in Axis}
    axes_by_count = {2 * sum(bits[axis] for axis in axes): axes for axes in ([Axis.COLUMN], [Axis.COLUMN, Axis.ROW])}
    axes = axes_by_count.get(images - len(reference_frames))
    if axes is None:
        columns, both = axes_by_count
        raise BundleError(
            f"expected {both} images for a projector of {code.size} ({bits[Axis.COLUMN]} bits of columns, "
            f"{bits[Axis.ROW]} of rows, each with its inverse), or {columns} of columns alone, and white and black "
            f"first or last, or neither; found {images} images, {'with' if reference_frames else 'without'} white and "
            "black there; correct --projector, or describe the images by --pattern, --names or --list"
        )
    middle = [each for axis in axes for each in code.first_bits(axis, bits[axis], inverses=True)]
    return [*reference_frames, *middle] if references_first else [*middle, *reference_frames]


def scan3d_sequence(code: ProjectorCode, images: int) -> list[Pattern]:
    """Return white, black, then the first n bits of columns and of rows, each with its inverse. Raises BundleError."""
    max_bits = min(code.bits(axis) for axis in Axis)
    count, remainder = divmod(images - 2, 4)
    if remainder or not 1 <= count <= max_bits:
        raise BundleError(
            "expected 2 + 4 n images (white, black, n bits of columns and of rows with their inverses, n up to "
            f"{max_bits} for a projector of {code.size}), found {images}; correct --projector, or describe the images "
            "by --pattern"
        )
    middle = [p for a in Axis for p in code.first_bits(a, count, inverses=True, offset_px=code.centring_offset_px(a))]
    return [White(), Black(), *middle]


def slstudio_sequence(code: ProjectorCode, images: int) -> list[Pattern]:
    """Return white, black, then the first bits of columns, rows, or both, without inverses. Raises BundleError."""
    count = {axis: min(SLSTUDIO_BITS[axis], code.bits(axis)) for axis in Axis}
    axes_by_count = {2 + sum(count[a] for a in axes): axes for axes in ([Axis.COLUMN], [Axis.ROW], list(Axis))}
    if images not in axes_by_count:
        raise BundleError(
            f"expected {', '.join(map(str, axes_by_count))} images of a Gray code, found {images}: SLStudio's other "
            f"codes are phase shifts. {_UNSUPPORTED['phase']}; select Gray Code in SLStudio's preferences, scan again"
        )
    middle = [each for axis in axes_by_count[images] for each in code.first_bits(axis, count[axis], inverses=False)]
    return [White(), Black(), *middle]


def compile_name_template(template: str) -> re.Pattern[str]:
    """Compile a template such as `{axis}_{bit:02}_{inverted}.png`. Raises BundleError: it has an unknown field."""
    parts: list[str] = []
    end = 0
    for placeholder in _FIELD.finditer(template):
        name, digits = placeholder[1], placeholder[2]
        if name not in _FIELDS or f"(?P<{name}>" in "".join(parts):
            known = ", ".join(f"{{{each}}}" for each in _FIELDS)
            raise BundleError(f"--names {template}: expected each of the fields {known} once, found {placeholder[0]}")
        expression = rf"\d{{{digits},}}" if digits else _FIELDS[name]
        parts += [re.escape(template[end : placeholder.start()]), f"(?P<{name}>{expression})"]
        end = placeholder.end()
    return re.compile("".join(parts) + re.escape(template[end:]))


def pattern_from_name(code: ProjectorCode, match: re.Match[str]) -> Pattern:
    """Return the bit of a file name. `bit` counts from the most significant, `power` is the exponent of 2.
    Raises BundleError: a field has an unknown value; PatternError: the code has no such bit.
    """
    fields = match.groupdict()
    axis, inverted = (fields.get("axis") or "column").casefold(), (fields.get("inverted") or "").casefold()
    if axis not in _AXES:
        _reject_word(axis, f"{', '.join(_AXES)} as {{axis}} in {match[0]}")
    if inverted not in _INVERTED:
        _reject_word(inverted, f"{', '.join(filter(None, _INVERTED))} or nothing as {{inverted}} in {match[0]}")
    bits = code.bits(_AXES[axis])
    if "bit" not in fields and "power" not in fields:
        raise BundleError("--names: expected a field {bit} or {power} for the number of the bit; add it")
    bit = int(fields["bit"]) if "bit" in fields else bits - 1 - int(fields["power"])
    if not 0 <= bit < bits:
        raise PatternError(
            f"{match[0]}: expected bits 0 to {bits - 1}, 0 the most significant, of a projector of {code.size}, "
            f"found {bit}; correct --projector or --cell-px, or number by {{power}} if 0 is the least significant"
        )
    return code.bit(_AXES[axis], bit, inverted=_INVERTED[inverted])


def _reject_word(word: str, expected: str) -> NoReturn:
    reason = next((f" {text};" for name, text in _UNSUPPORTED.items() if word.startswith(name)), "")
    raise BundleError(f"expected {expected}, found {word[:60]!r};{reason} correct it")


@dataclass(frozen=True, slots=True)
class ImageNaming:
    """Source of each image's pattern: a program's order, an order as text, a template of file names, or a list file."""

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
    what was read from the calibration's file.
    """

    cameras: dict[str, list[tuple[SourceImage, Pattern]]] = field(default_factory=dict)
    unassigned: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    calibration_notes: tuple[str, ...] = ()


def import_capture(
    folder: Path,
    output: Path,
    code: ProjectorCode,
    naming: ImageNaming,
    *,
    names: Sequence[str] = (),
    bit_depth: int | None = None,
    calibration_file: Path | None = None,
    unit: LengthUnit | None = None,
    keys: Sequence[str] = (),
) -> tuple[ImageAssignment, Path | None]:
    """Write the images of `folder`, or of a file of several, as the bundle `output`; return the images and the
    calibration file that was used.

    The images are checked against one another. Those that contradict are named, and reconstruction does not use what is
    proven wrong; if they do not come in the order of their patterns, nothing is written.

    names : new names of the cameras, in the natural order of their names in the folder. bit_depth : of samples in
    files with 16 bits. unit, keys : as for `import_calibration`.

    Raises BundleError, PatternError, CalibrationError: the images, the naming or the calibration do not fit;
    StorageError.
    """
    with storage_errors(folder):
        images = _assign_images(folder, code, naming)
    if names:
        if len(names) != len(images.cameras):
            known = ", ".join(images.cameras)
            message = f"{folder}: expected {len(images.cameras)} names of cameras ({known}), found {len(names)}"
            raise BundleError(message)
        images.cameras = dict(zip(names, images.cameras.values(), strict=True))
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
    with BundleWriter(output, code.size, patterns, formats, calibration) as writer:
        for name, files in images.cameras.items():
            images.faults += _write_camera(writer, name, files, formats[name], patterns)
            white = next((image for image, pattern in files if isinstance(pattern, White)), None)
            mosaic = describe_mosaic(white.read(formats[name])[0]) if white else ""
            images.notes += [f"{name}: {mosaic}"] if mosaic else []
    return images, path


def _home(source: Path) -> Path:
    """Return the folder of a source of images: itself, or that of a file of several."""
    return source if source.is_dir() else source.parent


def _assign_images(folder: Path, code: ProjectorCode, naming: ImageNaming) -> ImageAssignment:
    if not folder.exists():
        raise BundleError(f"{folder}: expected a folder of images, or a file of several, found none; check the path")
    if naming.listed is not None:
        return _assign_from_list(folder, code, naming.listed)
    if naming.names is not None:
        return _assign_by_names(folder, code, naming)
    assigned = ImageAssignment()
    for name, files in _group_by_camera(folder, assigned.notes).items():
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
            brighter = _first_is_brighter(images[0], images[-1], form.full_scale)
            if brighter is not None:
                references: tuple[Pattern, ...] = (White(), Black()) if brighter else (Black(), White())
                return opencv_sequence(code, count, references, references_first=references_first)
        # With white and black elsewhere the images are shifted, which their comparison names.
        with suppress(BundleError):
            return opencv_sequence(code, count, (White(), Black()), references_first=False)
        return opencv_sequence(code, count, (), references_first=False)
    return (scan3d_sequence if naming.program == "scan3d" else slstudio_sequence)(code, count)


def _group_by_camera(folder: Path, notes: list[str]) -> dict[str, list[SourceImage]]:
    """Return the images in natural order, by subfolder, or by the part of their names before the last number."""
    images, found = list_images(folder)
    notes += found
    if not images:
        subfolders = sorted(
            (each for each in folder.iterdir() if each.is_dir() and each.name[0] != "."), key=natural_sort_key
        )
        by_folder = {}
        for each in subfolders:
            images, found = list_images(each)
            notes += found
            if images:
                by_folder[each.name] = images
        if not by_folder:
            if (folder / DESCRIPTION).is_file():
                raise BundleError(
                    f"{folder}: expected images to import, found a scan bundle; slrig reconstruct reads it"
                )
            endings = ", ".join(sorted(ENDINGS))
            raise BundleError(f"{folder}: expected images ({endings}), found none in it or below it")
        return by_folder
    groups: dict[str, list[SourceImage]] = {}
    for image in images:
        groups.setdefault(re.sub(r"\d+\D*$", "", image.stem), []).append(image)
    if len(groups) == 1:
        return {"cam0": images}
    return {re.sub(r"[^A-Za-z0-9_-]+", "-", prefix).strip("_-") or "cam0": each for prefix, each in groups.items()}


def _assign_by_names(folder: Path, code: ProjectorCode, naming: ImageNaming) -> ImageAssignment:
    bit_names = compile_name_template(str(naming.names))
    templates: tuple[tuple[str | None, Pattern], ...] = ((naming.white, White()), (naming.black, Black()))
    references = [(compile_name_template(template), pattern) for template, pattern in templates if template is not None]
    assigned = ImageAssignment()
    images, assigned.notes = list_images_below(folder)
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
        image = parts.get(place) or SourceImage.of_file(place)
        assigned.cameras.setdefault(row.get("camera") or "cam0", []).append((image, pattern))
    if not assigned.cameras:
        raise BundleError(f"{path}: expected a line for each image, found none")
    _require_complete_codes(folder, assigned)
    return assigned


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
        if not _first_is_brighter(lit, dark, form.full_scale):
            raise BundleError(
                f"{white.place}: expected white, and {black.name} black, found it not brighter wherever they differ; "
                "correct the order. These may be phase shifts, not supported: slrig reads Gray codes and shifted lines"
            )
    return summary.faults


def _first_is_brighter(first: Pixels, second: Pixels, full_scale: int) -> bool | None:
    """Return True or False if one of two images is brighter wherever they differ; None if neither is."""
    difference = first.astype(np.int32) - second
    sampled = difference[:: max(1, len(difference) // _NOISE_ROWS)]
    step = sampled[:, 2:] - sampled[:, :-2]  # of the same colour behind a filter
    noise = 1.4826 * float(np.median(np.abs(step))) / 2**0.5 if step.size else 0.0
    differs = np.abs(difference) > max(_MIN_DIFFERENCE * full_scale, _MIN_DIFFERENCE_TO_NOISE * noise)
    if differs.mean() < _MIN_DIFFERING_FRACTION:
        return None
    fraction = float((difference[differs] > 0).mean())
    return True if fraction >= _MIN_AGREEING_FRACTION else False if fraction <= 1 - _MIN_AGREEING_FRACTION else None


def parse_size(text: str) -> Size:
    """Return the extent of a text such as `1024x768`. Raises BundleError."""
    sides = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text.casefold())
    if sides is None:
        raise BundleError(f"--projector: expected columns x rows as 1024x768, found {text[:40]!r}; correct it")
    return Size(int(sides[1]), int(sides[2]))

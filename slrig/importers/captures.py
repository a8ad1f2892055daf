"""A folder of another program's images becomes a scan bundle: which camera, which pattern, one extent and depth."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from slrig.bundle import MAX_CAMERA_PX, BundleWriter, check_calibration, read_frame_format, read_with_colour
from slrig.bundle.storage import natural_sort_key
from slrig.bundle.validation import read_text
from slrig.disk import storage_errors
from slrig.errors import BundleError, PatternError
from slrig.importers.calibrations import read_any_calibration
from slrig.model import Axis, Black, CameraFormat, Gray, LineShift, Pattern, Pixels, Shot, Size, White
from slrig.patterns import encode, gray_bits

SLSTUDIO_BITS = {Axis.COLUMN: 10, Axis.ROW: 6}
"""How many of the first bits SLStudio shows, whatever the projector."""

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
_OTHERS = {
    "xor": "codes that are combined with a base pattern (XOR-02 and others) are not read: taken apart, their images "
    "are no pictures of light, and slrig measures edges in pictures to fractions of a pixel, and states how well",
    "phase": "phase shifts are not read: slrig measures edges of Gray codes and shifted lines",
}
_OTHERS |= dict.fromkeys(("phases", "sine", "sinus", "cos", "fringe", "fringes", "shift"), _OTHERS["phase"])


class Code:
    """The Gray codes of one projector, as the command line describes them."""

    def __init__(self, size: Size, *, cell_px: int = 1, offset_px: int = 0) -> None:
        self.size, self._cell_px, self._offset_px = size, cell_px, offset_px

    def bits(self, axis: Axis) -> int:
        """How many bits tell all cells of the projector apart. Raises PatternError: the cells are impossible."""
        return gray_bits(self.size.along(axis), self._cell_px, self._offset_px)

    def centred(self, axis: Axis) -> int:
        """Offset that puts the projector into the middle of a code of cells of 1 px."""
        extent = self.size.along(axis)
        return int((2 ** gray_bits(extent, 1, 0) - extent) // 2)

    def first(self, axis: Axis, count: int, *, inverses: bool, offset_px: int | None = None) -> list[Pattern]:
        """The first `count` bits, each followed by its inverse if there are inverses."""
        bits = self.bits(axis)
        if not 1 <= count <= bits:
            message = f"expected 1 to {bits} bits of the {axis} code of a projector of {self.size}, found {count}"
            raise BundleError(f"{message}; correct --projector")
        cell_px, offset = self._cell_px << (bits - count), self._offset_px if offset_px is None else offset_px
        both = (False, True) if inverses else (False,)
        return [Gray(axis, bit, count, cell_px, offset, inverted) for bit in range(count) for inverted in both]

    def of_words(self, words: str) -> Pattern:
        """What `white`, `black`, `column 3`, `row 0 inverted` or `column line 2 of 8 width 1` names; bit 0 is the most
        significant. Raises BundleError, PatternError.
        """
        plain = " ".join(words.casefold().split())
        if plain in ("white", "black"):
            return White() if plain == "white" else Black()
        line = _LINE.fullmatch(plain)
        if line and line[1] in _AXES:
            return LineShift(_AXES[line[1]], int(line[2]), int(line[3]), int(line[4] or 1))
        code = _CODE.fullmatch(plain)
        if code and code[1] in _AXES and (code[3] or "") in _INVERTED:
            return self.bit(_AXES[code[1]], int(code[2]), inverted=_INVERTED[code[3] or ""])
        return _refuse_word(plain, "`white`, `black`, `column 3`, `row 0 inverted` or `column line 2 of 8`")

    def bit(self, axis: Axis, bit: int, *, inverted: bool) -> Gray:
        """One bit of the whole code. Raises PatternError: it has no such bit."""
        return Gray(axis, bit, self.bits(axis), self._cell_px, self._offset_px, inverted)

    def sequence(self, words: str) -> list[Pattern]:
        """The patterns of `white black columns rows-plain` in this order; plain: no inverses. Raises BundleError."""
        found: list[Pattern] = []
        for word in words.casefold().replace(",", " ").split():
            name, _, rest = word.partition("-")
            if word in ("white", "black"):
                found.append(White() if word == "white" else Black())
            elif name in ("columns", "rows") and rest in ("", "plain"):
                axis = _AXES[name]
                found += self.first(axis, self.bits(axis), inverses=not rest)
            else:
                _refuse_word(word, "white, black, columns, rows, columns-plain and rows-plain")
        if not found:
            raise BundleError("--pattern: expected white, black, columns or rows, found nothing")
        encode(found, self.size)
        return found


def opencv_sequence(code: Code, images: int, ends: Sequence[Pattern], *, ends_first: bool) -> list[Pattern]:
    """What OpenCV's `generate` showed: columns, then rows, each bit with its inverse. ends : white and black, as found.
    Raises BundleError: the images are as many for no such sequence.
    """
    bits = {axis: code.bits(axis) for axis in Axis}
    axes = {2 * sum(bits[axis] for axis in shown): shown for shown in ([Axis.COLUMN], [Axis.COLUMN, Axis.ROW])}
    shown = axes.get(images - len(ends))
    if shown is None:
        columns, both = axes
        raise BundleError(
            f"expected {both} images for a projector of {code.size} ({bits[Axis.COLUMN]} bits of columns, "
            f"{bits[Axis.ROW]} of rows, each with its inverse), or {columns} of columns alone, and white and black "
            f"first or last, or neither; found {images} images, {'with' if ends else 'without'} white and black there; "
            "correct --projector, or say what they are by --pattern, --names or --list"
        )
    middle = [each for axis in shown for each in code.first(axis, bits[axis], inverses=True)]
    return [*ends, *middle] if ends_first else [*middle, *ends]


def scan3d_sequence(code: Code, images: int) -> list[Pattern]:
    """White, black, then the first bits of columns and as many of rows, each with its inverse. Raises BundleError."""
    most = min(code.bits(axis) for axis in Axis)
    count, left = divmod(images - 2, 4)
    if left or not 1 <= count <= most:
        raise BundleError(
            f"expected 2 + 4 n images (white, black, n bits of columns and of rows with their inverses, n up to {most} "
            f"for a projector of {code.size}), found {images}; correct --projector, or name the images by --pattern"
        )
    middle = [p for a in Axis for p in code.first(a, count, inverses=True, offset_px=code.centred(a))]
    return [White(), Black(), *middle]


def slstudio_sequence(code: Code, images: int) -> list[Pattern]:
    """White, black, then the first bits of columns, of rows, or of both, without inverses. Raises BundleError."""
    count = {axis: min(SLSTUDIO_BITS[axis], code.bits(axis)) for axis in Axis}
    known = {2 + sum(count[a] for a in shown): shown for shown in ([Axis.COLUMN], [Axis.ROW], list(Axis))}
    if images not in known:
        raise BundleError(
            f"expected {', '.join(map(str, known))} images of a Gray code, found {images}: SLStudio's other codes are "
            f"phase shifts. {_OTHERS['phase']}; choose Gray Code in SLStudio's preferences and scan again"
        )
    middle = [each for axis in known[images] for each in code.first(axis, count[axis], inverses=False)]
    return [White(), Black(), *middle]


def name_pattern(template: str) -> re.Pattern[str]:
    """What names a template as `{axis}_{bit:02}_{inverted}.png` fits. Raises BundleError: it has an unknown field."""
    parts: list[str] = []
    end = 0
    for placeholder in _FIELD.finditer(template):
        name, digits = placeholder[1], placeholder[2]
        if name not in _FIELDS or f"(?P<{name}>" in "".join(parts):
            known = ", ".join(f"{{{each}}}" for each in _FIELDS)
            raise BundleError(f"--names {template}: expected each of the fields {known} once, found {placeholder[0]}")
        wanted = rf"\d{{{digits},}}" if digits else _FIELDS[name]
        parts += [re.escape(template[end : placeholder.start()]), f"(?P<{name}>{wanted})"]
        end = placeholder.end()
    return re.compile("".join(parts) + re.escape(template[end:]))


def pattern_of_name(code: Code, named: re.Match[str]) -> Pattern:
    """The bit that the fields of a name say: `bit` counts from the most significant, `power` is the one of 2.
    Raises BundleError: a field says nothing that is known; PatternError: the code has no such bit.
    """
    fields = named.groupdict()
    axis, inverted = (fields.get("axis") or "column").casefold(), (fields.get("inverted") or "").casefold()
    if axis not in _AXES:
        _refuse_word(axis, f"{', '.join(_AXES)} as {{axis}} in {named[0]}")
    if inverted not in _INVERTED:
        _refuse_word(inverted, f"{', '.join(filter(None, _INVERTED))} or nothing as {{inverted}} in {named[0]}")
    bits = code.bits(_AXES[axis])
    if "bit" not in fields and "power" not in fields:
        raise BundleError("--names: expected a field {bit} or {power}, which tells the bits apart; add it")
    bit = int(fields["bit"]) if "bit" in fields else bits - 1 - int(fields["power"])
    if not 0 <= bit < bits:
        raise PatternError(
            f"{named[0]}: expected bits 0 to {bits - 1}, 0 the most significant, of a projector of {code.size}, "
            f"found {bit}; correct --projector or --cell-px, or number by {{power}} if 0 is the least significant"
        )
    return code.bit(_AXES[axis], bit, inverted=_INVERTED[inverted])


def _refuse_word(word: str, expected: str) -> NoReturn:
    why = next((f" {text};" for name, text in _OTHERS.items() if word.startswith(name)), "")
    raise BundleError(f"expected {expected}, found {word[:60]!r};{why} correct it")


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
    with storage_errors(folder):
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
        form = read_frame_format(files[0])
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
        inside = sorted(
            (each for each in folder.iterdir() if each.is_dir() and each.name[0] != "."), key=natural_sort_key
        )
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
    return sorted(found, key=natural_sort_key)


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
    first = read_frame_format(files[0][0])
    if first.size.width_px * first.size.height_px > MAX_CAMERA_PX:
        raise BundleError(
            f"{files[0][0]}: expected at most {MAX_CAMERA_PX} pixels, found {first.size}; crop the images"
        )
    for path, _ in files:
        each = read_frame_format(path)
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
        grey, colour = read_with_colour(path, (0,), form, colour_pages=coloured)
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

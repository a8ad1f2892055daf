"""Patterns in words, and orders of images: how programs number and name what they project."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NoReturn

from slrig.errors import BundleError, PatternError
from slrig.importers.calibrations import centring_offset_px
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Sine, Size, White
from slrig.patterns import encode, gray_bits

SLSTUDIO_BITS = {Axis.COLUMN: 10, Axis.ROW: 6}
"""Number of first bits that SLStudio shows on any projector."""
SLSTUDIO_PERIODS, SLSTUDIO_STEPS = 16, 3
"""Of its phase shift 2x3: periods over the columns, and shifts of each."""
SLSTUDIO_MICRO_PERIODS_PX = (75.02, 70.0, 71.32, 72.47, 73.72, 76.23, 77.35, 78.4, 79.22, 80.0)
"""Of its micro phase shift; the first is shown in three shifts."""

_AXES = {word: axis for axis in Axis for word in (axis.value, f"{axis.value}s", axis.value[:3])} | {
    "x": Axis.COLUMN,
    "y": Axis.ROW,
}
_INVERTED = {
    **dict.fromkeys(("inverted", "inverse", "inv", "i", "neg", "1"), True),
    **dict.fromkeys(("normal", "direct", "plain", "n", "pos", "0", ""), False),
}
_CODE = re.compile(
    r"(\w+) (\d{1,3})(?: of (\d{1,2}))?(?: cell (\d{1,5}))?(?: offset (\d{1,5}))?(?: (?!of|cell|offset)(\w+))?"
)
_LINE = re.compile(r"(\w+) line (\d{1,4}) of (\d{1,4})(?: width (\d{1,4}))?")
_SINES = re.compile(r"(columns|rows)-sine:(\d{1,5}(?:\.\d{1,6})?)/(-?\d{1,3})")
_SINE = re.compile(r"(\w+) sine (\d{1,3}) of (\d{1,3}) period (\d{1,5}(?:\.\d{1,6})?)")
_FIELDS = {
    "camera": r"[A-Za-z0-9_-]+?",
    "number": r"(?<!\d)\d+(?!\d)",
    "axis": r"[A-Za-z]+",
    "bit": r"\d+",
    "power": r"\d+",
    "inverted": r"[A-Za-z0-9]*",
}
_FIELD = re.compile(r"\{(\w*)(?::0?(\d))?\}")
_UNSUPPORTED = {
    "xor": "codes combined with a base pattern (XOR-02 and others) are not supported: slrig measures edges of light in "
    "the images, which such a code does not have after separation",
    "phase": "phase shifts are described by --list FILE (`column sine 0 of 4 period 16`) or by --pattern "
    "(`columns-sine:16/4`)",
}
_UNSUPPORTED |= dict.fromkeys(("phases", "sine", "sinus", "cos", "fringe", "fringes", "shift"), _UNSUPPORTED["phase"])


class ProjectorCode:
    """The Gray codes of one projector, as given on the command line."""

    def __init__(self, size: Size, *, cell_px: int | None = None, offset_px: int | None = None) -> None:
        self.size, self.stated_cell_px, self.stated_offset_px = size, cell_px, offset_px
        self._cell_px, self._offset_px = cell_px or 1, offset_px or 0

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
        """Parse `white`, `black`, `column 3`, `row 0 of 9 cell 2 offset 5 inverted`, `column line 2 of 8 width 1` or
        `row sine 1 of 4 period 16`; bit 0 is the most significant. Bits, cell and offset are those of this code unless
        they are stated. Raises BundleError, PatternError.
        """
        name = " ".join(text.casefold().split())
        if name in ("white", "black"):
            return White() if name == "white" else Black()
        line = _LINE.fullmatch(name)
        if line and line[1] in _AXES:
            return LineShift(_AXES[line[1]], int(line[2]), int(line[3]), int(line[4] or 1))
        sine = _SINE.fullmatch(name)
        if sine and sine[1] in _AXES:
            return Sine(_AXES[sine[1]], float(sine[4]), int(sine[2]), int(sine[3]))
        code = _CODE.fullmatch(name)
        if code and code[1] in _AXES and (code[6] or "") in _INVERTED:
            axis, inverted = _AXES[code[1]], _INVERTED[code[6] or ""]
            if not any(code.group(3, 4, 5)):
                return self.bit(axis, int(code[2]), inverted=inverted)
            cell_px, offset_px = int(code[4] or self._cell_px), int(code[5] or 0)
            bits = int(code[3] or gray_bits(self.size.along(axis), cell_px, offset_px))
            return Gray(axis, int(code[2]), bits, cell_px, offset_px, inverted)
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
            elif sines := _SINES.fullmatch(word):
                patterns += _shifted_sines(_AXES[sines[1]], float(sines[2]), int(sines[3]))
            else:
                known = "white, black, columns, rows, columns-plain, rows-plain and columns-sine:PERIOD/STEPS"
                _reject_word(word, known)
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
        extra = len(reference_frames)
        with_references = "white, black, " if extra else ""
        raise BundleError(
            f"expected {both + extra} images for a projector of {code.size}: {with_references}{both} of the code "
            f"({bits[Axis.COLUMN]} bits of columns, {bits[Axis.ROW]} of rows, each with its inverse); or "
            f"{columns + extra} with columns alone; found {images}; correct --projector, or describe the images by "
            "--pattern, --names or --list"
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


def _shifted_sines(axis: Axis, period_px: float, steps: int) -> list[Pattern]:
    """Return one frame of each shift; of the opposite direction if steps is negative."""
    count = abs(steps)
    return [Sine(axis, period_px, k if steps > 0 else -k % count, count) for k in range(count)]


def slstudio_micro_sequence(_code: ProjectorCode, images: int) -> list[Pattern]:
    """Return the sinusoids of SLStudio's micro phase shift of columns. Raises BundleError: another number of images."""
    first, *others = SLSTUDIO_MICRO_PERIODS_PX
    patterns = _shifted_sines(Axis.COLUMN, first, -3)
    patterns += [Sine(Axis.COLUMN, period_px, 1 - index % 2, 2) for index, period_px in enumerate(others)]
    if images != len(patterns):
        raise BundleError(f"expected {len(patterns)} images of SLStudio's micro phase shift, found {images}")
    return patterns


def slstudio_sequence(code: ProjectorCode, images: int) -> list[Pattern]:
    """Return white, black, then the first bits of columns, rows, or both, without inverses; or for six images three
    shifts of sixteen periods over the columns, and three of one. Raises BundleError.
    """
    if images == 2 * SLSTUDIO_STEPS:
        columns = float(code.size.width_px)
        return [
            each
            for periods in (SLSTUDIO_PERIODS, 1)
            for each in _shifted_sines(Axis.COLUMN, columns / periods, SLSTUDIO_STEPS)
        ]
    count = {axis: min(SLSTUDIO_BITS[axis], code.bits(axis)) for axis in Axis}
    axes_by_count = {2 + sum(count[a] for a in axes): axes for axes in ([Axis.COLUMN], [Axis.ROW], list(Axis))}
    if images not in axes_by_count:
        raise BundleError(
            f"expected {', '.join(map(str, axes_by_count))} images of a Gray code, or 6 of phase shift 2x3, found "
            f"{images}; its micro phase shift is --format slstudio-micro. Other {_UNSUPPORTED['phase']}"
        )
    middle = [each for axis in axes_by_count[images] for each in code.first_bits(axis, count[axis], inverses=False)]
    return [White(), Black(), *middle]


def compile_name_template(template: str) -> re.Pattern[str]:
    """Compile a template such as `{axis}_{bit:02}_{inverted}.png`; * stands for anything. Raises BundleError: it has an
    unknown field.
    """
    parts: list[str] = []
    end = 0
    for placeholder in _FIELD.finditer(template):
        name, digits = placeholder[1], placeholder[2]
        if name not in _FIELDS or f"(?P<{name}>" in "".join(parts):
            known = ", ".join(f"{{{each}}}" for each in _FIELDS)
            raise BundleError(f"--names {template}: expected each of the fields {known} once, found {placeholder[0]}")
        expression = rf"\d{{{digits},}}" if digits else _FIELDS[name]
        parts += [_literal(template[end : placeholder.start()]), f"(?P<{name}>{expression})"]
        end = placeholder.end()
    return re.compile("".join(parts) + _literal(template[end:]))


def _literal(text: str) -> str:
    return ".*".join(map(re.escape, text.split("*")))


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


def pattern_words(pattern: Pattern) -> str:
    """Return a pattern in words that `ProjectorCode.parse_pattern` reads, of any code.

    >>> pattern_words(Gray(Axis.ROW, 0, 9, 2, 5, inverted=True))
    'row 0 of 9 cell 2 offset 5 inverted'
    """
    match pattern:
        case Gray(axis, bit, bits, cell_px, offset_px, inverted):
            offset = f" offset {offset_px}" if offset_px else ""
            return f"{axis} {bit} of {bits} cell {cell_px}{offset}{' inverted' if inverted else ''}"
        case LineShift(axis, shift, period_px, width_px):
            return f"{axis} line {shift} of {period_px} width {width_px}"
        case Sine(axis, period_px, shift, steps):
            return f"{axis} sine {shift} of {steps} period {period_px:g}"
    return pattern.kind

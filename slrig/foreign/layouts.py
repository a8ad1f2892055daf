"""Which pattern each image of another program shows: by its place in a sequence, by its name, or by a list.

All codes here are the reflected binary code of slrig's own patterns; what differs is the order of images, and where the
cells begin. OpenCV's `GrayCodePattern` (opencv_contrib, structured_light) has cells of 1 px from the projector's edge.
scan3d-capture (Moreno and Taubin, 2012) puts the projector into the middle of the code: an offset of (2^b - n)/2 for n
columns and b bits. Both it and SLStudio may show only the first bits of a code; these are the code of wider cells.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NoReturn

from slrig.errors import BundleError, PatternError
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Size, White
from slrig.patterns.gray import gray_bits
from slrig.patterns.sequence import encode

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
    for field in _FIELD.finditer(template):
        name, digits = field[1], field[2]
        if name not in _FIELDS or f"(?P<{name}>" in "".join(parts):
            known = ", ".join(f"{{{each}}}" for each in _FIELDS)
            raise BundleError(f"--names {template}: expected each of the fields {known} once, found {field[0]}")
        wanted = rf"\d{{{digits},}}" if digits else _FIELDS[name]
        parts += [re.escape(template[end : field.start()]), f"(?P<{name}>{wanted})"]
        end = field.end()
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

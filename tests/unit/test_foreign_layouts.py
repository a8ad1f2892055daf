"""Which pattern an image shows by words and by names: what is known, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.errors import BundleError, PatternError, SlrigError
from slrig.foreign.captures import Naming, import_capture, parse_size
from slrig.foreign.layouts import Code, name_pattern, pattern_of_name, scan3d_sequence, slstudio_sequence
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Size, White

CODE = Code(Size(1824, 1140), cell_px=2)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("white", White()),
        ("Black", Black()),
        ("column 3", Gray(Axis.COLUMN, 3, 10, 2)),
        ("y 0 inverse", Gray(Axis.ROW, 0, 10, 2, inverted=True)),
        ("rows  9 plain", Gray(Axis.ROW, 9, 10, 2)),
        ("column line 2 of 8", LineShift(Axis.COLUMN, 2, 8)),
        ("row line 0 of 12 width 3", LineShift(Axis.ROW, 0, 12, 3)),
    ],
)
def test_words_name_a_pattern(words: str, wanted: Pattern) -> None:
    assert CODE.of_words(words) == wanted


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        ("column", BundleError, "expected `white`"),
        ("diagonal 3", BundleError, "'diagonal 3'"),
        ("column 3 upside", BundleError, "expected `white`"),
        ("xor02 column 3", BundleError, "XOR-02 and others"),
        ("sine 0", BundleError, "phase shifts are not read"),
        ("column 10", PatternError, "bit 10 of 10"),
        ("column line 9 of 8", PatternError, "found shift 9"),
    ],
)
def test_other_words_are_refused(words: str, error: type[SlrigError], said: str) -> None:
    with pytest.raises(error, match=said):
        CODE.of_words(words)


@pytest.mark.parametrize(
    ("template", "name", "wanted"),
    [
        ("{axis}_{bit:02}_{inverted}.png", "column_03_inverted.png", Gray(Axis.COLUMN, 3, 10, 2, inverted=True)),
        ("{axis}_{bit:02}_{inverted}.png", "row_03_normal.png", Gray(Axis.ROW, 3, 10, 2)),
        ("{bit}{inverted}.png", "7i.png", Gray(Axis.COLUMN, 7, 10, 2, inverted=True)),
        ("{bit}{inverted}.png", "7.png", Gray(Axis.COLUMN, 7, 10, 2)),
        ("{camera}/{axis}{power}.bmp", "left/Y0.bmp", Gray(Axis.ROW, 9, 10, 2)),
    ],
)
def test_a_name_says_its_bit(template: str, name: str, wanted: Pattern) -> None:
    named = name_pattern(template).fullmatch(name)
    assert named is not None
    assert pattern_of_name(CODE, named) == wanted


@pytest.mark.parametrize(
    ("template", "name", "said"),
    [
        ("{bits}.png", "", "expected each of the fields"),
        ("{bit}_{bit}.png", "", "once"),
        ("{axis}.png", "column.png", "a field {bit} or {power}"),
        ("{axis}_{bit}.png", "diagonal_1.png", "'diagonal'"),
        ("{bit}_{inverted}.png", "1_upside.png", "'upside'"),
        ("{bit}.png", "10.png", "expected bits 0 to 9"),
        ("{power}.png", "10.png", "found -1"),
    ],
)
def test_a_name_that_says_none_is_refused(template: str, name: str, said: str) -> None:
    def read() -> Pattern:
        named = name_pattern(template).fullmatch(name)
        assert named is not None
        return pattern_of_name(CODE, named)

    with pytest.raises(SlrigError) as caught:
        read()
    assert said in str(caught.value)


def test_first_bits_are_a_code_of_wider_cells() -> None:
    assert slstudio_sequence(Code(Size(1824, 1140)), 12)[2:] == [Gray(Axis.COLUMN, bit, 10, 2) for bit in range(10)]
    assert slstudio_sequence(Code(Size(1824, 1140)), 8)[2:] == [Gray(Axis.ROW, bit, 6, 32) for bit in range(6)]
    # 1280 columns are centred in 2048, in cells of 2; 800 rows in 1024.
    shown = scan3d_sequence(Code(Size(1280, 800)), 42)
    assert shown[2:4] == [Gray(Axis.COLUMN, 0, 10, 2, 384), Gray(Axis.COLUMN, 0, 10, 2, 384, inverted=True)]
    assert shown[-1] == Gray(Axis.ROW, 9, 10, 1, 112, inverted=True)
    for images in (2, 41, 46):
        with pytest.raises(BundleError, match=f"found {images}"):
            scan3d_sequence(Code(Size(1280, 800)), images)


@pytest.mark.parametrize("words", ["", "1024", "0x768", "1024x", "-3x4", "1024x768x3", "123456x1"])
def test_an_extent_is_two_numbers(words: str) -> None:
    assert parse_size("1024X768") == Size(1024, 768)
    with pytest.raises(BundleError, match="expected columns x rows"):
        parse_size(words)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("name,pattern\na.png,white", "expected the columns file, pattern and camera, found name, pattern"),
        ("file,pattern\na.png", "expected 2 cells in line 2"),
        ("file,pattern\na.png,white,left", "expected 2 cells in line 2"),
        ("file,pattern\na.png,grey", "line 2: expected `white`"),
        ("file,pattern\n", "expected a line for each image"),
        ("file,pattern\na.png,column 0\nb.png,column 2", "found none of bit 1"),
        ("file,pattern\na.png,column 0\nb.png,column 0", "expected one image for each bit, found two"),
        ("file,pattern\na.png,white", "No such file"),
    ],
)
def test_a_list_that_is_wrong_is_refused(tmp_path: Path, lines: str, said: str) -> None:
    (tmp_path / "list.csv").write_text(lines)
    with pytest.raises(BundleError) as caught:
        import_capture(tmp_path, tmp_path / "bundle", CODE, Naming(listed=tmp_path / "list.csv"))
    assert said in str(caught.value)

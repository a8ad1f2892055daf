"""Pictures for the flash: what lies where in them, the list beside them, and what is done about what they lack."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.dlpc350.flash import LIST, TO_FLASH, Place, read_flash, write_pictures
from drivers.dlpc350.planes import MIRRORS, picture_of, planes_in
from drivers.pattern_engine.planes import plane_of
from slrig.errors import ConfigError, StorageError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, Pattern, PatternSequence, White
from slrig.patterns.sequence import encode, scan_patterns


def scan(*, rows: bool = False, period_px: int = 8) -> PatternSequence:
    patterns = scan_patterns(
        MIRRORS,
        line_shift=True,
        period_px=period_px,
        line_width_px=1,
        gray_cell_px=None,
        gray_offset_px=0,
        rows=rows,
    )
    return encode(patterns, MIRRORS)


def few(*patterns: Pattern) -> PatternSequence:
    return encode(patterns, MIRRORS)


def test_planes_fill_green_then_red_then_blue_from_the_lowest_bit_and_are_given_back() -> None:
    # One pixel in each plane: the plane's number is its column.
    planes = [np.zeros(MIRRORS.shape, np.bool_) for _ in range(24)]
    for number, plane in enumerate(planes):
        plane[2, number] = True
    content = picture_of(planes)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (1140, 912, 3)
    # OpenCV gives blue, green, red.
    for number, pixel in ((0, (0, 1, 0)), (7, (0, 128, 0)), (8, (0, 0, 1)), (15, (0, 0, 128)), (23, (128, 0, 0))):
        assert tuple(picture[2, number]) == pixel
    assert np.count_nonzero(picture) == 24
    assert all(np.array_equal(a, b) for a, b in zip(planes_in(content, "made"), planes, strict=True))


def test_a_picture_of_another_kind_or_that_is_cut_and_shades_of_grey_are_refused() -> None:
    shapes = ((1140, 911, 3), (800, 1280, 3), (1140, 912))
    others = [cv2.imencode(".bmp", np.zeros(shape, np.uint8))[1].tobytes() for shape in shapes]
    whole = picture_of([])
    for content in (*others, whole[:10], whole[:60], whole[:-1]):
        with pytest.raises(ConfigError, match="expected a BMP file of 912 x 1140 pixels with 24 bits"):
            planes_in(content, "splash.bmp")
    grey = PatternSequence(MIRRORS, (White(),), (np.full((1, 1), 128, np.uint8),))
    with pytest.raises(UnsupportedByDeviceError, match="a mirror is on or off"):
        plane_of(grey, 0)


@pytest.mark.parametrize(
    ("rows", "planes"),
    [
        (False, [1 + 8 + 8]),
        # The rest of 34, and white once more: no sequence goes back to the first picture for it.
        (True, [24, 10 + 1]),
    ],
)
def test_every_place_holds_its_pattern(tmp_path: Path, rows: bool, planes: list[int]) -> None:
    sequence = scan(rows=rows)
    written = write_pictures(tmp_path, sequence)
    assert [len(picture.planes) for picture in written.pictures] == planes
    places = read_flash(tmp_path).places(sequence)
    images = [place.image for place in places]
    assert images == sorted(images)
    listed = json.loads((tmp_path / LIST).read_text())
    pictures = {image["flash_index"]: cv2.imread(str(tmp_path / image["file"])) for image in listed["images"]}
    for index, place in enumerate(places):
        picture = pictures[place.image]
        assert picture is not None
        # A row and a column show what repeats along an axis.
        for part in ((slice(0, 1), slice(None)), (slice(None), slice(0, 1))):
            channel = picture[part][..., (1, 2, 0)[place.plane // 8]]
            shown = (channel >> np.uint8(place.plane % 8) & np.uint8(1)).astype(np.bool_) ^ place.inverted
            assert np.array_equal(shown, sequence.image(index)[part] == 255), sequence.patterns[index]


def test_what_is_missing_is_reported_and_written_on_request(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedByDeviceError) as refused:
        read_flash(tmp_path).places(scan())
    text = str(refused.value)
    assert "lacks 28 of 28 patterns (white, black, column Gray bit 0 of 8, cell 4 px and 25 more)" in text
    assert list(tmp_path.iterdir()) == []
    text = read_flash(tmp_path).written(scan())
    flash = read_flash(tmp_path / TO_FLASH)
    assert str(tmp_path / TO_FLASH) in text
    assert f'"{flash.tag}"' in text
    assert len(flash.places(scan())) == 28


def test_what_is_flashed_already_keeps_its_place(tmp_path: Path) -> None:
    first, second = (
        few(White(), *(LineShift(Axis.COLUMN, 1, period) for period in periods)) for periods in ((8, 9), (9, 12))
    )
    write_pictures(tmp_path, first)
    before = read_flash(tmp_path)
    with pytest.raises(UnsupportedByDeviceError, match="lacks 1 of 3 patterns"):
        before.places(second)
    before.written(second)
    after = read_flash(tmp_path / TO_FLASH)
    assert [picture.flash_index for picture in after.pictures] == [0, 1]
    assert after.places(first) == before.places(first)
    assert {place.image for place in after.places(second)} == {1}
    assert after.tag != before.tag


def test_the_picture_in_the_buffer_is_kept_as_long_as_it_serves(tmp_path: Path) -> None:
    a, b, c = (LineShift(Axis.COLUMN, shift, 8) for shift in range(3))
    first = write_pictures(tmp_path, few(White(), a))
    second = write_pictures(tmp_path, few(White(), b, c), first.pictures)
    assert second.places(few(White(), Black(), b, c, White())) == (
        Place(1, 0, inverted=False),
        Place(1, 0, inverted=True),
        Place(1, 1, inverted=False),
        Place(1, 2, inverted=False),
        Place(1, 0, inverted=False),
    )
    assert [place.image for place in second.places(few(White(), a, b, White()))] == [0, 0, 1, 1]


def test_a_picture_that_was_changed_is_refused(tmp_path: Path) -> None:
    flash = write_pictures(tmp_path, few(White()))
    path = tmp_path / f"{flash.tag}-0.bmp"
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"not the picture that images\.json lists"):
        read_flash(tmp_path)
    path.unlink()
    with pytest.raises(ConfigError, match="No such file"):
        read_flash(tmp_path)


def test_faults_of_the_list_are_reported_at_once(tmp_path: Path) -> None:
    flash = write_pictures(tmp_path, few(White()))
    listed = json.loads((tmp_path / LIST).read_text())
    listed["images"] *= 2
    (tmp_path / LIST).write_text(json.dumps(listed))
    with pytest.raises(ConfigError, match=r"each flash_index once, found \[0, 0\]"):
        read_flash(tmp_path)
    image = {"flash_index": 300, "file": "a.bmp", "sha256": "0", "planes": []}
    (tmp_path / LIST).write_text(
        json.dumps({"format": "slrig-dlpc350-images", "version": 2, "tagg": "x", "images": [image]})
    )
    with pytest.raises(ConfigError) as refused:
        read_flash(tmp_path)
    for words in ("version", "tagg: unknown key; did you mean 'tag'?", "flash_index", "sha256", "planes"):
        assert words in str(refused.value)
    with pytest.raises(UnsupportedByDeviceError, match="it takes 64"):
        write_pictures(tmp_path, few(White()), flash.pictures * 64)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="asked to write pictures"):
        write_pictures(tmp_path / "file" / "folder", few(White()))

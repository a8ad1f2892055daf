"""What only this driver does, above a peer that speaks its protocol: tables, rules of time, and options."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.dlpc350.engine import Dlpc350EngineOptions, build_tables, check_loading, check_timing, play_timing
from drivers.dlpc350.flash import (
    EXPORT_FOLDER,
    LIST_FILE,
    MIRRORS,
    FlashContents,
    FlashedPlane,
    decode_planes,
    encode_picture,
    read_flash_list,
    write_pictures,
)
from drivers.pattern_engine.options import LedColour
from drivers.pattern_engine.projector import Timing, pattern_plane
from slrig.bundle.validation import validate
from slrig.errors import ConfigError, DeviceError, DeviceStateError, StorageError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, Pattern, PatternSequence, Primary, White
from slrig.patterns.sequence import encode
from tests.contract.suite import whole_scan
from tests.unit.drivers.pattern_engine.engine_bench import LEDS, START_STOP, flash_350
from tests.unit.drivers.pattern_engine.engine_bench import SEQUENCE_350 as SEQUENCE
from tests.unit.drivers.pattern_engine.engine_bench import Bench350 as Bench

START = STOP = START_STOP
VALIDATE = 0x1A1A


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_order_is_stop_set_validate_start(bench: Bench) -> None:
    projector = bench.loaded()
    projector.show(2)
    assert bench.engine.commands[-1] == (START, b"\2")
    assert bench.commands() == [
        *(LEDS, STOP),
        0x1A29,
        *(0x1A33, 0x1A32, 0x1A34, 0x1A33),
        *(0x1A33, 0x1A32, 0x1A34, 0x1A33),
        0x1A31,
        *(VALIDATE, LEDS, START),
    ]
    # The next one has the same timing, and another pattern of the same picture.
    projector.show(0)
    assert bench.commands() == [LEDS, STOP, 0x1A33, 0x1A32, 0x1A34, 0x1A33, VALIDATE, LEDS, START]
    # What was validated is started again.
    projector.show(0)
    assert bench.commands() == [LEDS, STOP, LEDS, START]


def test_a_stop_without_effect_is_repeated(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    projector = bench.loaded()
    projector.show(2)
    bench.commands()
    started, lost = bench.engine._started, [b""]
    monkeypatch.setattr(bench.engine, "_started", lambda data: lost.pop() if lost else started(data))
    projector.show(0)
    assert bench.commands()[:4] == [LEDS, STOP, STOP, 0x1A33]


@pytest.mark.parametrize("image_kept_s", [None, 0.01])
def test_light_is_waited_for_as_long_as_a_picture_takes(image_kept_s: float | None) -> None:
    bench = Bench(load_s=0.15, keeps=image_kept_s is not None)
    projector = bench.loaded(image_load_s=0.15, image_kept_s=image_kept_s)
    # As long as no document says that the engine keeps a picture, each pattern of it is waited for. The table's check
    # takes 10 ms and the start 10 ms, 100 ms more the first time, and nothing for the table that was shown last.
    kept_s = image_kept_s or 0.15
    for index, load_s, check_s in ((2, 0.15, 0.11), (0, kept_s, 0.02), (1, kept_s, 0.02), (1, kept_s, 0.0)):
        begun_ns = bench.clock.now_ns()
        shown = projector.show(index)
        assert bench.shows(SEQUENCE.profiles[index])
        assert bench.clock.now_ns() - begun_ns == round((check_s + load_s) * 1e9)
        assert shown.t_err_ns == round(load_s * 1e9 / 2)
    projector.blank()
    projector.play(0.01, 0.02)


def test_a_played_sequence_is_of_one_timing_and_one_picture(bench: Bench) -> None:
    projector = bench.loaded(light_margin_s=0.002)
    projector.play(0.01, 0.03)
    assert bench.engine.registers[0x1A29] == (12_000).to_bytes(4, "little") + (30_000).to_bytes(4, "little")
    assert bench.engine.registers[0x1A31] == bytes([2, 0, 2, 0])


def test_the_longest_table_takes_several_reports(bench: Bench) -> None:
    projector = bench.open()
    long = PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 129, SEQUENCE.profiles[:1] * 129)
    with pytest.raises(UnsupportedByDeviceError, match="129 patterns, the engine's table takes 128"):
        projector.load(long)
    projector.load(PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 128, SEQUENCE.profiles[:1] * 128))
    projector.play(0.001, 0.002)
    bench.clock.advance(1)
    assert len(bench.pulses) == 128
    (data,) = (data for command, data in bench.engine.commands if command == 0x1A34 and len(data) > 64)
    assert len(data) == 384


def test_a_flash_of_another_name_or_with_too_few_pictures_is_refused(tmp_path: Path) -> None:
    flash = flash_350()
    bench = Bench(tag="factory")
    with pytest.raises(UnsupportedByDeviceError, match=f'tagged "{flash.tag}", the engine has "factory"'):
        bench.open()
    assert bench.engine.lit is None
    bench.flash = FlashContents(flash.folder, None, flash.pictures)
    bench.open().close()
    bench.flash = write_pictures(tmp_path, SEQUENCE, flash.pictures)
    bench.engine.tag = bench.flash.tag or ""
    with pytest.raises(UnsupportedByDeviceError, match="names picture 1 of its flash, it holds 1"):
        bench.open()


def test_a_flash_without_a_list_asks_for_pictures(bench: Bench, tmp_path: Path) -> None:
    bench.flash = FlashContents(tmp_path)
    projector = bench.open()
    with pytest.raises(UnsupportedByDeviceError, match=r"lacks 3 of 3 patterns.*slrig patterns"):
        projector.load(SEQUENCE)
    assert list(tmp_path.iterdir()) == [], "what is only tried is not written"
    assert str(tmp_path / "to_flash") in projector.write_patterns(SEQUENCE)
    assert (tmp_path / "to_flash" / "images.json").is_file()
    with pytest.raises(DeviceStateError):
        projector.show(0)


@pytest.mark.parametrize("command", [0x1A29, 0x1A34, 0x1A31, VALIDATE])
def test_whatever_is_refused_on_the_way_to_light_leaves_it_dark(bench: Bench, command: int) -> None:
    projector = bench.loaded()
    projector.show(0)
    bench.engine.faults.refused.add(command)
    with pytest.raises(DeviceError, match=f"refused the command {command:#06x}"):
        projector.play(0.01, 0.03)
    assert bench.engine.lit is None
    assert not bench.engine.running
    bench.engine.faults.refused.clear()
    projector.show(2)


def bends_its_timing(bench: Bench) -> None:
    bench.engine.bent = {0x1A29: bytes(8)}


def lacks_a_picture(bench: Bench) -> None:
    bench.engine._planes[7] = bench.engine._planes.pop(0)


def never_ends_its_check(bench: Bench) -> None:
    bench.engine.times.check = 1e6


def never_runs(bench: Bench) -> None:
    bench.engine.times.start = 1e6
    bench.engine._hardware |= 8


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (bends_its_timing, "requested exposure period"),
        (lacks_a_picture, "a pattern number in the table does not exist"),
        (never_ends_its_check, "did not finish the validation of the sequence in time, and reports: no fault"),
        (never_runs, "did not start the sequence in time, and reports: a picture was taken before"),
    ],
)
def test_what_keeps_a_sequence_from_its_light_is_an_error_and_dark(
    bench: Bench, spoil: Callable[[Bench], None], words: str
) -> None:
    projector = bench.loaded()
    spoil(bench)
    with pytest.raises(DeviceError, match=words) as refused:
        projector.show(0)
    assert isinstance(refused.value, UnsupportedByDeviceError) is not spoil.__name__.startswith("never")
    assert bench.engine.lit is None


@pytest.mark.parametrize(
    ("exposure_us", "period_us", "rule"),
    [
        (234, 500, "shortest exposure of a 1-bit pattern is 235 µs"),
        (1000, 1229, "at least 230 µs shorter"),
        (1001, 1000, "at least 230 µs shorter"),
        (200_000_000, 200_000_300, "the longest is 200000000 µs"),
    ],
)
def test_a_timing_is_judged_by_rules_with_names(exposure_us: int, period_us: int, rule: str) -> None:
    for sound in ((235, 235), (1000, 1230), (1000, 1000), (200_000_000, 200_000_000)):
        check_timing(Timing(*sound))
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        check_timing(Timing(exposure_us, period_us))


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "margin_s", "expected"),
    [
        (0.010, 0.020, 0.0005, Timing(10_500, 20_000)),
        (0.010, 0.0106, 0.0005, Timing(10_600, 10_600)),
        (0.010, 0.010, 0.0, Timing(10_000, 10_000)),
        (0.0001, 0.001, 0.0, Timing(235, 1000)),
    ],
)
def test_light_covers_the_exposure_and_the_camera_s_start(
    exposure_s: float, period_s: float, margin_s: float, expected: Timing
) -> None:
    assert play_timing(exposure_s, period_s, margin_s=margin_s, duty_limit=1.0) == expected


def test_pictures_beyond_the_buffers_need_time() -> None:
    check_loading((1, 1), 235, 0.2)
    check_loading((24, 24, 1), 10_000, 0.2)
    with pytest.raises(UnsupportedByDeviceError, match=r"12 patterns every 10000 µs take 0\.12 s; .*0\.0167 s"):
        check_loading((24, 12, 1), 10_000, 0.2)


@pytest.mark.parametrize(
    ("places", "colours", "dark_between", "words"),
    [
        (
            [(3, 0, False), (3, 23, True), (3, 9, False)],
            [LedColour.WHITE] * 3,
            True,
            [0b0110_0111_0001_000000_00, 0b0011_0111_0001_010111_00, 0b0010_0111_0001_001001_00],
        ),
        ([(0, 1, False)], [LedColour.BLUE], False, [0b0100_0100_0001_000001_00]),
        # White in one light is lit by that LED alone.
        (
            [(0, 1, False)] * 3,
            [
                Dlpc350EngineOptions(patterns="p").led_colour(pattern)
                for pattern in (White(), Primary("green"), Primary("blue"))
            ],
            False,
            [0b0100_0111_0001_000001_00, 0b0000_0010_0001_000001_00, 0b0000_0100_0001_000001_00],
        ),
    ],
    ids=["dark between", "no dark between", "colours"],
)
def test_table_entries_are_laid_out_as_the_manual_says(
    places: list[tuple[int, int, bool]], colours: list[LedColour], dark_between: bool, words: list[int]
) -> None:
    tables = build_tables(
        [FlashedPlane(image, plane, inverted=inverted) for image, plane, inverted in places],
        colours,
        dark_between=dark_between,
    )
    assert [int.from_bytes(tables.patterns[3 * i : 3 * i + 3], "little") for i in range(len(places))] == words


@pytest.mark.parametrize(
    ("pictures", "swaps", "images", "counts"),
    [
        ([3, 3, 3], [1, 0, 0], [3], (3,)),
        ([5, 5, 2, 5], [1, 0, 1, 1], [5, 2, 5], (2, 1, 1)),
        # A table of two pictures is sent the other way round.
        ([7, 4], [1, 1], [4, 7], (1, 1)),
    ],
)
def test_each_change_of_picture_swaps_the_buffer(
    pictures: list[int], swaps: list[int], images: list[int], counts: tuple[int, ...]
) -> None:
    places = [FlashedPlane(picture, 0, inverted=False) for picture in pictures]
    tables = build_tables(places, (LedColour.RED,) * len(places), dark_between=False)
    assert [tables.patterns[3 * i + 2] >> 2 & 1 for i in range(len(places))] == swaps
    assert (list(tables.images), tables.counts, tables.length) == (images, counts, len(places))


def test_the_led_current_is_limited() -> None:
    assert Dlpc350EngineOptions(patterns="p", led_current=0.4).current_byte == 102
    with pytest.raises(ConfigError, match=r"led_current is 0\.6, led_current_limit allows 0\.5"):
        validate(Dlpc350EngineOptions, {"patterns": "p", "led_current": 0.6}, "the table")
    assert Dlpc350EngineOptions(patterns="p", led_current=0.6, led_current_limit=0.6).colour is LedColour.WHITE


def scan(*, rows: bool = False) -> PatternSequence:
    return whole_scan(MIRRORS, period_px=8, line_width_px=1, rows=rows)


def few(*patterns: Pattern) -> PatternSequence:
    return encode(patterns, MIRRORS)


def test_planes_fill_green_then_red_then_blue_from_the_lowest_bit_and_are_given_back() -> None:
    # One pixel in each plane: the plane's number is its column.
    planes = [np.zeros(MIRRORS.shape, np.bool_) for _ in range(24)]
    for number, plane in enumerate(planes):
        plane[2, number] = True
    content = encode_picture(planes)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (1140, 912, 3)
    # OpenCV gives blue, green, red.
    for number, pixel in ((0, (0, 1, 0)), (7, (0, 128, 0)), (8, (0, 0, 1)), (15, (0, 0, 128)), (23, (128, 0, 0))):
        assert tuple(picture[2, number]) == pixel
    assert np.count_nonzero(picture) == 24
    assert all(np.array_equal(a, b) for a, b in zip(decode_planes(content, "made"), planes, strict=True))


def test_a_picture_of_another_kind_or_that_is_cut_and_shades_of_grey_are_refused() -> None:
    shapes = ((1140, 911, 3), (800, 1280, 3), (1140, 912))
    others = [cv2.imencode(".bmp", np.zeros(shape, np.uint8))[1].tobytes() for shape in shapes]
    whole = encode_picture([])
    for content in (*others, whole[:10], whole[:60], whole[:-1]):
        with pytest.raises(ConfigError, match="expected a BMP file of 912 x 1140 pixels with 24 bits"):
            decode_planes(content, "splash.bmp")
    grey = PatternSequence(MIRRORS, (White(),), (np.full((1, 1), 128, np.uint8),))
    with pytest.raises(UnsupportedByDeviceError, match="plays patterns of 1 bit: use lines"):
        pattern_plane(grey, 0)


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
    places = read_flash_list(tmp_path).places(sequence)
    images = [place.image for place in places]
    assert images == sorted(images)
    listed = json.loads((tmp_path / LIST_FILE).read_text())
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
        read_flash_list(tmp_path).places(scan())
    text = str(refused.value)
    assert "lacks 28 of 28 patterns (white, black, column Gray bit 0 of 8, cell 4 px and 25 more)" in text
    assert list(tmp_path.iterdir()) == []
    text = read_flash_list(tmp_path).write_patterns(scan())
    flash = read_flash_list(tmp_path / EXPORT_FOLDER)
    assert str(tmp_path / EXPORT_FOLDER) in text
    assert f'"{flash.tag}"' in text
    assert len(flash.places(scan())) == 28


def test_what_is_flashed_already_keeps_its_place(tmp_path: Path) -> None:
    first, second = (
        few(White(), *(LineShift(Axis.COLUMN, 1, period) for period in periods)) for periods in ((8, 9), (9, 12))
    )
    write_pictures(tmp_path, first)
    before = read_flash_list(tmp_path)
    with pytest.raises(UnsupportedByDeviceError, match="lacks 1 of 3 patterns"):
        before.places(second)
    before.write_patterns(second)
    after = read_flash_list(tmp_path / EXPORT_FOLDER)
    assert [picture.flash_index for picture in after.pictures] == [0, 1]
    assert after.places(first) == before.places(first)
    assert {place.image for place in after.places(second)} == {1}
    assert after.tag != before.tag


def test_the_picture_in_the_buffer_is_kept_as_long_as_it_serves(tmp_path: Path) -> None:
    a, b, c = (LineShift(Axis.COLUMN, shift, 8) for shift in range(3))
    first = write_pictures(tmp_path, few(White(), a))
    second = write_pictures(tmp_path, few(White(), b, c), first.pictures)
    assert second.places(few(White(), Black(), b, c, White())) == (
        FlashedPlane(1, 0, inverted=False),
        FlashedPlane(1, 0, inverted=True),
        FlashedPlane(1, 1, inverted=False),
        FlashedPlane(1, 2, inverted=False),
        FlashedPlane(1, 0, inverted=False),
    )
    assert [place.image for place in second.places(few(White(), a, b, White()))] == [0, 0, 1, 1]


def test_a_picture_that_was_changed_is_refused(tmp_path: Path) -> None:
    flash = write_pictures(tmp_path, few(White()))
    path = tmp_path / f"{flash.tag}-0.bmp"
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"not the picture that images\.json lists"):
        read_flash_list(tmp_path)
    path.unlink()
    with pytest.raises(ConfigError, match="No such file"):
        read_flash_list(tmp_path)


def test_faults_of_the_list_are_reported_at_once(tmp_path: Path) -> None:
    flash = write_pictures(tmp_path, few(White()))
    listed = json.loads((tmp_path / LIST_FILE).read_text())
    listed["images"] *= 2
    (tmp_path / LIST_FILE).write_text(json.dumps(listed))
    with pytest.raises(ConfigError, match=r"each flash_index once, found \[0, 0\]"):
        read_flash_list(tmp_path)
    image = {"flash_index": 300, "file": "a.bmp", "sha256": "0", "planes": []}
    (tmp_path / LIST_FILE).write_text(
        json.dumps({"format": "slrig-dlpc350-images", "version": 2, "tagg": "x", "images": [image]})
    )
    with pytest.raises(ConfigError) as refused:
        read_flash_list(tmp_path)
    for words in ("version", "tagg: unknown key; did you mean 'tag'?", "flash_index", "sha256", "planes"):
        assert words in str(refused.value)
    with pytest.raises(UnsupportedByDeviceError, match="limit of 64"):
        write_pictures(tmp_path, few(White()), flash.pictures * 64)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write pictures"):
        write_pictures(tmp_path / "file" / "folder", few(White()))

"""What only this driver does, above a peer that speaks its protocol, and is as unhelpful as its documents allow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.dlpc350.flash import Flash, write_pictures
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.planes import MIRRORS
from drivers.dlpc350.projector import DLPC350, LightEngine
from drivers.pattern_engine.link import Link
from slrig.devices import FlashedProjector
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence
from tests.contract.dlpc350_device import Cable
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


@pytest.mark.parametrize("image_kept_s", [None, 0.01])
def test_light_is_waited_for_as_long_as_a_picture_takes(image_kept_s: float | None) -> None:
    bench = Bench(load_s=0.15, keeps=image_kept_s is not None)
    projector = bench.loaded(image_load_s=0.15, image_kept_s=image_kept_s)
    # As long as no document says that the engine keeps a picture, each pattern of it is waited for.
    for index, load_s in ((2, 0.15), (0, image_kept_s or 0.15), (1, image_kept_s or 0.15)):
        begun_ns = bench.clock.now_ns()
        shown = projector.show(index)
        assert bench.shows(SEQUENCE.profiles[index])
        assert bench.clock.now_ns() - begun_ns == round(load_s * 1e9)
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
    with pytest.raises(UnsupportedByDeviceError, match=f'tagged "{flash.tag}", the engine says "factory"'):
        bench.open()
    assert bench.engine.lit is None
    bench.flash = Flash(flash.folder, None, flash.pictures)
    bench.open().close()
    bench.flash = write_pictures(tmp_path, SEQUENCE, flash.pictures)
    bench.engine.tag = bench.flash.tag or ""
    with pytest.raises(UnsupportedByDeviceError, match="names picture 1 of its flash, it holds 1"):
        bench.open()


def test_a_flash_without_a_list_asks_for_pictures(bench: Bench, tmp_path: Path) -> None:
    bench.flash = Flash(tmp_path)
    projector = bench.open()
    with pytest.raises(UnsupportedByDeviceError, match=r"lacks 3 of 3 patterns.*slrig patterns"):
        projector.load(SEQUENCE)
    assert list(tmp_path.iterdir()) == [], "what is only tried is not written"
    assert isinstance(projector, FlashedProjector)
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
    bench.engine.faults.bent = {0x1A29: bytes(8)}


def lacks_a_picture(bench: Bench) -> None:
    bench.engine._planes[7] = bench.engine._planes.pop(0)


def never_runs(bench: Bench) -> None:
    bench.engine.faults.never_runs = True
    bench.engine._hardware |= 8


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (bends_its_timing, "asked for exposure period"),
        (lacks_a_picture, "a pattern number in the table is not one that it has"),
        (never_runs, "did not start the sequence in time, and says: a picture was taken before"),
    ],
)
def test_what_keeps_a_sequence_from_its_light_is_an_error_and_dark(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Bench], None], words: str
) -> None:
    monkeypatch.setattr("drivers.dlpc350.projector.RUNNING_S", 0.01)
    projector = bench.loaded()
    spoil(bench)
    with pytest.raises(DeviceError, match=words) as refused:
        projector.show(0)
    assert isinstance(refused.value, UnsupportedByDeviceError) is (spoil is not never_runs)
    assert bench.engine.lit is None


def test_an_engine_that_is_gone_while_it_is_opened_is_gone(bench: Bench) -> None:
    bench.cable = Cable(bench.engine)
    bench.cable.unplug()
    with pytest.raises(DeviceGoneError):
        LightEngine(Link(bench.cable.host, "light engine", DLPC350), EngineOptions(patterns="p"), bench.flash)

"""Every reason to refuse an output, found in its description, with the command that mends it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.display.edid import Edid
from drivers.screen.connection import XScreen
from drivers.screen.randr import IDENTITY, UPRIGHT, Mode, Output, Picture
from drivers.screen.refusals import chosen, require_exact, require_true_colour
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

NATIVE = Mode(1, Size(1280, 800), 1 / 60)
RAMP = np.tile(np.linspace(0, 65535, 256).round().astype(np.uint16), (3, 1))
PICTURE = Picture(7, 1920, 0, NATIVE.size, NATIVE, UPRIGHT, IDENTITY, (0, 0, 0, 0), RAMP, ("HDMI-1",))
OUTPUT = Output("HDMI-1", True, (NATIVE,), PICTURE, Edid("EPS", "PJ 720", "1"))
DESK = Mode(2, Size(1920, 1080), 1 / 60)
DESKTOP = Output(
    "eDP-1", True, (DESK,), replace(PICTURE, controller=6, x=0, size=DESK.size, mode=DESK, outputs=("eDP-1",))
)


def refused(output: Output, *others: Output, native: Size | None = None, monitor: str | None = None) -> str:
    with pytest.raises(UnsupportedByDeviceError) as caught:
        require_exact(output, (output, *others), native=native, monitor=monitor)
    return str(caught.value)


def shown(**changes: Any) -> Output:
    return replace(OUTPUT, picture=replace(PICTURE, **changes))


def test_an_exact_output_is_taken() -> None:
    assert require_exact(OUTPUT, (DESKTOP, OUTPUT), native=None, monitor="PJ 720") is PICTURE
    assert require_exact(OUTPUT, (DESKTOP, OUTPUT), native=NATIVE.size, monitor="EPS PJ 720") is PICTURE


def test_a_mode_that_the_projector_scales_is_refused() -> None:
    said = refused(shown(mode=DESK, size=DESK.size))
    assert "its mode is 1920 x 1080 at 60.00 Hz, the projector's own raster is 1280 x 800 (its EDID)" in said
    assert "xrandr --output HDMI-1 --mode 1280x800" in said


def test_the_data_sheet_counts_more_than_the_edid() -> None:
    said = refused(OUTPUT, native=Size(854, 480))
    assert "raster is 854 x 480 (the rig file's native_px)" in said
    assert "--mode 854x480" in said


def test_a_raster_that_nobody_tells_is_asked_for() -> None:
    assert "write native_px = [width, height]" in refused(replace(OUTPUT, preferred=()))


def test_an_interlaced_mode_is_refused() -> None:
    assert "every other row is late" in refused(shown(mode=replace(NATIVE, interlaced=True)))


def test_a_mode_without_a_rate_is_refused() -> None:
    assert "does not tell the time of a frame" in refused(shown(mode=replace(NATIVE, refresh_s=None)))


@pytest.mark.parametrize(
    ("rotation", "words"), [(2, "turned left"), (4, "turned upside down"), (1 | 16, "mirrored in x"), (8 | 32, "in y")]
)
def test_a_turned_or_mirrored_picture_is_refused(rotation: int, words: str) -> None:
    said = refused(shown(rotation=rotation))
    assert words in said
    assert "--rotate normal --reflect normal" in said


def test_a_transformed_picture_is_refused() -> None:
    said = refused(shown(transform=(98304, 0, 0, 0, 98304, 0, 0, 0, 65536), size=Size(1920, 1200)))
    assert "[1.5, 0, 0; 0, 1.5, 0; 0, 0, 1]" in said
    assert "--transform none --scale 1x1" in said


def test_a_panned_picture_is_refused() -> None:
    said = refused(shown(panning=(1920, 0, 2560, 1600), size=Size(2560, 1600)), DESKTOP)
    assert "--panning 1280x800+1920+0" in said
    assert said.count("xrandr") == 1


@pytest.mark.parametrize("power", [1 / 2.2, 0.9, 1.1])
def test_a_gamma_ramp_is_refused(power: float) -> None:
    bent = (65535 * np.linspace(0, 1, 256) ** power).astype(np.uint16)
    said = refused(shown(gamma=np.stack([RAMP[0], RAMP[1], bent])))
    assert "gamma ramp" in said
    assert "xrandr --output HDMI-1 --gamma 1:1:1 --brightness 1" in said


@pytest.mark.parametrize("entries", [256, 1024])
def test_the_servers_own_ramps_are_straight(entries: int) -> None:
    coarse = (np.arange(entries) * (65536 // entries)).astype(np.uint16)
    output = shown(gamma=np.tile(coarse, (3, 1)))
    assert require_exact(output, (), native=None, monitor=None) is output.picture


def test_no_ramp_at_all_is_no_fault() -> None:
    output = shown(gamma=np.zeros((3, 0), np.uint16))
    assert require_exact(output, (), native=None, monitor=None) is output.picture


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("Broadcast RGB", "Limited 16:235", '--set "Broadcast RGB" "Full"'),
        ("underscan", "on", "--set underscan off"),
        ("CTM", (0, 1, 0, 0, 0, 0, 0, 0, 0x80000000, 0, 0, 0, 0, 0, 0, 0, 0, 1), "--set CTM 0,1,0,0,0,0,0,0,0,1"),
    ],
)
def test_properties_of_the_graphics_driver_that_change_levels_are_refused(
    name: str, value: str | tuple[int, ...], words: str
) -> None:
    assert words in refused(replace(OUTPUT, properties={name: value}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("Broadcast RGB", "Automatic"),
        ("underscan", "off"),
        ("CTM", (0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1)),
        ("CTM", (0,) * 18),
    ],
)
def test_properties_that_change_nothing_are_no_fault(name: str, value: str | tuple[int, ...]) -> None:
    assert require_exact(replace(OUTPUT, properties={name: value}), (), native=None, monitor=None) is PICTURE


def test_outputs_that_show_the_same_are_refused() -> None:
    mirrored = replace(DESKTOP, picture=replace(DESKTOP.picture or PICTURE, x=1280))
    assert "eDP-1 shows the same part of the screen; xrandr --output HDMI-1 --right-of eDP-1" in refused(
        OUTPUT, mirrored
    )
    assert "eDP-1 shows the same" in refused(shown(outputs=("HDMI-1", "eDP-1")))


def test_an_output_that_is_off_is_refused_with_the_command_that_puts_it_beside_the_other() -> None:
    off = replace(OUTPUT, picture=None)
    assert "it is switched off; xrandr --output HDMI-1 --preferred --right-of eDP-1" in refused(off, DESKTOP)
    assert "--mode 854x480 --right-of eDP-1" in refused(off, DESKTOP, native=Size(854, 480))


def test_another_display_than_the_rig_files_is_refused() -> None:
    said = refused(OUTPUT, monitor="BNQ TH585")
    assert "'BNQ TH585' is connected, found 'EPS PJ 720'" in said


def test_all_faults_come_together() -> None:
    said = refused(shown(mode=DESK, size=DESK.size, rotation=2, gamma=RAMP // 2))
    assert all(word in said for word in ("raster", "turned left", "gamma"))


def test_an_output_is_chosen_by_its_name_alone() -> None:
    unplugged = Output("DP-2", False, (), None)
    assert chosen((DESKTOP, OUTPUT, unplugged), "HDMI-1") is OUTPUT
    there = r"eDP-1 \(1920 x 1080 at 60.00 Hz\); HDMI-1 \(EPS PJ 720, 1280 x 800 at 60.00 Hz\)"
    with pytest.raises(DeviceGoneError, match=f"DP-2: nothing is connected to it; connected are: {there}"):
        chosen((DESKTOP, OUTPUT, unplugged), "DP-2")
    with pytest.raises(UnsupportedByDeviceError, match=f"HDMI-A-1: there is none of that name; connected are: {there}"):
        chosen((DESKTOP, OUTPUT, unplugged), "HDMI-A-1")


@pytest.mark.parametrize(
    "changes", [{"depth": 30, "colour_masks": (0x3FF00000, 0xFFC00, 0x3FF)}, {"depth": 16, "bits_per_pixel": 16}]
)
def test_a_screen_without_8_bits_per_colour_is_refused(changes: dict[str, Any]) -> None:
    usual = XScreen(1, 2, 24, 100, 100, (0xFF0000, 0xFF00, 0xFF), 32, True)
    require_true_colour(usual)
    with pytest.raises(UnsupportedByDeviceError, match="DefaultDepth 24"):
        require_true_colour(replace(usual, **changes))
    with pytest.raises(UnsupportedByDeviceError, match="byte order"):
        require_true_colour(replace(usual, little_endian=False))

"""All that needs no X server: options, every reason to refuse an output, and SDL where there is none to ask."""

from __future__ import annotations

import ctypes
import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.display.projector import Edid
from drivers.screen import find_devices, open_projector, sdl, x11
from drivers.screen.options import ScreenOptions
from drivers.screen.randr import (
    IDENTITY,
    UPRIGHT,
    CrtcConfig,
    Output,
    XMode,
    find_output,
    require_exact,
    require_true_colour,
)
from drivers.screen.session import exempting
from drivers.screen.x11 import DisplayWakeLock, XScreen
from slrig.errors import ConfigError, DeviceGoneError, LibraryMissingError, UnsupportedByDeviceError
from slrig.model import Size
from tests.contract.screen_bench import sequence

NATIVE = XMode(1, Size(1280, 800), 1 / 60)
RAMP = np.tile(np.linspace(0, 65535, 256).round().astype(np.uint16), (3, 1))
CRTC = CrtcConfig(7, 1920, 0, NATIVE.size, NATIVE, UPRIGHT, IDENTITY, (0, 0, 0, 0), RAMP, ("HDMI-1",))
OUTPUT = Output("HDMI-1", True, (NATIVE,), CRTC, Edid("EPS", "PJ 720", "1"))
DESK = XMode(2, Size(1920, 1080), 1 / 60)
DESKTOP = Output(
    "eDP-1", True, (DESK,), replace(CRTC, controller=6, x=0, size=DESK.size, mode=DESK, outputs=("eDP-1",))
)


def shown(**changes: Any) -> Output:
    return replace(OUTPUT, crtc=replace(CRTC, **changes))


def ctm(*values: int) -> Output:
    return replace(OUTPUT, properties={"CTM": values})


OFF = replace(OUTPUT, crtc=None)
BENT = (65535 * np.linspace(0, 1, 256) ** 0.9).astype(np.uint16)
SHARED = "eDP-1 shows the same part of the screen; xrandr --output HDMI-1 --right-of eDP-1"


@pytest.mark.parametrize(
    ("output", "wanted", "words"),
    [
        (
            shown(mode=DESK, size=DESK.size),
            {},
            (
                "its mode is 1920 x 1080 at 60.00 Hz, the projector's own raster is 1280 x 800 (its EDID)",
                "xrandr --output HDMI-1 --mode 1280x800",
            ),
        ),
        # The data sheet counts more than the EDID.
        (OUTPUT, {"native": Size(854, 480)}, ("raster is 854 x 480 (the rig file's native_px)", "--mode 854x480")),
        (replace(OUTPUT, preferred=()), {}, ("write native_px = [width, height]",)),
        (shown(mode=replace(NATIVE, interlaced=True)), {}, ("every other row is late",)),
        (shown(mode=replace(NATIVE, refresh_s=None)), {}, ("does not state the duration of a frame",)),
        (shown(rotation=2), {}, ("turned left", "--rotate normal --reflect normal")),
        (shown(rotation=4), {}, ("turned upside down",)),
        (shown(rotation=1 | 16), {}, ("mirrored in x",)),
        (shown(rotation=8 | 32), {}, ("in y",)),
        (
            shown(transform=(98304, 0, 0, 0, 98304, 0, 0, 0, 65536), size=Size(1920, 1200)),
            {},
            ("[1.5, 0, 0; 0, 1.5, 0; 0, 0, 1]", "--transform none --scale 1x1"),
        ),
        (shown(panning=(1920, 0, 2560, 1600), size=Size(2560, 1600)), {}, ("--panning 1280x800+1920+0",)),
        (
            shown(gamma=np.stack([RAMP[0], RAMP[1], BENT])),
            {},
            ("gamma ramp", "xrandr --output HDMI-1 --gamma 1:1:1 --brightness 1"),
        ),
        (replace(OUTPUT, properties={"Broadcast RGB": "Limited 16:235"}), {}, ('--set "Broadcast RGB" "Full"',)),
        (replace(OUTPUT, properties={"underscan": "on"}), {}, ("--set underscan off",)),
        (ctm(0, 1, 0, 0, 0, 0, 0, 0, 0x80000000, 0, 0, 0, 0, 0, 0, 0, 0, 1), {}, ("--set CTM 0,1,0,0,0,0,0,0,0,1",)),
        (shown(x=0, size=DESK.size), {}, (SHARED,)),
        (shown(outputs=("HDMI-1", "eDP-1")), {}, ("eDP-1 shows the same",)),
        (OFF, {}, ("it is switched off; xrandr --output HDMI-1 --preferred --right-of eDP-1",)),
        (OFF, {"native": Size(854, 480)}, ("--mode 854x480 --right-of eDP-1",)),
        (OUTPUT, {"monitor": "BNQ TH585"}, ("the display 'BNQ TH585', found 'EPS PJ 720'",)),
        # All faults come together.
        (shown(mode=DESK, size=DESK.size, rotation=2, gamma=RAMP // 2), {}, ("raster", "turned left", "gamma")),
    ],
)
def test_faults_of_an_output_are_refused_with_the_command_that_corrects_them(
    output: Output, wanted: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(UnsupportedByDeviceError) as caught:
        require_exact(output, (output, DESKTOP), **{"native": None, "monitor": None, **wanted})
    assert all(word in str(caught.value) for word in words), str(caught.value)
    if "panning" in words[0]:
        assert str(caught.value).count("xrandr") == 1


@pytest.mark.parametrize(
    "output",
    [
        OUTPUT,
        # The servers' own ramps, and none.
        *(shown(gamma=np.tile((np.arange(n) * (65536 // n)).astype(np.uint16), (3, 1))) for n in (256, 1024)),
        shown(gamma=np.zeros((3, 0), np.uint16)),
        replace(OUTPUT, properties={"Broadcast RGB": "Automatic", "underscan": "off"}),
        ctm(0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1),
        ctm(*(0,) * 18),
    ],
)
@pytest.mark.parametrize(("native", "monitor"), [(None, "PJ 720"), (NATIVE.size, "EPS PJ 720"), (None, None)])
def test_an_exact_output_is_accepted(output: Output, native: Size | None, monitor: str | None) -> None:
    assert require_exact(output, (DESKTOP, output), native=native, monitor=monitor) is output.crtc


def test_an_output_is_chosen_by_its_name_alone() -> None:
    unplugged = Output("DP-2", False, (), None)
    assert find_output((DESKTOP, OUTPUT, unplugged), "HDMI-1") is OUTPUT
    there = r"eDP-1 \(1920 x 1080 at 60.00 Hz\); HDMI-1 \(EPS PJ 720, 1280 x 800 at 60.00 Hz\)"
    with pytest.raises(DeviceGoneError, match=f"DP-2: nothing is connected to it; connected are: {there}"):
        find_output((DESKTOP, OUTPUT, unplugged), "DP-2")
    with pytest.raises(UnsupportedByDeviceError, match=f"HDMI-A-1: no output has that name; connected are: {there}"):
        find_output((DESKTOP, OUTPUT, unplugged), "HDMI-A-1")


@pytest.mark.parametrize(
    "changes", [{"depth": 30, "colour_masks": (0x3FF00000, 0xFFC00, 0x3FF)}, {"depth": 16, "bits_per_pixel": 16}]
)
def test_a_screen_without_8_bits_per_colour_is_refused(changes: dict[str, Any]) -> None:
    usual = XScreen(1, 24, (0xFF0000, 0xFF00, 0xFF), 32, True)
    require_true_colour(usual)
    with pytest.raises(UnsupportedByDeviceError, match="DefaultDepth 24"):
        require_true_colour(replace(usual, **changes))
    with pytest.raises(UnsupportedByDeviceError, match="byte order"):
        require_true_colour(replace(usual, little_endian=False))


def test_all_faults_of_a_table_come_in_one_message() -> None:
    table = {"outputs": "HDMI-1", "backend": "kms", "native_px": [1280, 0], "latency_s": -1.0, "dark_after_s": 1e9}
    with pytest.raises(ConfigError) as caught:
        open_projector(table, Path())
    for word in ("output: missing", "did you mean 'output'?", "backend", "native_px[1]", "latency_s", "dark_after_s"):
        assert word in str(caught.value), word


def test_a_table_needs_no_more_than_its_output() -> None:
    options = ScreenOptions(output="HDMI-1")
    assert (options.backend, options.native, options.latency_s) == ("auto", None, None)


class PowerManaged:
    """A server of which only the power of its displays is known, without a saver that can be suspended."""

    def __init__(self, level: int) -> None:
        self.level = level
        self.enabled = True
        self.timeout_s = 600

    def has(self, extension: str) -> bool:
        return extension == "DPMS"

    def ask(self, request: str, *, extension: str | None = None) -> SimpleNamespace:
        if extension == "DPMS":
            assert request == "Info"
            return SimpleNamespace(power_level=self.level, state=self.enabled)
        assert request == "GetScreenSaver"
        return SimpleNamespace(timeout=self.timeout_s, interval=600, prefer_blanking=1, allow_exposures=1)

    def do(self, request: str, *arguments: int, extension: str | None = None) -> None:
        if extension == "DPMS" and request == "ForceLevel":
            (self.level,) = arguments
        elif extension == "DPMS":
            self.enabled = {"Enable": True, "Disable": False}[request]
        elif request == "SetScreenSaver":
            self.timeout_s = arguments[0]
        else:
            assert (request, *arguments) == ("ForceScreenSaver", 0)


def test_displays_are_woken_kept_awake_and_released() -> None:
    server = PowerManaged(level=3)
    waking = DisplayWakeLock(server)  # type: ignore[arg-type]
    assert (server.level, server.enabled, server.timeout_s) == (0, False, 0)
    waking.require_awake()
    server.level = 2
    with pytest.raises(UnsupportedByDeviceError, match=r"put to sleep \(suspended\)"):
        waking.require_awake()
    waking.release()
    assert (server.enabled, server.timeout_s) == (True, 600)


def test_a_missing_library_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    x11._import_xcffib.cache_clear()
    monkeypatch.setitem(sys.modules, "xcffib", None)
    for attempt in (lambda: open_projector({"output": "HDMI-1"}, Path()), find_devices):
        with pytest.raises(LibraryMissingError) as caught:
            attempt()
        assert caught.value.install == "apt install libxcb1 && pip install 'slrig[screen]'"


@pytest.fixture
def wayland(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A session without X, its display that of SDL's own driver for tests."""
    library = pytest.importorskip("sdl2", reason="needs PySDL2: pip install 'slrig[screen]'")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    library.SDL_SetHintWithPriority(b"SDL_VIDEODRIVER", b"dummy", library.SDL_HINT_OVERRIDE)
    yield library
    library.SDL_ResetHint(b"SDL_VIDEODRIVER")


def table(output: str, **options: object) -> dict[str, object]:
    return {"output": output, "latency_s": 0.0, "trust_compositor": True, **options}


@pytest.mark.usefixtures("wayland")
def test_a_compositor_that_reports_nothing_is_refused_unless_trusted() -> None:
    (found,) = find_devices()
    with pytest.raises(UnsupportedByDeviceError, match=r"session without X: Wayland.* trust_compositor = true"):
        open_projector(table(found.device, trust_compositor=False), Path())
    with pytest.raises(UnsupportedByDeviceError, match="backend x11 needs an X server"):
        open_projector(table(found.device, backend="x11"), Path())


@pytest.mark.parametrize(
    ("desktop", "words"),
    [
        ("ubuntu:GNOME", "'GNOME on Xorg'"),
        ("X-Cinnamon", "choose 'Cinnamon', not 'Cinnamon on Wayland'"),
        ("KDE", "choose 'Plasma (X11)'"),
        ("labwc:wlroots", "raspi-config"),
        ("sway", "log in to a session with X (Xorg)"),
        (None, "set DISPLAY=:0 and XAUTHORITY"),
    ],
)
def test_a_session_without_x_says_how_to_get_one_and_how_to_do_without(
    monkeypatch: pytest.MonkeyPatch, desktop: str | None, words: str
) -> None:
    for name, value in {"DISPLAY": None, "WAYLAND_DISPLAY": desktop, "XDG_CURRENT_DESKTOP": desktop}.items():
        monkeypatch.delenv(name, raising=False) if value is None else monkeypatch.setenv(name, value)
    with pytest.raises(UnsupportedByDeviceError) as refusal:
        open_projector(table("HDMI-1", trust_compositor=False), Path())
    said = str(refusal.value)
    assert words in said
    if desktop is not None:
        assert f"Wayland ({desktop})" in said
    for command in ("systemctl isolate multi-user.target", "slrig devices", "systemctl isolate graphical.target"):
        assert command in said


@pytest.mark.parametrize(
    ("name", "desktop", "words"),
    [
        ("Mutter (Muffin)", "X-Cinnamon", "org.cinnamon.muffin unredirect-fullscreen-windows"),
        ("", "ubuntu:GNOME", "no setting of GNOME"),
        ("KWin", "KDE", "Shift+Alt+F12"),
        ("", "XFCE", "use_compositing"),
        ("fancy effects", "", "in the settings of the desktop"),
    ],
)
def test_a_compositor_is_told_to_leave_the_patterns_alone(
    monkeypatch: pytest.MonkeyPatch, name: str, desktop: str, words: str
) -> None:
    monkeypatch.setenv("XDG_CURRENT_DESKTOP", desktop)
    said = exempting(name)
    assert words in said
    assert said.count(";") == 1
    assert "'kms'" in said


def test_a_display_is_filled_with_exact_pixels(wayland: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[np.ndarray[Any, np.dtype[np.uint32]]] = []
    present = wayland.SDL_RenderPresent

    def read_and_present(renderer: Any) -> None:
        width_px, height_px = ctypes.c_int(), ctypes.c_int()
        wayland.SDL_GetRendererOutputSize(renderer, ctypes.byref(width_px), ctypes.byref(height_px))
        words = np.zeros((height_px.value, width_px.value), np.uint32)
        form = wayland.SDL_PIXELFORMAT_ARGB8888
        assert wayland.SDL_RenderReadPixels(renderer, None, form, words.ctypes.data, words.strides[0]) == 0
        seen.append(words & np.uint32(0xFFFFFF))
        present(renderer)

    monkeypatch.setattr(wayland, "SDL_RenderPresent", read_and_present)
    (found,) = find_devices()
    projector = open_projector(table(found.device), Path())
    try:
        assert not seen[-1].any()
        shown = sequence(projector.info.size)
        projector.load(shown)
        for index in range(0, len(shown), 7):
            projector.show(index)
            assert np.array_equal(seen[-1], shown.image(index).astype(np.uint32) * 0x010101)
        projector.blank()
        assert not seen[-1].any()
        projector.show(0)
    finally:
        projector.close()
    assert not seen[-1].any()


@pytest.mark.usefixtures("wayland")
def test_a_display_of_another_name_or_size_is_refused() -> None:
    (found,) = find_devices()
    with pytest.raises(UnsupportedByDeviceError, match=rf"no display is of that name; there are: '{found.device}' \("):
        open_projector(table("HDMI-1"), Path())
    with pytest.raises(UnsupportedByDeviceError, match=r"own raster is 320 x 200 \(native_px\)"):
        open_projector(table(found.device, native_px=[320, 200]), Path())


def test_two_displays_of_one_name_are_refused() -> None:
    twins = [("PJ", Size(1280, 800), 60)] * 2
    with pytest.raises(UnsupportedByDeviceError, match="2 displays are of that name"):
        sdl._choose_display(twins, ScreenOptions(output="PJ"))
    with pytest.raises(UnsupportedByDeviceError, match="does not state its refresh rate"):
        sdl._choose_display([("PJ", Size(1280, 800), 0)], ScreenOptions(output="PJ"))


def test_a_missing_library_of_sdl_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(name: str) -> object:
        raise ModuleNotFoundError(name)

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    sdl._import_sdl.cache_clear()
    monkeypatch.setattr(importlib, "import_module", lacking)
    with pytest.raises(LibraryMissingError) as opening:
        open_projector(table("PJ"), Path())
    with pytest.raises(LibraryMissingError) as finding:
        find_devices()
    assert opening.value.install == finding.value.install == "pip install 'slrig[screen]'"

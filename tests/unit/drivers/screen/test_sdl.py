"""SDL where there is no X server to ask: a display by its name, only if its compositor is trusted."""

from __future__ import annotations

import ctypes
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.screen import find_devices, open_projector, sdl
from slrig.errors import LibraryMissingError, UnsupportedByDeviceError
from slrig.model import Size
from tests.contract.screen_bench import sequence


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
    with pytest.raises(UnsupportedByDeviceError, match=r"session without X .* trust_compositor = true"):
        open_projector(table(found.device, trust_compositor=False), Path())
    with pytest.raises(UnsupportedByDeviceError, match="backend x11 needs an X server"):
        open_projector(table(found.device, backend="x11"), Path())


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
    from drivers.screen.options import ScreenOptions

    twins = [("PJ", Size(1280, 800), 60)] * 2
    with pytest.raises(UnsupportedByDeviceError, match="2 displays are of that name"):
        sdl._chosen(twins, ScreenOptions(output="PJ"))
    with pytest.raises(UnsupportedByDeviceError, match="does not tell its refresh rate"):
        sdl._chosen([("PJ", Size(1280, 800), 0)], ScreenOptions(output="PJ"))


def test_a_missing_library_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(name: str) -> object:
        raise ImportError(name)

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    sdl._library.cache_clear()
    monkeypatch.setattr(importlib, "import_module", lacking)
    with pytest.raises(LibraryMissingError) as opening:
        open_projector(table("PJ"), Path())
    with pytest.raises(LibraryMissingError) as finding:
        find_devices()
    assert opening.value.install == finding.value.install == "pip install 'slrig[screen]'"

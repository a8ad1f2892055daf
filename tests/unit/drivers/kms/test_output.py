"""The driver on a card in memory: what it asks of the kernel, what it refuses, what times it states."""

from __future__ import annotations

import ctypes
import errno
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from drivers.kms import find_devices, finding, guard, holding, kernel, open_projector
from drivers.kms.card import KmsMode
from slrig.devices import Projector
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.unit.drivers.conftest import OPENED
from tests.unit.drivers.kms.fake_kernel import CONTROLLERS, CURSOR, PRIMARY, FakeKernel, mode

SIZE = Size(1280, 800)
SEQUENCE = encode(
    scan_patterns(SIZE, line_shift=False, period_px=8, line_width_px=1, gray_cell_px=4, gray_offset_px=0, rows=False),
    SIZE,
)
Install = Callable[..., FakeKernel]


class FakeGuard:
    """Stands for the process; `tests/contract/test_kms_guest.py` has the real one."""

    is_alive = True

    def __init__(self, module: str, duty: str, output: str, handles: tuple[int, ...]) -> None:
        assert (module, len(handles)) == (guard.__name__, 1)
        assert output in duty

    def cover(self) -> bool:
        return True

    def release(self) -> None:
        pass


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    fakes: list[FakeKernel] = []

    def installed(**state: object) -> FakeKernel:
        fake = FakeKernel(tmp_path / "drm", **state)  # type: ignore[arg-type]
        monkeypatch.setattr(finding, "SYSTEM", fake.system)
        for name in ("open_card", "ioctl", "map_memory"):
            monkeypatch.setattr(kernel, name, getattr(fake, name))
        monkeypatch.setattr(holding, "GuardProcess", FakeGuard)
        fakes.append(fake)
        return fake

    yield installed
    while OPENED:
        OPENED.pop().close()
    holding.release_card(finding.DEVICES / "card0")
    for fake in fakes:
        fake.ours.close()
        fake.theirs.close()


def opened(**more: object) -> Projector:
    projector = open_projector({"output": "HDMI-A-1", "latency_s": 0.0, "latency_error_s": 0.0, **more}, Path())
    OPENED.append(projector)
    return projector


def loaded() -> Projector:
    projector = opened()
    projector.load(SEQUENCE)
    return projector


def scanned_out(fake: FakeKernel) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    memory = fake.memory[fake.buffers[fake.values[(PRIMARY, "FB_ID")]] << 12]
    rows = np.frombuffer(memory, "<u4")
    return rows[: len(rows) // SIZE.height_px * SIZE.height_px].reshape(SIZE.height_px, -1)[:, : SIZE.width_px]


@pytest.mark.parametrize("atomic", [True, False])
def test_patterns_are_shown_unchanged(install: Install, atomic: bool) -> None:
    fake = install(atomic=atomic)
    projector = opened()
    assert projector.info.size == SIZE
    assert projector.info.refresh_s == pytest.approx(1 / 60, rel=1e-4)
    projector.load(SEQUENCE)
    for index in range(len(SEQUENCE)):
        projector.show(index)
        assert np.array_equal(scanned_out(fake), SEQUENCE.image(index).astype(np.uint32) * 0x010101), index
    projector.blank()
    assert not scanned_out(fake).any()
    projector.close()
    assert not scanned_out(fake).any()


@pytest.mark.parametrize("atomic", [True, False])
def test_everything_that_changes_pictures_is_switched_off(install: Install, atomic: bool) -> None:
    fake = install(atomic=atomic)
    opened().close()
    assert fake.values[(11, "Broadcast RGB")] == 1
    if not atomic:
        # An older driver gets an identity ramp.
        assert fake.gammas == [value * 257 for value in range(256)]
        assert kernel.SET_CURSOR in [request for request, _ in fake.asked]
        return
    assert {fake.values[(CONTROLLERS[0], name)] for name in ("GAMMA_LUT", "CTM", "VRR_ENABLED")} == {0}
    assert fake.values[(PRIMARY, "rotation")] == 1
    assert fake.values[(CURSOR, "FB_ID")] == fake.values[(CURSOR, "CRTC_ID")] == 0
    source = [fake.values[(PRIMARY, name)] for name in ("SRC_X", "SRC_Y", "SRC_W", "SRC_H")]
    shown = [fake.values[(PRIMARY, name)] for name in ("CRTC_X", "CRTC_Y", "CRTC_W", "CRTC_H")]
    assert [value / 65536 for value in source] == shown == [0, 0, 1280, 800]


def test_a_flips_stamp_is_the_start_of_its_scan_out(install: Install) -> None:
    fake = install()
    projector = loaded()
    stamps: list[int] = []

    def stamped() -> int:
        stamps.append(time.monotonic_ns() // 1000 * 1000)
        return stamps[-1]

    fake.stamp = stamped
    shown = projector.show(0)
    assert projector.info.refresh_s is not None
    assert shown.t_visible_ns == stamps[-1] + round(projector.info.refresh_s * 1e9)
    assert shown.t_err_ns == 500_000


@pytest.mark.parametrize("state", [{"counts": False}, {"stamp": lambda: 0}], ids=["not counted", "zero"])
def test_an_unusable_stamp_is_replaced_by_the_times_of_the_call(install: Install, state: dict[str, object]) -> None:
    install(**state)
    projector = loaded()
    asked_ns = time.monotonic_ns()
    shown = projector.show(0)
    period_ns = round((projector.info.refresh_s or 0) * 1e9)
    assert shown.t_err_ns >= period_ns // 2
    assert shown.t_visible_ns + shown.t_err_ns >= asked_ns + 2 * period_ns
    assert ("does not count" in projector.info.model) == ("counts" in state)


def test_an_event_of_an_earlier_flip_is_ignored(install: Install) -> None:
    fake = install()
    projector = loaded()
    fake.flipped(5)
    fake.refusals[kernel.ATOMIC] = [errno.EBUSY]
    assert projector.show(1).index == 1


def test_a_display_without_refreshes_is_reported(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = install()
    projector = loaded()
    monkeypatch.setattr("drivers.kms.output._FLIP_TIMEOUT_S", 0.05)
    monkeypatch.setattr(fake, "flipped", lambda _: None)
    with pytest.raises(DeviceError, match="made no refresh"):
        projector.show(1)


def test_an_unplugged_or_exchanged_display_is_reported(install: Install) -> None:
    fake = install()
    projector = loaded()
    fake.plug(11, False)
    for use in (lambda: projector.show(0), lambda: projector.load(SEQUENCE)):
        with pytest.raises(DeviceGoneError, match="nothing is connected to it"):
            use()
    fake.modes[11] = [mode(1920, 1080, preferred=True)]
    fake.plug(11, True)
    with pytest.raises(UnsupportedByDeviceError, match="open the rig again"):
        projector.load(SEQUENCE)


def test_wrong_pixels_in_the_frame_buffer_are_reported(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = install()
    projector = loaded()
    send = fake.flipped

    def spoiled(number: int) -> None:
        scanned_out(fake)[3, 5] ^= 1
        send(number)

    monkeypatch.setattr(fake, "flipped", spoiled)
    with pytest.raises(UnsupportedByDeviceError, match=r"1 of 1024000 pixels .* \(row 3, column 5\)"):
        projector.show(0)
    monkeypatch.undo()


@pytest.mark.parametrize(
    ("table", "modes", "message"),
    [
        ({"native_px": [1024, 768]}, None, r"requested 1024 x 768, row by row; its modes are: 1280 x 800 at 60\.00 Hz"),
        ({"refresh_hz": 120}, None, "requested 1280 x 800 at 120 Hz"),
        ({}, [mode(1280, 800)], "no EDID states the projector's own raster"),
        ({}, [mode(1920, 1080, flags=kernel.MODE_INTERLACED, preferred=True)], "interlaced or doubled"),
        ({}, [], "its modes are: none"),
        ({"monitor": "EPS PJ 720"}, None, "found 'a display without EDID'"),
        ({"output": "HDMI-A-2"}, None, r"connected are: HDMI-A-1 \(1280x800\)"),
        ({"output": "HDMI-1"}, None, "it has: HDMI-A-1 .*; HDMI-A-2 .*X names them differently"),
    ],
)
def test_inexact_and_missing_outputs_are_refused(
    install: Install, table: dict[str, object], modes: list[kernel.ModeInfo] | None, message: str
) -> None:
    fake = install()
    if modes is not None:
        fake.modes[11] = modes
    with pytest.raises((UnsupportedByDeviceError, DeviceGoneError), match=message) as refused:
        opened(**table)
    assert isinstance(refused.value, DeviceGoneError) == (table.get("output") == "HDMI-A-2")
    # The card was let go: another program may have it.
    assert not holding._held_cards


def test_of_equal_sizes_the_rate_may_be_chosen(install: Install) -> None:
    fake = install()
    fake.modes[11] = [mode(1280, 800, preferred=True), mode(1280, 800, rate=120)]
    projector = opened(refresh_hz=120)
    assert projector.info.refresh_s == pytest.approx(1 / 120, rel=1e-4)


def test_a_machine_without_a_graphics_driver_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finding, "SYSTEM", tmp_path)
    assert find_devices() == ()
    with pytest.raises(UnsupportedByDeviceError, match="nomodeset"):
        opened()


def test_a_card_of_a_desktop_is_busy_and_its_program_is_named(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(master=False)
    (tmp_path / "proc" / "812").mkdir(parents=True)
    (tmp_path / "proc" / "812" / "comm").write_text("gnome-shell\n")
    monkeypatch.setattr(holding, "PROCESSES", tmp_path / "proc")
    # The number of a socket's device: no guard listens for it.
    with pytest.raises(DeviceBusyError, match=r"held by gnome-shell \(process 812\).*Ctrl\+Alt\+F3"):
        opened()


@pytest.mark.parametrize(
    ("call", "number", "error", "message"),
    [
        ("open", errno.EACCES, DeviceError, "usermod -aG video"),
        ("open", errno.EPERM, DeviceError, "DeviceAllow=char-drm"),
        ("open", errno.ENOENT, DeviceGoneError, "has no access"),
        ("commit", errno.EACCES, DeviceBusyError, "another program has taken"),
        ("commit", errno.ENODEV, DeviceGoneError, "was unplugged"),
        ("commit", errno.ENOSPC, DeviceError, "may lack this mode"),
    ],
)
def test_errors_of_the_kernel_say_what_to_do(
    install: Install, monkeypatch: pytest.MonkeyPatch, call: str, number: int, error: type[Exception], message: str
) -> None:
    fake = install()
    if call == "open":
        monkeypatch.setattr(kernel, "open_card", mock.Mock(side_effect=OSError(number, "refused")))
    else:
        fake.refusals[kernel.ATOMIC] = [number]
    with pytest.raises(error, match=message):
        opened()


def test_a_controller_of_another_display_is_not_used(install: Install) -> None:
    fake = install()
    fake.plug(12, True)
    fake.driven = {11: CONTROLLERS[1], 12: CONTROLLERS[1]}
    opened().close()
    assert fake.values[(11, "CRTC_ID")] == CONTROLLERS[0]
    holding.release_card(finding.DEVICES / "card0")
    fake.possible = 0b10
    with pytest.raises(UnsupportedByDeviceError, match=r"\(HDMI-A-2\); unplug a display"):
        opened()


def test_a_card_stays_ours_and_its_memory_does_not_grow(install: Install) -> None:
    fake = install()
    for _ in range(3):
        projector = opened()
        with pytest.raises(DeviceBusyError, match="close that rig"):
            opened()
        projector.close()
        projector.close()
    assert len(fake.buffers) == len(fake.memory) == 3


def test_connectors_with_a_display_are_found_without_opening_cards(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = install()
    (fake.system / "card0-Writeback-1").mkdir()
    monkeypatch.setattr(kernel, "open_card", None)
    assert [(each.device, each.label) for each in find_devices()] == [("HDMI-A-1", "HDMI-A-1 (1280x800)")]
    assert not fake.asked


# As a C compiler lays the kernel's headers out (6.1): numbers of requests on x86-64, which hold the structure's size.
REQUESTS: dict[str, tuple[type[ctypes.Structure], int]] = {
    "AUTH_MAGIC": (kernel.ObjectNumber, 0x40046411),
    "SET_CLIENT_CAP": (kernel.ClientCap, 0x4010640D),
    "CRTC_GET_SEQUENCE": (kernel.CrtcSequence, 0xC018643B),
    "GET_RESOURCES": (kernel.Resources, 0xC04064A0),
    "GET_CRTC": (kernel.Crtc, 0xC06864A1),
    "SET_CRTC": (kernel.Crtc, 0xC06864A2),
    "SET_CURSOR": (kernel.Cursor, 0xC01C64A3),
    "SET_GAMMA": (kernel.Gamma, 0xC02064A5),
    "GET_ENCODER": (kernel.GetEncoder, 0xC01464A6),
    "GET_CONNECTOR": (kernel.GetConnector, 0xC05064A7),
    "GET_PROPERTY": (kernel.GetProperty, 0xC04064AA),
    "ADD_FB": (kernel.FrameBuffer, 0xC01C64AE),
    "REMOVE_FB": (kernel.ObjectNumber, 0xC00464AF),
    "PAGE_FLIP": (kernel.PageFlip, 0xC01864B0),
    "CREATE_DUMB": (kernel.CreateDumb, 0xC02064B2),
    "MAP_DUMB": (kernel.MapDumb, 0xC01064B3),
    "DESTROY_DUMB": (kernel.ObjectNumber, 0xC00464B4),
    "GET_PLANE_RESOURCES": (kernel.PlaneResources, 0xC01064B5),
    "GET_PLANE": (kernel.GetPlane, 0xC02064B6),
    "GET_PROPERTIES": (kernel.ObjectProperties, 0xC02064B9),
    "SET_OBJECT_PROPERTY": (kernel.SetProperty, 0xC01864BA),
    "ATOMIC": (kernel.Atomic, 0xC03864BC),
    "CREATE_BLOB": (kernel.CreateBlob, 0xC01064BD),
}
SIZES: dict[type[ctypes.Structure], int] = {
    **{structure: number >> 16 & 0x3FFF for structure, number in REQUESTS.values()},
    **{kernel.ModeInfo: 68, kernel.PropertyEnum: 40, kernel.FlipEvent: 32},
}
ON_32_BITS: dict[type[ctypes.Structure], int] = {
    kernel.PlaneResources: 12,
    kernel.ObjectProperties: 28,
    kernel.SetProperty: 20,
}
"""Where it is smaller: on i386, 64 bits are aligned to 32."""


def aligned(structure: type[ctypes.Structure], most: int) -> int:
    """The size of a structure where nothing is aligned to more than so many bytes."""
    end = widest = 0
    for _, kind, *_rest in structure._fields_:
        own = min(ctypes.alignment(kind), most)
        size = aligned(kind, most) if issubclass(kind, ctypes.Structure) else ctypes.sizeof(kind)
        end = -(-end // own) * own + size
        widest = max(widest, own)
    return -(-end // widest) * widest


@pytest.mark.parametrize("structure", SIZES)
def test_a_structure_is_as_large_as_the_kernels(structure: type[ctypes.Structure]) -> None:
    sizes = SIZES[structure], ON_32_BITS.get(structure, SIZES[structure])
    assert (aligned(structure, 8), aligned(structure, 4)) == sizes
    assert ctypes.sizeof(structure) in sizes


@pytest.mark.skipif(struct.calcsize("P") == 4, reason="the numbers are those of 64 bits")
@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_has_the_kernels_number(name: str) -> None:
    assert getattr(kernel, name) == REQUESTS[name][1]


@pytest.mark.parametrize(
    ("flags", "refresh_s", "plain"),
    [
        (0, 0.02, True),
        (kernel.MODE_INTERLACED, 0.01, False),
        (kernel.MODE_DOUBLE_SCAN, 0.04, False),
        (kernel.MODE_DOUBLE_CLOCK, 0.02, False),
    ],
)
def test_a_mode_has_a_frame_duration(flags: int, refresh_s: float, plain: bool) -> None:
    found = KmsMode.from_info(mode(1000, 500, rate=50, flags=flags))
    assert (found.size, found.plain) == (Size(1000, 500), plain)
    assert found.refresh_s == pytest.approx(refresh_s)
    assert bytes(found.info) == found.content


def test_a_mode_without_a_clock_has_none() -> None:
    assert KmsMode.from_info(mode(640, 480, clock=0)).refresh_s == 0

"""Structures and request numbers are the kernel's, on machines of 64 and of 32 bits."""

from __future__ import annotations

import ctypes
import struct

import pytest

from drivers.kms import kernel
from drivers.kms.modes import Mode
from slrig.model import Size
from tests.unit.drivers.kms.fake_kernel import mode

# As a C compiler lays the kernel's headers out (6.1): numbers of requests on x86-64, which hold the structure's size.
REQUESTS: dict[str, tuple[type[ctypes.Structure], int]] = {
    "AUTH_MAGIC": (kernel.Number, 0x40046411),
    "SET_CLIENT_CAP": (kernel.ClientCap, 0x4010640D),
    "CRTC_GET_SEQUENCE": (kernel.Sequence, 0xC018643B),
    "GET_RESOURCES": (kernel.Resources, 0xC04064A0),
    "GET_CRTC": (kernel.Crtc, 0xC06864A1),
    "SET_CRTC": (kernel.Crtc, 0xC06864A2),
    "SET_CURSOR": (kernel.Cursor, 0xC01C64A3),
    "SET_GAMMA": (kernel.Gamma, 0xC02064A5),
    "GET_ENCODER": (kernel.GetEncoder, 0xC01464A6),
    "GET_CONNECTOR": (kernel.GetConnector, 0xC05064A7),
    "GET_PROPERTY": (kernel.GetProperty, 0xC04064AA),
    "ADD_FB": (kernel.FrameBuffer, 0xC01C64AE),
    "REMOVE_FB": (kernel.Number, 0xC00464AF),
    "PAGE_FLIP": (kernel.PageFlip, 0xC01864B0),
    "CREATE_DUMB": (kernel.CreateDumb, 0xC02064B2),
    "MAP_DUMB": (kernel.MapDumb, 0xC01064B3),
    "DESTROY_DUMB": (kernel.Number, 0xC00464B4),
    "GET_PLANE_RESOURCES": (kernel.PlaneResources, 0xC01064B5),
    "GET_PLANE": (kernel.GetPlane, 0xC02064B6),
    "GET_PROPERTIES": (kernel.ObjectProperties, 0xC02064B9),
    "SET_OBJECT_PROPERTY": (kernel.SetProperty, 0xC01864BA),
    "ATOMIC": (kernel.Atomic, 0xC03864BC),
    "CREATE_BLOB": (kernel.CreateBlob, 0xC01064BD),
}
SIZES: dict[type[ctypes.Structure], int] = {
    **{structure: number >> 16 & 0x3FFF for structure, number in REQUESTS.values()},
    **{kernel.ModeInfo: 68, kernel.PropertyWord: 40, kernel.FlipEvent: 32},
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
def test_a_mode_has_the_time_of_a_frame(flags: int, refresh_s: float, plain: bool) -> None:
    found = Mode.of(mode(1000, 500, rate=50, flags=flags))
    assert (found.size, found.plain) == (Size(1000, 500), plain)
    assert found.refresh_s == pytest.approx(refresh_s)
    assert bytes(found.info) == found.content


def test_a_mode_without_a_clock_has_none() -> None:
    assert Mode.of(mode(640, 480, clock=0)).refresh_s == 0

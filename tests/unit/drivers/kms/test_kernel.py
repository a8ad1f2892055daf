"""Structures and request numbers are the kernel's, on machines of 64 and of 32 bits."""

from __future__ import annotations

import ctypes
import struct

import pytest

from drivers.kms import kernel
from drivers.kms.modes import Mode
from slrig.model import Size
from tests.unit.drivers.kms.fake_kernel import mode

# As a C compiler lays the kernel's headers out (6.1): bytes on x86-64, and on i386, where 64 bits are aligned to 32.
SIZES = {
    kernel.ModeInfo: (68, 68),
    kernel.Resources: (64, 64),
    kernel.GetConnector: (80, 80),
    kernel.GetEncoder: (20, 20),
    kernel.Crtc: (104, 104),
    kernel.CreateDumb: (32, 32),
    kernel.MapDumb: (16, 16),
    kernel.FrameBuffer: (28, 28),
    kernel.Number: (4, 4),
    kernel.PageFlip: (24, 24),
    kernel.Cursor: (28, 28),
    kernel.Gamma: (32, 32),
    kernel.PlaneResources: (16, 12),
    kernel.GetPlane: (32, 32),
    kernel.ObjectProperties: (32, 28),
    kernel.SetProperty: (24, 20),
    kernel.PropertyWord: (40, 40),
    kernel.GetProperty: (64, 64),
    kernel.Atomic: (56, 56),
    kernel.CreateBlob: (16, 16),
    kernel.ClientCap: (16, 16),
    kernel.Sequence: (24, 24),
    kernel.FlipEvent: (32, 32),
}
REQUESTS = {
    "AUTH_MAGIC": 0x40046411,
    "SET_CLIENT_CAP": 0x4010640D,
    "CRTC_GET_SEQUENCE": 0xC018643B,
    "GET_RESOURCES": 0xC04064A0,
    "GET_CRTC": 0xC06864A1,
    "SET_CRTC": 0xC06864A2,
    "SET_CURSOR": 0xC01C64A3,
    "SET_GAMMA": 0xC02064A5,
    "GET_ENCODER": 0xC01464A6,
    "GET_CONNECTOR": 0xC05064A7,
    "GET_PROPERTY": 0xC04064AA,
    "ADD_FB": 0xC01C64AE,
    "REMOVE_FB": 0xC00464AF,
    "PAGE_FLIP": 0xC01864B0,
    "CREATE_DUMB": 0xC02064B2,
    "MAP_DUMB": 0xC01064B3,
    "DESTROY_DUMB": 0xC00464B4,
    "GET_PLANE_RESOURCES": 0xC01064B5,
    "GET_PLANE": 0xC02064B6,
    "GET_PROPERTIES": 0xC02064B9,
    "SET_OBJECT_PROPERTY": 0xC01864BA,
    "ATOMIC": 0xC03864BC,
    "CREATE_BLOB": 0xC01064BD,
}
"""On x86-64."""


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
    assert (aligned(structure, 8), aligned(structure, 4)) == SIZES[structure]
    assert ctypes.sizeof(structure) in SIZES[structure]


@pytest.mark.skipif(struct.calcsize("P") == 4, reason="the numbers are those of 64 bits")
@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_has_the_kernels_number(name: str) -> None:
    assert getattr(kernel, name) == REQUESTS[name]


@pytest.mark.parametrize(
    ("flags", "refresh_s", "plain"),
    [
        (0, 0.02, True),
        (kernel.MODE_INTERLACED, 0.01, False),
        (kernel.MODE_DOUBLE_SCAN, 0.04, False),
        (kernel.MODE_DOUBLE_CLOCK, 0.02, False),
    ],
)
def test_a_mode_tells_the_time_of_a_frame(flags: int, refresh_s: float, plain: bool) -> None:
    found = Mode.of(mode(1000, 500, rate=50, flags=flags))
    assert (found.size, found.plain) == (Size(1000, 500), plain)
    assert found.refresh_s == pytest.approx(refresh_s)
    assert bytes(found.info) == found.content


def test_a_mode_without_a_clock_tells_none() -> None:
    assert Mode.of(mode(640, 480, clock=0)).refresh_s == 0

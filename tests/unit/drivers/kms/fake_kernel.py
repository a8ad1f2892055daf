"""A graphics card below the driver: what the kernel would do with its requests, in memory."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.kms import kernel

NAMES = (
    *("type", "FB_ID", "CRTC_ID", "SRC_X", "SRC_Y", "SRC_W", "SRC_H", "CRTC_X", "CRTC_Y", "CRTC_W", "CRTC_H"),
    *("rotation", "MODE_ID", "ACTIVE", "GAMMA_LUT", "CTM", "VRR_ENABLED", "Broadcast RGB", "link-status"),
)
WORDS: Mapping[str, Mapping[str, int]] = {
    "Broadcast RGB": {"Automatic": 0, "Full": 1, "Limited 16:235": 2},
    "link-status": {"Good": 0, "Bad": 1},
}
CONTROLLERS = (41, 42)
ENCODERS = {11: 31, 12: 32}
"""Of each connector."""
PRIMARY, CURSOR = 51, 52
_PLANE = NAMES[1:12]
_REQUESTS = {
    value: f"_{name.lower()}" for name, value in vars(kernel).items() if isinstance(value, int) and value > 1 << 24
}
"""Names of the methods that answer, by request."""


def mode(
    width: int, height: int, *, rate: int = 60, flags: int = 0, preferred: bool = False, clock: int | None = None
) -> kernel.ModeInfo:
    """A video mode with 10 % of blanking each way."""
    across, down = width * 11 // 10, height * 11 // 10
    return kernel.ModeInfo(
        clock=across * down * rate // 1000 if clock is None else clock,
        hdisplay=width,
        vdisplay=height,
        htotal=across,
        vtotal=down,
        vrefresh=rate,
        flags=flags,
        type=kernel.MODE_PREFERRED if preferred else 0,
        name=f"{width}x{height}".encode(),
    )


@dataclass
class FakeKernel:
    """One card with two connectors, HDMI-A-1 and HDMI-A-2. `system` is its /sys/class/drm."""

    system: Path
    atomic: bool = True
    counts: bool = True
    master: bool = True
    refusals: dict[int, list[int]] = field(default_factory=dict)
    """By request, errors that its next calls end with."""
    stamp: Callable[[], int] = time.monotonic_ns
    modes: dict[int, list[kernel.ModeInfo]] = field(default_factory=dict)
    connected: dict[int, bool] = field(default_factory=lambda: {11: True, 12: False})
    driven: dict[int, int] = field(default_factory=dict)
    """Which controller drives which connector's encoder."""
    possible: int = 0b11
    values: dict[tuple[int, str], int] = field(default_factory=dict)
    asked: list[tuple[int, Any]] = field(default_factory=list)
    gammas: list[int] = field(default_factory=list)
    memory: dict[int, mmap.mmap] = field(default_factory=dict)
    buffers: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.ours, self.theirs = socket.socketpair()
        self._numbers = 100
        self.modes.setdefault(11, [mode(1280, 800, preferred=True), mode(1920, 1080), mode(640, 480, rate=75)])
        self.values |= {(PRIMARY, "type"): kernel.PLANE_PRIMARY, (CURSOR, "type"): 2, (11, "Broadcast RGB"): 0}
        self.values |= {(PRIMARY, "rotation"): 4, (CONTROLLERS[0], "GAMMA_LUT"): 77, (CONTROLLERS[0], "CTM"): 78}
        for number, name in ((11, "HDMI-A-1"), (12, "HDMI-A-2")):
            (self.system / f"card0-{name}").mkdir(parents=True)
            self.plug(number, self.connected[number])

    def plug(self, number: int, there: bool) -> None:
        self.connected[number] = there
        folder = self.system / f"card0-HDMI-A-{number - 10}"
        (folder / "status").write_text("connected\n" if there else "disconnected\n")
        (folder / "modes").write_text("".join(f"{each.name.decode()}\n" for each in self.modes.get(number, [])))

    def open_card(self, _path: str) -> int:
        return os.dup(self.ours.fileno())

    def map_memory(self, _handle: int, size: int, offset: int) -> mmap.mmap:
        assert len(self.memory[offset]) == size
        return self.memory[offset]

    def ioctl(self, _handle: int, request: int, told: ctypes.Structure) -> None:
        self.asked.append((request, told))
        waiting = self.refusals.get(request)
        if waiting:
            number = waiting.pop(0)
            raise OSError(number, os.strerror(number))
        getattr(self, _REQUESTS[request])(told)

    def _get_resources(self, told: Any) -> None:
        for pointer, count, numbers in (
            ("crtc_id_ptr", "count_crtcs", CONTROLLERS),
            ("connector_id_ptr", "count_connectors", tuple(ENCODERS)),
        ):
            _fill(getattr(told, pointer), getattr(told, count), numbers, ctypes.c_uint32)
            setattr(told, count, len(numbers))

    def _get_connector(self, told: Any) -> None:
        number = told.connector_id
        modes = self.modes.get(number, []) if self.connected[number] else []
        if told.modes_ptr and told.count_modes >= len(modes):
            array = (kernel.ModeInfo * len(modes))(*modes)
            ctypes.memmove(told.modes_ptr, array, ctypes.sizeof(array))
        _fill(told.encoders_ptr, told.count_encoders, (ENCODERS[number],), ctypes.c_uint32)
        told.count_modes, told.count_encoders, told.encoder_id = len(modes), 1, ENCODERS[number]
        told.connector_type, told.connector_type_id = 11, number - 10
        told.connection = kernel.CONNECTED if self.connected[number] else kernel.DISCONNECTED

    def _get_encoder(self, told: Any) -> None:
        (number,) = (each for each, encoder in ENCODERS.items() if encoder == told.encoder_id)
        told.crtc_id, told.possible_crtcs = self.driven.get(number, 0), self.possible

    def _get_plane_resources(self, told: Any) -> None:
        _fill(told.plane_id_ptr, told.count_planes, (PRIMARY, CURSOR), ctypes.c_uint32)
        told.count_planes = 2

    def _get_plane(self, told: Any) -> None:
        told.possible_crtcs = 1
        # A cursor that some desktop has left there.
        told.crtc_id = self.values.get((told.plane_id, "CRTC_ID"), CONTROLLERS[0] if told.plane_id == CURSOR else 0)

    def _get_properties(self, told: Any) -> None:
        names: tuple[str, ...] = {
            kernel.OBJECT_PLANE: ("type", *_PLANE),
            kernel.OBJECT_CRTC: ("MODE_ID", "ACTIVE", "GAMMA_LUT", "CTM", "VRR_ENABLED"),
            kernel.OBJECT_CONNECTOR: ("CRTC_ID", "Broadcast RGB", "link-status"),
        }[told.obj_type]
        if not self.atomic:
            names = tuple(name for name in names if name in WORDS or name == "type")
        _fill(told.props_ptr, told.count_props, tuple(1000 + NAMES.index(name) for name in names), ctypes.c_uint32)
        values = tuple(self.values.get((told.obj_id, name), 0) for name in names)
        _fill(told.prop_values_ptr, told.count_props, values, ctypes.c_uint64)
        told.count_props = len(names)

    def _get_property(self, told: Any) -> None:
        name = NAMES[told.prop_id - 1000]
        words = WORDS.get(name, {})
        told.name, told.flags = name.encode(), kernel.PROPERTY_ENUM if words else 0
        if told.enum_blob_ptr and told.count_enum_blobs >= len(words):
            array = (kernel.PropertyEnum * len(words))(
                *(kernel.PropertyEnum(value=value, name=word.encode()) for word, value in words.items())
            )
            ctypes.memmove(told.enum_blob_ptr, array, ctypes.sizeof(array))
        told.count_enum_blobs = len(words)

    def _create_dumb(self, told: Any) -> None:
        # Rows of a real card are longer than their pixels.
        told.pitch = (told.width * 4 + 255) // 256 * 256
        told.size = -(-told.pitch * told.height // 4096) * 4096
        told.handle = self._number()
        self.memory[told.handle << 12] = mmap.mmap(-1, told.size)

    def _map_dumb(self, told: Any) -> None:
        told.offset = told.handle << 12

    def _add_fb(self, told: Any) -> None:
        told.fb_id = self._number()
        self.buffers[told.fb_id] = told.handle

    def _remove_fb(self, told: Any) -> None:
        del self.buffers[told.number]

    def _destroy_dumb(self, told: Any) -> None:
        del self.memory[told.number << 12]

    def _create_blob(self, told: Any) -> None:
        told.blob_id = self._number()

    def _atomic(self, told: Any) -> None:
        if not self.atomic:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        objects = _read(told.objs_ptr, told.count_objs, ctypes.c_uint32)
        counts = _read(told.count_props_ptr, told.count_objs, ctypes.c_uint32)
        numbers = _read(told.props_ptr, sum(counts), ctypes.c_uint32)
        values = _read(told.prop_values_ptr, sum(counts), ctypes.c_uint64)
        owners = [each for each, count in zip(objects, counts, strict=True) for _ in range(count)]
        for owner, number, value in zip(owners, numbers, values, strict=True):
            self.values[(owner, NAMES[number - 1000])] = value
        if told.flags & kernel.PAGE_FLIP_EVENT:
            self.flipped(told.user_data)

    def _set_crtc(self, told: Any) -> None:
        self.values[(PRIMARY, "FB_ID")] = told.fb_id

    def _page_flip(self, told: Any) -> None:
        self.values[(PRIMARY, "FB_ID")] = told.fb_id
        self.flipped(told.user_data)

    def flipped(self, number: int) -> None:
        stamp = self.stamp()
        event = kernel.FlipEvent(type=kernel.EVENT_FLIP_COMPLETE, length=32, user_data=number, tv_sec=stamp // 10**9)
        event.tv_usec = stamp % 10**9 // 1000
        self.theirs.send(bytes(event))

    def _get_crtc(self, told: Any) -> None:
        told.fb_id, told.gamma_size = self.values.get((PRIMARY, "FB_ID"), 0), 256

    def _set_object_property(self, told: Any) -> None:
        self.values[(told.obj_id, NAMES[told.prop_id - 1000])] = told.value

    def _set_gamma(self, told: Any) -> None:
        self.gammas = list(_read(told.green, told.gamma_size, ctypes.c_uint16))

    def _set_client_cap(self, told: Any) -> None:
        if told.capability == kernel.CLIENT_CAP_ATOMIC and not self.atomic:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    def _crtc_get_sequence(self, _told: Any) -> None:
        if not self.counts:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    def _auth_magic(self, _told: Any) -> None:
        number = errno.EINVAL if self.master else errno.EACCES
        raise OSError(number, os.strerror(number))

    def _set_cursor(self, _told: Any) -> None:
        pass

    def _number(self) -> int:
        self._numbers += 1
        return self._numbers


def _fill(pointer: int, room: int, numbers: tuple[int, ...], kind: type[ctypes._SimpleCData[int]]) -> None:
    """As the kernel: all of them, or none where there is no room."""
    if pointer and room >= len(numbers):
        array = (kind * len(numbers))(*numbers)
        ctypes.memmove(pointer, array, ctypes.sizeof(array))


def _read(pointer: int, count: int, kind: type[Any]) -> tuple[int, ...]:
    return tuple((kind * count).from_address(pointer))

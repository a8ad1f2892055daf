"""A graphics card as the kernel shows it: connectors, controllers, planes, their properties, and pictures in memory."""

from __future__ import annotations

import ctypes
import errno
import os
import select
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.kms import kernel
from drivers.kms.kernel import MODE_DOUBLE_CLOCK, MODE_DOUBLE_SCAN, MODE_INTERLACED, MODE_PREFERRED, ModeInfo
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

_CLOSE_HZ = 0.5
_SHOWN = 12


@dataclass(frozen=True, slots=True)
class KmsMode:
    """A video mode. content : as the kernel has it. plain : row after row, each once, each pixel once."""

    size: Size
    refresh_s: float
    plain: bool
    preferred: bool
    content: bytes

    @classmethod
    def of(cls, info: ModeInfo) -> KmsMode:
        """What the kernel tells."""
        lines = info.vtotal * (2 if info.flags & MODE_DOUBLE_SCAN else 1) * max(info.vscan, 1)
        pixels = info.htotal * lines / (2 if info.flags & MODE_INTERLACED else 1)
        return cls(
            Size(max(info.hdisplay, 1), max(info.vdisplay, 1)),
            pixels / (info.clock * 1000) if info.clock and pixels else 0.0,
            not info.flags & (MODE_INTERLACED | MODE_DOUBLE_SCAN | MODE_DOUBLE_CLOCK),
            bool(info.type & MODE_PREFERRED),
            bytes(info),
        )

    @property
    def info(self) -> ModeInfo:
        """As the kernel has it."""
        return ModeInfo.from_buffer_copy(self.content.ljust(ctypes.sizeof(ModeInfo), b"\0"))

    def __str__(self) -> str:
        rate = f" at {1 / self.refresh_s:.2f} Hz" if self.refresh_s else ""
        return f"{self.size}{rate}{'' if self.plain else ', interlaced or doubled'}"


def choose_mode(output: str, modes: Sequence[KmsMode], *, native: Size | None, refresh_hz: float | None) -> KmsMode:
    """Return the mode of the projector's own raster.

    Parameters
    ----------
    modes
        In the kernel's order: the best of each size comes first.
    native, refresh_hz
        As in `KmsOptions`.

    Raises
    ------
    UnsupportedByDeviceError
        There is none, or nobody tells which it is.
    """
    there = ", ".join(dict.fromkeys(map(str, modes[:_SHOWN]))) or "none"
    size = native or next((mode.size for mode in modes if mode.preferred), None)
    if size is None:
        message = (
            f"output {output}: no EDID tells the projector's own raster; its modes are: {there}; write native_px = "
            "[width, height] from the data sheet into the rig file"
        )
        raise UnsupportedByDeviceError(message)
    fitting = [mode for mode in modes if mode.size == size and mode.plain and mode.refresh_s]
    if refresh_hz is not None:
        fitting = [mode for mode in fitting if abs(1 / mode.refresh_s - refresh_hz) <= _CLOSE_HZ]
    if not fitting:
        rate = "" if refresh_hz is None else f" at {refresh_hz:g} Hz"
        message = (
            f"output {output}: asked for {size}{rate}, row by row; its modes are: {there}; correct native_px or "
            "refresh_hz in the rig file, or check cable and adapter, which may not carry that mode"
        )
        raise UnsupportedByDeviceError(message)
    # Of equals, what the display itself prefers.
    return next((mode for mode in fitting if mode.preferred), fitting[0])


PropertyChange = tuple[int, int, int]
"""An object, one of its properties, and the property's value."""


@dataclass(frozen=True, slots=True)
class CardConnector:
    """A connector. controllers : indices of those that can drive it. controller : the number of the one that does."""

    number: int
    name: str
    connected: bool
    modes: tuple[KmsMode, ...]
    controllers: frozenset[int]
    controller: int


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an object. words : its possible values by name, where it is a word."""

    number: int
    value: int
    words: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class KmsPlane:
    """What a controller takes a picture from. controllers : a bit for each index of those that can."""

    number: int
    controller: int
    controllers: int


@dataclass(frozen=True, slots=True, eq=False)
class DumbBuffer:
    """A picture that can be scanned out. number : its frame buffer. pixels : (H, W) uint32, 0x00RRGGBB."""

    number: int
    handle: int
    pixels: NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Flip:
    """A picture was flipped to: the number that it was asked for by, and the kernel's time stamp (CLOCK_MONOTONIC)."""

    number: int
    stamp_ns: int


class Card:
    """An open card. Raises OSError wherever the kernel refuses."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.atomic = self._can(kernel.CLIENT_CAP_ATOMIC)
        self._can(kernel.CLIENT_CAP_UNIVERSAL_PLANES)

    def close(self) -> None:
        """Let the card go."""
        with suppress(OSError):
            os.close(self.handle)

    def controllers(self) -> tuple[int, ...]:
        """Numbers of the controllers (CRTC), by index."""
        return self._resources()[0]

    def connectors(self) -> tuple[CardConnector, ...]:
        """Every connector, as of the kernel's last look."""
        return tuple(self.connector(number, probe=False) for number in self._resources()[1])

    def connector(self, number: int, *, probe: bool) -> CardConnector:
        """One connector; `probe` looks anew at what is connected, which takes a part of a second."""
        told = kernel.GetConnector(connector_id=number, count_modes=0 if probe else 1)
        modes = (kernel.ModeInfo * 1)()
        told.modes_ptr = ctypes.addressof(modes)
        self._ask(kernel.GET_CONNECTOR, told)
        while True:
            modes = (kernel.ModeInfo * max(told.count_modes, 1))()
            encoders = (ctypes.c_uint32 * max(told.count_encoders, 1))()
            there = kernel.GetConnector(
                connector_id=number,
                modes_ptr=ctypes.addressof(modes),
                encoders_ptr=ctypes.addressof(encoders),
                # Never 0: the kernel would look anew.
                count_modes=len(modes),
                count_encoders=len(encoders),
            )
            self._ask(kernel.GET_CONNECTOR, there)
            if there.count_modes <= len(modes) and there.count_encoders <= len(encoders):
                break
            told = there
        possible, controller = self._encoders(list(encoders[: there.count_encoders]), there.encoder_id)
        kind = there.connector_type
        word = kernel.CONNECTOR_TYPES[kind] if kind < len(kernel.CONNECTOR_TYPES) else f"Unknown{kind}"
        return CardConnector(
            number,
            f"{word}-{there.connector_type_id}",
            there.connection != kernel.DISCONNECTED,
            tuple(KmsMode.of(mode) for mode in modes[: there.count_modes]),
            frozenset(index for index in range(32) if possible >> index & 1),
            controller,
        )

    def planes(self) -> tuple[KmsPlane, ...]:
        """Every plane."""
        told = kernel.PlaneResources()
        self._ask(kernel.GET_PLANE_RESOURCES, told)
        numbers = (ctypes.c_uint32 * max(told.count_planes, 1))()
        told.plane_id_ptr = ctypes.addressof(numbers)
        self._ask(kernel.GET_PLANE_RESOURCES, told)
        found = []
        for number in numbers[: told.count_planes]:
            plane = kernel.GetPlane(plane_id=number)
            self._ask(kernel.GET_PLANE, plane)
            found.append(KmsPlane(number, plane.crtc_id, plane.possible_crtcs))
        return tuple(found)

    def properties(self, number: int, kind: int) -> dict[str, Property]:
        """The properties of an object, by name."""
        told = kernel.ObjectProperties(obj_id=number, obj_type=kind)
        self._ask(kernel.GET_PROPERTIES, told)
        numbers = (ctypes.c_uint32 * max(told.count_props, 1))()
        values = (ctypes.c_uint64 * max(told.count_props, 1))()
        told.props_ptr, told.prop_values_ptr = ctypes.addressof(numbers), ctypes.addressof(values)
        self._ask(kernel.GET_PROPERTIES, told)
        found = {}
        for each, value in zip(numbers[: told.count_props], values, strict=False):
            name, words = self._described(each)
            found[name] = Property(each, value, words)
        return found

    def scanned_out(self, controller: int) -> int:
        """The number of the picture that a controller scans out now."""
        told = kernel.Crtc(crtc_id=controller)
        self._ask(kernel.GET_CRTC, told)
        return int(told.fb_id)

    def counts_refreshes(self, controller: int) -> bool:
        """Whether the driver knows when refreshes happen; else its time stamps are when it was done with a request."""
        try:
            self._ask(kernel.CRTC_GET_SEQUENCE, kernel.CrtcSequence(crtc_id=controller))
        except OSError:
            return False
        return True

    def picture(self, size: Size) -> DumbBuffer:
        """Make a black picture."""
        memory = kernel.CreateDumb(width=size.width_px, height=size.height_px, bpp=32)
        self._ask(kernel.CREATE_DUMB, memory)
        shape = {"width": size.width_px, "height": size.height_px, "pitch": memory.pitch, "bpp": 32, "depth": 24}
        buffer = kernel.FrameBuffer(handle=memory.handle, **shape)
        self._ask(kernel.ADD_FB, buffer)
        place = kernel.MapDumb(handle=memory.handle)
        self._ask(kernel.MAP_DUMB, place)
        rows = np.frombuffer(kernel.map_memory(self.handle, memory.size, place.offset), np.uint8)
        rows = rows[: memory.pitch * size.height_px].reshape(size.height_px, memory.pitch)
        pixels = rows[:, : 4 * size.width_px].view("<u4")
        pixels[:] = 0
        return DumbBuffer(buffer.fb_id, memory.handle, pixels)

    def forget(self, pictures: Iterable[tuple[int, int]]) -> None:
        """Free pictures, each a frame buffer and its memory's handle. What is scanned out goes off with its picture."""
        for number, handle in pictures:
            with suppress(OSError):
                self._ask(kernel.REMOVE_FB, kernel.ObjectNumber(number=number))
            with suppress(OSError):
                self._ask(kernel.DESTROY_DUMB, kernel.ObjectNumber(number=handle))

    def blob(self, content: bytes) -> int:
        """Give the kernel bytes that a property can refer to."""
        data = ctypes.create_string_buffer(content, len(content))
        told = kernel.CreateBlob(data=ctypes.addressof(data), length=len(content))
        self._ask(kernel.CREATE_BLOB, told)
        return int(told.blob_id)

    def commit(self, changes: Sequence[PropertyChange], *, flags: int, number: int = 0) -> None:
        """Set properties of several objects at once."""
        by_object: dict[int, list[tuple[int, int]]] = {}
        for each, prop, value in changes:
            by_object.setdefault(each, []).append((prop, value))
        pairs = [pair for each in by_object.values() for pair in each]
        objects = (ctypes.c_uint32 * len(by_object))(*by_object)
        counts = (ctypes.c_uint32 * len(by_object))(*map(len, by_object.values()))
        numbers = (ctypes.c_uint32 * len(pairs))(*(prop for prop, _ in pairs))
        values = (ctypes.c_uint64 * len(pairs))(*(value for _, value in pairs))
        order = kernel.Atomic(
            flags=flags,
            count_objs=len(by_object),
            objs_ptr=ctypes.addressof(objects),
            count_props_ptr=ctypes.addressof(counts),
            props_ptr=ctypes.addressof(numbers),
            prop_values_ptr=ctypes.addressof(values),
            user_data=number,
        )
        self._ask(kernel.ATOMIC, order)

    def set_mode(self, controller: int, connector: int, mode: bytes, picture: int) -> None:
        """Have a controller scan a picture out to a connector, by a mode: without `commit`."""
        kernel.set_mode(self.handle, controller, connector, mode, picture)

    def set_property(self, number: int, kind: int, prop: int, value: int) -> None:
        """Set one property of one object."""
        self._ask(
            kernel.SET_OBJECT_PROPERTY, kernel.SetProperty(value=value, prop_id=prop, obj_id=number, obj_type=kind)
        )

    def flip(self, controller: int, picture: int, number: int) -> None:
        """Have another picture scanned out from the next refresh on, by drivers without `commit`."""
        order = kernel.PageFlip(crtc_id=controller, fb_id=picture, flags=kernel.PAGE_FLIP_EVENT, user_data=number)
        self._ask(kernel.PAGE_FLIP, order)

    def straighten(self, controller: int) -> None:
        """Set a controller's gamma ramp to the identity, if it has one, and hide its cursor: without `commit`."""
        told = kernel.Crtc(crtc_id=controller)
        self._ask(kernel.GET_CRTC, told)
        if told.gamma_size > 1:
            straight = np.rint(np.linspace(0, 65535, told.gamma_size)).astype(np.uint16)
            at = straight.ctypes.data
            gamma = kernel.Gamma(crtc_id=controller, gamma_size=told.gamma_size, red=at, green=at, blue=at)
            self._ask(kernel.SET_GAMMA, gamma)
        with suppress(OSError):
            # A card without one has none to hide.
            self._ask(kernel.SET_CURSOR, kernel.Cursor(flags=kernel.CURSOR_BO, crtc_id=controller))

    def flips(self, timeout_s: float) -> tuple[Flip, ...]:
        """Flips that have happened since the last look; waits for one until the time is over."""
        if not select.select([self.handle], [], [], max(timeout_s, 0))[0]:
            return ()
        try:
            data = os.read(self.handle, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return ()
            raise
        found, at, least = [], 0, ctypes.sizeof(kernel.FlipEvent)
        while at + least <= len(data):
            event = kernel.FlipEvent.from_buffer_copy(data, at)
            if event.type == kernel.EVENT_FLIP_COMPLETE:
                found.append(Flip(event.user_data, event.tv_sec * 10**9 + event.tv_usec * 1000))
            at += max(event.length, 8)
        return tuple(found)

    def is_master(self) -> bool:
        """Whether this handle alone may say what the outputs show."""
        try:
            # As libdrm asks: the request is for masters only, and this number is nobody's.
            self._ask(kernel.AUTH_MAGIC, kernel.ObjectNumber(number=0))
        except OSError as error:
            return error.errno != errno.EACCES
        return True

    def _can(self, capability: int) -> bool:
        try:
            self._ask(kernel.SET_CLIENT_CAP, kernel.ClientCap(capability=capability, value=1))
        except OSError:
            return False
        return True

    def _resources(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Numbers of controllers and connectors."""
        told = kernel.Resources()
        self._ask(kernel.GET_RESOURCES, told)
        # One connector more than there is room for may have come: it is not ours.
        controllers = (ctypes.c_uint32 * max(told.count_crtcs, 1))()
        connectors = (ctypes.c_uint32 * max(told.count_connectors, 1))()
        there = kernel.Resources(
            crtc_id_ptr=ctypes.addressof(controllers),
            connector_id_ptr=ctypes.addressof(connectors),
            count_crtcs=told.count_crtcs,
            count_connectors=told.count_connectors,
        )
        self._ask(kernel.GET_RESOURCES, there)
        return tuple(controllers[: there.count_crtcs]), tuple(connectors[: there.count_connectors])

    def _encoders(self, numbers: Sequence[int], current: int) -> tuple[int, int]:
        """Controllers that can drive any of these, as bits by index; and that of the current one."""
        possible = controller = 0
        for number in numbers:
            told = kernel.GetEncoder(encoder_id=number)
            self._ask(kernel.GET_ENCODER, told)
            possible |= told.possible_crtcs
            if number == current:
                controller = told.crtc_id
        return possible, controller

    def _described(self, number: int) -> tuple[str, Mapping[str, int]]:
        told = kernel.GetProperty(prop_id=number)
        self._ask(kernel.GET_PROPERTY, told)
        words = (kernel.PropertyWord * max(told.count_enum_blobs, 1))()
        if not told.flags & kernel.PROPERTY_ENUM:
            return told.name.decode(), {}
        there = kernel.GetProperty(
            prop_id=number, enum_blob_ptr=ctypes.addressof(words), count_enum_blobs=told.count_enum_blobs
        )
        self._ask(kernel.GET_PROPERTY, there)
        return told.name.decode(), {word.name.decode(): word.value for word in words[: there.count_enum_blobs]}

    def _ask(self, request: int, structure: ctypes.Structure) -> None:
        kernel.ioctl(self.handle, request, structure)

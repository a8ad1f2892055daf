"""A graphics card: connectors and their modes, controllers (CRTC), planes, properties, and frame buffers."""

from __future__ import annotations

import ctypes
import errno
import os
import select
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.display.projector import DisplayOptions
from drivers.kms import kernel
from drivers.kms.kernel import MODE_DOUBLE_CLOCK, MODE_DOUBLE_SCAN, MODE_INTERLACED, MODE_PREFERRED, ModeInfo
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size


class KmsOptions(DisplayOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "kms"`. `output` as the kernel names it (HDMI-A-1, DP-2)."""

    refresh_hz: Annotated[float, Field(ge=1, le=1000, json_schema_extra={"unit": "Hz"})] | None = None
    """Pictures per second, within 0.5; else the rate that the display prefers at that size."""


_RATE_TOLERANCE_HZ = 0.5
_MAX_LISTED = 12

PropertyChange = tuple[int, int, int]
"""An object, one of its properties, and the new value."""


@dataclass(frozen=True, slots=True)
class KmsMode:
    """A video mode. content : the kernel's structure. plain : neither interlaced nor with doubled rows or pixels."""

    size: Size
    refresh_s: float
    plain: bool
    preferred: bool
    content: bytes

    @classmethod
    def from_info(cls, info: ModeInfo) -> KmsMode:
        """Make a mode of the kernel's structure."""
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
        """The kernel's structure."""
        return ModeInfo.from_buffer_copy(self.content.ljust(ctypes.sizeof(ModeInfo), b"\0"))

    def __str__(self) -> str:
        rate = f" at {1 / self.refresh_s:.2f} Hz" if self.refresh_s else ""
        return f"{self.size}{rate}{'' if self.plain else ', interlaced or doubled'}"


def choose_mode(output: str, modes: Sequence[KmsMode], *, native: Size | None, refresh_hz: float | None) -> KmsMode:
    """Return the mode of the projector's own raster.

    Parameters
    ----------
    modes
        In the kernel's order: the best of each size is first.
    native, refresh_hz
        As in `KmsOptions`.

    Raises
    ------
    UnsupportedByDeviceError
        No mode fits, or the raster is unknown.
    """
    names = ", ".join(dict.fromkeys(map(str, modes[:_MAX_LISTED]))) or "none"
    size = native or next((mode.size for mode in modes if mode.preferred), None)
    if size is None:
        message = (
            f"output {output}: no EDID states the projector's own raster; its modes are: {names}; write native_px = "
            "[width, height] from the data sheet into the rig file"
        )
        raise UnsupportedByDeviceError(message)
    fitting = [mode for mode in modes if mode.size == size and mode.plain and mode.refresh_s]
    if refresh_hz is not None:
        fitting = [mode for mode in fitting if abs(1 / mode.refresh_s - refresh_hz) <= _RATE_TOLERANCE_HZ]
    if not fitting:
        rate = "" if refresh_hz is None else f" at {refresh_hz:g} Hz"
        message = (
            f"output {output}: requested {size}{rate}, row by row; its modes are: {names}; correct native_px or "
            "refresh_hz in the rig file, or check cable and adapter, which may not carry that mode"
        )
        raise UnsupportedByDeviceError(message)
    # Of equal modes, the one that the display prefers.
    return next((mode for mode in fitting if mode.preferred), fitting[0])


@dataclass(frozen=True, slots=True)
class CardConnector:
    """A connector. controllers : indices of those that can drive it. controller : number of the one that does."""

    number: int
    name: str
    connected: bool
    modes: tuple[KmsMode, ...]
    controllers: frozenset[int]
    controller: int


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an object. enum_values : its possible values by name, if it is an enumeration."""

    number: int
    value: int
    enum_values: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class KmsPlane:
    """A source of pictures for a controller. controllers : a bit for each index of those that can use it."""

    number: int
    controller: int
    controllers: int


@dataclass(frozen=True, slots=True, eq=False)
class DumbBuffer:
    """A buffer that can be scanned out. number : its frame buffer. pixels : (H, W) uint32, 0x00RRGGBB."""

    number: int
    handle: int
    pixels: NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Flip:
    """A flip that has happened: the number given in its request, and the kernel's time stamp (CLOCK_MONOTONIC)."""

    number: int
    stamp_ns: int


class Card:
    """An open card. Raises OSError wherever the kernel refuses."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.atomic = self._can(kernel.CLIENT_CAP_ATOMIC)
        self._can(kernel.CLIENT_CAP_UNIVERSAL_PLANES)

    def close(self) -> None:
        """Close the card."""
        with suppress(OSError):
            os.close(self.handle)

    def controllers(self) -> tuple[int, ...]:
        """Return the numbers of the controllers (CRTC), by index."""
        return self._resources()[0]

    def connectors(self) -> tuple[CardConnector, ...]:
        """Return every connector, as last detected."""
        return tuple(self.connector(number, probe=False) for number in self._resources()[1])

    def connector(self, number: int, *, probe: bool) -> CardConnector:
        """Return a connector. probe : detect the connected display again, which takes a part of a second."""
        counts = kernel.GetConnector(connector_id=number, count_modes=0 if probe else 1)
        modes = (kernel.ModeInfo * 1)()
        counts.modes_ptr = ctypes.addressof(modes)
        self._request(kernel.GET_CONNECTOR, counts)
        while True:
            modes = (kernel.ModeInfo * max(counts.count_modes, 1))()
            encoders = (ctypes.c_uint32 * max(counts.count_encoders, 1))()
            answer = kernel.GetConnector(
                connector_id=number,
                modes_ptr=ctypes.addressof(modes),
                encoders_ptr=ctypes.addressof(encoders),
                # Never 0: the kernel would detect again.
                count_modes=len(modes),
                count_encoders=len(encoders),
            )
            self._request(kernel.GET_CONNECTOR, answer)
            if answer.count_modes <= len(modes) and answer.count_encoders <= len(encoders):
                break
            counts = answer
        possible, controller = self._encoders(list(encoders[: answer.count_encoders]), answer.encoder_id)
        kind = answer.connector_type
        name = kernel.CONNECTOR_TYPES[kind] if kind < len(kernel.CONNECTOR_TYPES) else f"Unknown{kind}"
        return CardConnector(
            number,
            f"{name}-{answer.connector_type_id}",
            answer.connection != kernel.DISCONNECTED,
            tuple(KmsMode.from_info(mode) for mode in modes[: answer.count_modes]),
            frozenset(index for index in range(32) if possible >> index & 1),
            controller,
        )

    def planes(self) -> tuple[KmsPlane, ...]:
        """Return every plane."""
        answer = kernel.PlaneResources()
        self._request(kernel.GET_PLANE_RESOURCES, answer)
        numbers = (ctypes.c_uint32 * max(answer.count_planes, 1))()
        answer.plane_id_ptr = ctypes.addressof(numbers)
        self._request(kernel.GET_PLANE_RESOURCES, answer)
        found = []
        for number in numbers[: answer.count_planes]:
            plane = kernel.GetPlane(plane_id=number)
            self._request(kernel.GET_PLANE, plane)
            found.append(KmsPlane(number, plane.crtc_id, plane.possible_crtcs))
        return tuple(found)

    def properties(self, number: int, kind: int) -> dict[str, Property]:
        """Return the properties of an object, by name."""
        answer = kernel.ObjectProperties(obj_id=number, obj_type=kind)
        self._request(kernel.GET_PROPERTIES, answer)
        numbers = (ctypes.c_uint32 * max(answer.count_props, 1))()
        values = (ctypes.c_uint64 * max(answer.count_props, 1))()
        answer.props_ptr, answer.prop_values_ptr = ctypes.addressof(numbers), ctypes.addressof(values)
        self._request(kernel.GET_PROPERTIES, answer)
        found = {}
        for each, value in zip(numbers[: answer.count_props], values, strict=False):
            name, enum_values = self._describe_property(each)
            found[name] = Property(each, value, enum_values)
        return found

    def current_buffer(self, controller: int) -> int:
        """Return the frame buffer that a controller scans out."""
        answer = kernel.Crtc(crtc_id=controller)
        self._request(kernel.GET_CRTC, answer)
        return int(answer.fb_id)

    def counts_refreshes(self, controller: int) -> bool:
        """True if the driver counts refreshes; else its time stamps are those of the end of requests."""
        try:
            self._request(kernel.CRTC_GET_SEQUENCE, kernel.CrtcSequence(crtc_id=controller))
        except OSError:
            return False
        return True

    def create_buffer(self, size: Size) -> DumbBuffer:
        """Make a black buffer."""
        memory = kernel.CreateDumb(width=size.width_px, height=size.height_px, bpp=32)
        self._request(kernel.CREATE_DUMB, memory)
        shape = {"width": size.width_px, "height": size.height_px, "pitch": memory.pitch, "bpp": 32, "depth": 24}
        buffer = kernel.FrameBuffer(handle=memory.handle, **shape)
        self._request(kernel.ADD_FB, buffer)
        place = kernel.MapDumb(handle=memory.handle)
        self._request(kernel.MAP_DUMB, place)
        rows = np.frombuffer(kernel.map_memory(self.handle, memory.size, place.offset), np.uint8)
        rows = rows[: memory.pitch * size.height_px].reshape(size.height_px, memory.pitch)
        pixels = rows[:, : 4 * size.width_px].view("<u4")
        pixels[:] = 0
        return DumbBuffer(buffer.fb_id, memory.handle, pixels)

    def free_buffers(self, buffers: Iterable[tuple[int, int]]) -> None:
        """Free buffers, each a frame buffer and its memory's handle. Scan-out of a freed buffer ends."""
        for number, handle in buffers:
            with suppress(OSError):
                self._request(kernel.REMOVE_FB, kernel.ObjectNumber(number=number))
            with suppress(OSError):
                self._request(kernel.DESTROY_DUMB, kernel.ObjectNumber(number=handle))

    def blob(self, content: bytes) -> int:
        """Make a blob of bytes for a property; return its number."""
        data = ctypes.create_string_buffer(content, len(content))
        answer = kernel.CreateBlob(data=ctypes.addressof(data), length=len(content))
        self._request(kernel.CREATE_BLOB, answer)
        return int(answer.blob_id)

    def commit(self, changes: Sequence[PropertyChange], *, flags: int, number: int = 0) -> None:
        """Set properties of several objects together."""
        by_object: dict[int, list[tuple[int, int]]] = {}
        for each, prop, value in changes:
            by_object.setdefault(each, []).append((prop, value))
        pairs = [pair for each in by_object.values() for pair in each]
        objects = (ctypes.c_uint32 * len(by_object))(*by_object)
        counts = (ctypes.c_uint32 * len(by_object))(*map(len, by_object.values()))
        numbers = (ctypes.c_uint32 * len(pairs))(*(prop for prop, _ in pairs))
        values = (ctypes.c_uint64 * len(pairs))(*(value for _, value in pairs))
        request = kernel.Atomic(
            flags=flags,
            count_objs=len(by_object),
            objs_ptr=ctypes.addressof(objects),
            count_props_ptr=ctypes.addressof(counts),
            props_ptr=ctypes.addressof(numbers),
            prop_values_ptr=ctypes.addressof(values),
            user_data=number,
        )
        self._request(kernel.ATOMIC, request)

    def set_mode(self, controller: int, connector: int, mode: bytes, picture: int) -> None:
        """Make a controller scan a buffer out to a connector in a mode, for drivers without `commit`."""
        kernel.set_mode(self.handle, controller, connector, mode, picture)

    def set_property(self, number: int, kind: int, prop: int, value: int) -> None:
        """Set one property of one object."""
        self._request(
            kernel.SET_OBJECT_PROPERTY, kernel.SetProperty(value=value, prop_id=prop, obj_id=number, obj_type=kind)
        )

    def flip(self, controller: int, picture: int, number: int) -> None:
        """Flip to another buffer at the next refresh, for drivers without `commit`."""
        request = kernel.PageFlip(crtc_id=controller, fb_id=picture, flags=kernel.PAGE_FLIP_EVENT, user_data=number)
        self._request(kernel.PAGE_FLIP, request)

    def reset_colours(self, controller: int) -> None:
        """Set a controller's gamma ramp to the identity, if it has one, and hide its cursor, without `commit`."""
        answer = kernel.Crtc(crtc_id=controller)
        self._request(kernel.GET_CRTC, answer)
        if answer.gamma_size > 1:
            identity = np.rint(np.linspace(0, 65535, answer.gamma_size)).astype(np.uint16)
            at = identity.ctypes.data
            gamma = kernel.Gamma(crtc_id=controller, gamma_size=answer.gamma_size, red=at, green=at, blue=at)
            self._request(kernel.SET_GAMMA, gamma)
        with suppress(OSError):
            # The card may have no cursor.
            self._request(kernel.SET_CURSOR, kernel.Cursor(flags=kernel.CURSOR_BO, crtc_id=controller))

    def read_flips(self, timeout_s: float) -> tuple[Flip, ...]:
        """Return flips that have happened since the last call; wait for one until the time is over."""
        if not select.select([self.handle], [], [], max(timeout_s, 0))[0]:
            return ()
        try:
            data = os.read(self.handle, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return ()
            raise
        found, at, size = [], 0, ctypes.sizeof(kernel.FlipEvent)
        while at + size <= len(data):
            event = kernel.FlipEvent.from_buffer_copy(data, at)
            if event.type == kernel.EVENT_FLIP_COMPLETE:
                found.append(Flip(event.user_data, event.tv_sec * 10**9 + event.tv_usec * 1000))
            at += max(event.length, 8)
        return tuple(found)

    def is_master(self) -> bool:
        """True if this handle alone controls the outputs (DRM master)."""
        try:
            # As libdrm does: only a master may send this request; the number belongs to no client.
            self._request(kernel.AUTH_MAGIC, kernel.ObjectNumber(number=0))
        except OSError as error:
            return error.errno != errno.EACCES
        return True

    def _can(self, capability: int) -> bool:
        try:
            self._request(kernel.SET_CLIENT_CAP, kernel.ClientCap(capability=capability, value=1))
        except OSError:
            return False
        return True

    def _resources(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the numbers of controllers and connectors."""
        answer = kernel.Resources()
        self._request(kernel.GET_RESOURCES, answer)
        # A connector added in between is left out.
        controllers = (ctypes.c_uint32 * max(answer.count_crtcs, 1))()
        connectors = (ctypes.c_uint32 * max(answer.count_connectors, 1))()
        filled = kernel.Resources(
            crtc_id_ptr=ctypes.addressof(controllers),
            connector_id_ptr=ctypes.addressof(connectors),
            count_crtcs=answer.count_crtcs,
            count_connectors=answer.count_connectors,
        )
        self._request(kernel.GET_RESOURCES, filled)
        return tuple(controllers[: filled.count_crtcs]), tuple(connectors[: filled.count_connectors])

    def _encoders(self, numbers: Sequence[int], current: int) -> tuple[int, int]:
        """Return the controllers of these encoders, as bits by index, and the controller of the current encoder."""
        possible = controller = 0
        for number in numbers:
            answer = kernel.GetEncoder(encoder_id=number)
            self._request(kernel.GET_ENCODER, answer)
            possible |= answer.possible_crtcs
            if number == current:
                controller = answer.crtc_id
        return possible, controller

    def _describe_property(self, number: int) -> tuple[str, Mapping[str, int]]:
        answer = kernel.GetProperty(prop_id=number)
        self._request(kernel.GET_PROPERTY, answer)
        entries = (kernel.PropertyEnum * max(answer.count_enum_blobs, 1))()
        if not answer.flags & kernel.PROPERTY_ENUM:
            return answer.name.decode(), {}
        filled = kernel.GetProperty(
            prop_id=number, enum_blob_ptr=ctypes.addressof(entries), count_enum_blobs=answer.count_enum_blobs
        )
        self._request(kernel.GET_PROPERTY, filled)
        return answer.name.decode(), {entry.name.decode(): entry.value for entry in entries[: filled.count_enum_blobs]}

    def _request(self, request: int, structure: ctypes.Structure) -> None:
        kernel.ioctl(self.handle, request, structure)

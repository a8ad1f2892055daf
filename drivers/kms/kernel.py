"""The kernel's display interface (DRM/KMS): structures, request numbers, flags and calls.

Sources: `include/uapi/drm/drm.h` and `drm_mode.h`, and the kernel's documentation "Kernel Mode Setting (KMS)". Names
are the kernel's, without the prefix. `ctypes` lays structures out for the running machine.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os

CLIENT_CAP_UNIVERSAL_PLANES = 2
CLIENT_CAP_ATOMIC = 3

PAGE_FLIP_EVENT = 0x01
ATOMIC_NONBLOCK = 0x0200
ATOMIC_ALLOW_MODESET = 0x0400
EVENT_FLIP_COMPLETE = 2
CURSOR_BO = 0x01

OBJECT_CRTC = 0xCCCC_CCCC
OBJECT_CONNECTOR = 0xC0C0_C0C0
OBJECT_PLANE = 0xEEEE_EEEE

PROPERTY_ENUM = 1 << 3
MODE_INTERLACED = 1 << 4
MODE_DOUBLE_SCAN = 1 << 5
MODE_DOUBLE_CLOCK = 1 << 12
MODE_PREFERRED = 1 << 3
CONNECTED, DISCONNECTED = 1, 2
PLANE_PRIMARY = 1

CONNECTOR_TYPES = (
    *("Unknown", "VGA", "DVI-I", "DVI-D", "DVI-A", "Composite", "SVIDEO", "LVDS", "Component", "DIN", "DP", "HDMI-A"),
    *("HDMI-B", "TV", "eDP", "Virtual", "DSI", "DPI", "Writeback", "SPI", "USB"),
)
"""Names of connectors in /sys/class/drm, by their type's number (`drm_connector.c`)."""

_U16, _U32, _U64 = ctypes.c_uint16, ctypes.c_uint32, ctypes.c_uint64


class ModeInfo(ctypes.Structure):
    """`drm_mode_modeinfo`: a video mode; `clock` in kHz."""

    _fields_ = (
        ("clock", _U32),
        ("hdisplay", _U16),
        ("hsync_start", _U16),
        ("hsync_end", _U16),
        ("htotal", _U16),
        ("hskew", _U16),
        ("vdisplay", _U16),
        ("vsync_start", _U16),
        ("vsync_end", _U16),
        ("vtotal", _U16),
        ("vscan", _U16),
        ("vrefresh", _U32),
        ("flags", _U32),
        ("type", _U32),
        ("name", ctypes.c_char * 32),
    )


class Resources(ctypes.Structure):
    """`drm_mode_card_res`: the numbers of a card's controllers (CRTC), connectors and encoders."""

    _fields_ = (
        *((name, _U64) for name in ("fb_id_ptr", "crtc_id_ptr", "connector_id_ptr", "encoder_id_ptr")),
        *((name, _U32) for name in ("count_fbs", "count_crtcs", "count_connectors", "count_encoders")),
        *((name, _U32) for name in ("min_width", "max_width", "min_height", "max_height")),
    )


class GetConnector(ctypes.Structure):
    """`drm_mode_get_connector`. With `count_modes` 0, the kernel detects the connected display again."""

    _fields_ = (
        *((name, _U64) for name in ("encoders_ptr", "modes_ptr", "props_ptr", "prop_values_ptr")),
        *((name, _U32) for name in ("count_modes", "count_props", "count_encoders", "encoder_id", "connector_id")),
        *((name, _U32) for name in ("connector_type", "connector_type_id", "connection", "mm_width", "mm_height")),
        *((name, _U32) for name in ("subpixel", "pad")),
    )


class GetEncoder(ctypes.Structure):
    """`drm_mode_get_encoder`."""

    _fields_ = tuple(
        (name, _U32) for name in ("encoder_id", "encoder_type", "crtc_id", "possible_crtcs", "possible_clones")
    )


class Crtc(ctypes.Structure):
    """`drm_mode_crtc`: a controller, which scans a frame buffer out by a mode."""

    _fields_ = (
        ("set_connectors_ptr", _U64),
        *((name, _U32) for name in ("count_connectors", "crtc_id", "fb_id", "x", "y", "gamma_size", "mode_valid")),
        ("mode", ModeInfo),
    )


class CreateDumb(ctypes.Structure):
    """`drm_mode_create_dumb`: memory that the processor writes and the display reads."""

    _fields_ = (
        *((name, _U32) for name in ("height", "width", "bpp", "flags", "handle", "pitch")),
        ("size", _U64),
    )


class MapDumb(ctypes.Structure):
    """`drm_mode_map_dumb`."""

    _fields_ = (("handle", _U32), ("pad", _U32), ("offset", _U64))


class FrameBuffer(ctypes.Structure):
    """`drm_mode_fb_cmd`: 32 bits per pixel of depth 24 are XRGB8888."""

    _fields_ = tuple((name, _U32) for name in ("fb_id", "width", "height", "pitch", "bpp", "depth", "handle"))


class ObjectNumber(ctypes.Structure):
    """One number, the argument of `RMFB`, `MODE_DESTROY_DUMB` and `AUTH_MAGIC`."""

    _fields_ = (("number", _U32),)


class PageFlip(ctypes.Structure):
    """`drm_mode_crtc_page_flip`."""

    _fields_ = (*((name, _U32) for name in ("crtc_id", "fb_id", "flags", "reserved")), ("user_data", _U64))


class Cursor(ctypes.Structure):
    """`drm_mode_cursor`; handle 0 hides it."""

    _fields_ = (
        ("flags", _U32),
        ("crtc_id", _U32),
        ("x", ctypes.c_int32),
        ("y", ctypes.c_int32),
        ("width", _U32),
        ("height", _U32),
        ("handle", _U32),
    )


class Gamma(ctypes.Structure):
    """`drm_mode_crtc_lut`: a ramp of 16 bits for each colour."""

    _fields_ = (("crtc_id", _U32), ("gamma_size", _U32), ("red", _U64), ("green", _U64), ("blue", _U64))


class PlaneResources(ctypes.Structure):
    """`drm_mode_get_plane_res`."""

    _fields_ = (("plane_id_ptr", _U64), ("count_planes", _U32))


class GetPlane(ctypes.Structure):
    """`drm_mode_get_plane`."""

    _fields_ = (
        *((name, _U32) for name in ("plane_id", "crtc_id", "fb_id", "possible_crtcs", "gamma_size")),
        ("count_format_types", _U32),
        ("format_type_ptr", _U64),
    )


class ObjectProperties(ctypes.Structure):
    """`drm_mode_obj_get_properties`."""

    _fields_ = (
        ("props_ptr", _U64),
        ("prop_values_ptr", _U64),
        *((name, _U32) for name in ("count_props", "obj_id", "obj_type")),
    )


class SetProperty(ctypes.Structure):
    """`drm_mode_obj_set_property`."""

    _fields_ = (("value", _U64), *((name, _U32) for name in ("prop_id", "obj_id", "obj_type")))


class PropertyEnum(ctypes.Structure):
    """`drm_mode_property_enum`: one named value of a property."""

    _fields_ = (("value", _U64), ("name", ctypes.c_char * 32))


class GetProperty(ctypes.Structure):
    """`drm_mode_get_property`."""

    _fields_ = (
        ("values_ptr", _U64),
        ("enum_blob_ptr", _U64),
        ("prop_id", _U32),
        ("flags", _U32),
        ("name", ctypes.c_char * 32),
        ("count_values", _U32),
        ("count_enum_blobs", _U32),
    )


class Atomic(ctypes.Structure):
    """`drm_mode_atomic`: properties of several objects, set together or not at all."""

    _fields_ = (
        ("flags", _U32),
        ("count_objs", _U32),
        *((name, _U64) for name in ("objs_ptr", "count_props_ptr", "props_ptr", "prop_values_ptr", "reserved")),
        ("user_data", _U64),
    )


class CreateBlob(ctypes.Structure):
    """`drm_mode_create_blob`: bytes that a property refers to by a number."""

    _fields_ = (("data", _U64), ("length", _U32), ("blob_id", _U32))


class ClientCap(ctypes.Structure):
    """`drm_set_client_cap`."""

    _fields_ = (("capability", _U64), ("value", _U64))


class CrtcSequence(ctypes.Structure):
    """`drm_crtc_get_sequence`: the count of refreshes, by drivers that count them."""

    _fields_ = (("crtc_id", _U32), ("active", _U32), ("sequence", _U64), ("sequence_ns", ctypes.c_int64))


class FlipEvent(ctypes.Structure):
    """`drm_event_vblank`: a flip has happened, at this time of CLOCK_MONOTONIC."""

    _fields_ = (
        ("type", _U32),
        ("length", _U32),
        ("user_data", _U64),
        *((name, _U32) for name in ("tv_sec", "tv_usec", "sequence", "crtc_id")),
    )


def _both_ways(number: int, structure: type[ctypes.Structure]) -> int:
    return 3 << 30 | ctypes.sizeof(structure) << 16 | ord("d") << 8 | number


AUTH_MAGIC = 1 << 30 | ctypes.sizeof(ObjectNumber) << 16 | ord("d") << 8 | 0x11
SET_CLIENT_CAP = 1 << 30 | ctypes.sizeof(ClientCap) << 16 | ord("d") << 8 | 0x0D
CRTC_GET_SEQUENCE = _both_ways(0x3B, CrtcSequence)
GET_RESOURCES = _both_ways(0xA0, Resources)
GET_CRTC = _both_ways(0xA1, Crtc)
SET_CRTC = _both_ways(0xA2, Crtc)
SET_CURSOR = _both_ways(0xA3, Cursor)
SET_GAMMA = _both_ways(0xA5, Gamma)
GET_ENCODER = _both_ways(0xA6, GetEncoder)
GET_CONNECTOR = _both_ways(0xA7, GetConnector)
GET_PROPERTY = _both_ways(0xAA, GetProperty)
ADD_FB = _both_ways(0xAE, FrameBuffer)
REMOVE_FB = _both_ways(0xAF, ObjectNumber)
PAGE_FLIP = _both_ways(0xB0, PageFlip)
CREATE_DUMB = _both_ways(0xB2, CreateDumb)
MAP_DUMB = _both_ways(0xB3, MapDumb)
DESTROY_DUMB = _both_ways(0xB4, ObjectNumber)
GET_PLANE_RESOURCES = _both_ways(0xB5, PlaneResources)
GET_PLANE = _both_ways(0xB6, GetPlane)
GET_PROPERTIES = _both_ways(0xB9, ObjectProperties)
SET_OBJECT_PROPERTY = _both_ways(0xBA, SetProperty)
ATOMIC = _both_ways(0xBC, Atomic)
CREATE_BLOB = _both_ways(0xBD, CreateBlob)


def open_card(path: str) -> int:
    """Open a card. Raises OSError."""
    return os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)


def ioctl(handle: int, request: int, structure: ctypes.Structure) -> None:
    """Send a request; the answer is written into the structure. Raises OSError."""
    # Imported here, so that this module can be imported on other systems.
    import fcntl

    while True:
        try:
            fcntl.ioctl(handle, request, structure)
        except OSError as error:
            # As libdrm: interrupted by a signal, or by the driver itself.
            if error.errno not in (errno.EINTR, errno.EAGAIN):
                raise
        else:
            return


def map_memory(handle: int, size: int, offset: int) -> mmap.mmap:
    """Map the memory at an offset from `MAP_DUMB`. Raises OSError."""
    return mmap.mmap(handle, size, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)


def set_mode(handle: int, controller: int, connector: int, mode: bytes, picture: int) -> None:
    """Make a controller scan a picture out to a connector in a mode, and wait for it. Works with every driver.

    Raises
    ------
    OSError
    """
    connectors = (ctypes.c_uint32 * 1)(connector)
    order = Crtc(
        set_connectors_ptr=ctypes.addressof(connectors),
        count_connectors=1,
        crtc_id=controller,
        fb_id=picture,
        mode_valid=1,
        mode=ModeInfo.from_buffer_copy(mode),
    )
    ioctl(handle, SET_CRTC, order)

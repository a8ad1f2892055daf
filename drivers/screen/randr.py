"""Outputs of an X server (RandR 1.3 and later), and faults that keep one from showing pixels unchanged."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.display.projector import Edid, parse_edid
from drivers.screen.x11 import XConnection, XScreen, atom_name
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

IDENTITY = (65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
"""The transform that leaves pixels in place, in 1/65536."""

UPRIGHT = 1
"""The value of `CrtcConfig.rotation` without rotation and reflection."""

MAX_GAMMA_DEVIATION = 257
"""Largest deviation of a gamma ramp from the identity, of 65535: one step of 8 bits, as in servers' own ramps."""

_RANDR = "RANDR"
_ATOM = 4
_INTERLACE, _DOUBLE_SCAN = 1 << 4, 1 << 5
_ALL_CHANGES = 1 | 2 | 4 | 8
_CONNECTED = 0
_ORIENTATIONS = {2: "turned left", 4: "turned upside down", 8: "turned right", 16: "mirrored in x", 32: "mirrored in y"}
_IDENTITY_CTM = tuple(word for index in range(9) for word in ((0, 1) if index % 4 == 0 else (0, 0)))
"""3 x 3 numbers of 64 bits, sign and magnitude, 32 binary places: low word first."""


@dataclass(frozen=True, slots=True)
class XMode:
    """A video mode. `refresh_s` is the duration of a frame, None where the mode does not state it."""

    number: int
    size: Size
    refresh_s: float | None
    interlaced: bool = False

    def __str__(self) -> str:
        rate = "" if self.refresh_s is None else f" at {1 / self.refresh_s:.2f} Hz"
        return f"{self.size}{rate}{', interlaced' if self.interlaced else ''}"


@dataclass(frozen=True, slots=True)
class CrtcConfig:
    """The configuration of a CRTC: the rectangle of the screen that it scans out, its mode, and what it changes.

    x, y, size : the rectangle. rotation, transform, panning : as in RandR. gamma : (3, n) uint16, red, green, blue; n
    is 0 where the server has no ramp. outputs : every output that gets these very signals.
    """

    controller: int
    x: int
    y: int
    size: Size
    mode: XMode
    rotation: int
    transform: tuple[int, ...]
    panning: tuple[int, int, int, int]
    gamma: NDArray[np.uint16]
    outputs: tuple[str, ...]

    def overlaps(self, other: CrtcConfig) -> bool:
        """True if two configurations have a pixel of the screen in common."""
        return (
            self.x < other.x + other.size.width_px
            and other.x < self.x + self.size.width_px
            and self.y < other.y + other.size.height_px
            and other.y < self.y + self.size.height_px
        )


@dataclass(frozen=True, slots=True)
class Output:
    """A connector. `crtc` is None where it is switched off; `preferred` are the modes that its display prefers.

    properties : of the graphics driver, by name: an enumerated value, or numbers.
    """

    name: str
    connected: bool
    preferred: tuple[XMode, ...]
    crtc: CrtcConfig | None
    edid: Edid | None = None
    properties: Mapping[str, str | tuple[int, ...]] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.connected:
            return f"{self.name} (nothing connected)"
        state = "switched off" if self.crtc is None else f"{self.crtc.mode}"
        display = f"{self.edid}, " if self.edid is not None and str(self.edid) else ""
        return f"{self.name} ({display}{state})"


def require_randr(connection: XConnection) -> None:
    """Raise UnsupportedByDeviceError unless the server has RandR 1.3."""
    if connection.has(_RANDR):
        version = connection.ask("QueryVersion", 1, 5, extension=_RANDR)
        if (version.major_version, version.minor_version) >= (1, 3):
            return
    message = "the X server does not report its outputs (no RandR 1.3); use Xorg 1.7 or later"
    raise UnsupportedByDeviceError(message)


def watch_outputs(connection: XConnection) -> None:
    """Receive `OUTPUT_CHANGES` events at every change of outputs."""
    connection.do("SelectInput", connection.screen.root, _ALL_CHANGES, extension=_RANDR)


def list_outputs(connection: XConnection, *, probe: bool) -> tuple[Output, ...]:
    """List every output of the screen, connected or not. probe : detect displays again."""
    request = "GetScreenResources" if probe else "GetScreenResourcesCurrent"
    resources = connection.ask(request, connection.screen.root, extension=_RANDR)
    stamp = resources.config_timestamp
    modes = {info.id: _mode(info) for info in resources.modes}
    infos = {each: connection.ask("GetOutputInfo", each, stamp, extension=_RANDR) for each in resources.outputs}
    names = {number: bytes(info.name.raw).decode("latin-1") for number, info in infos.items()}
    return tuple(
        Output(
            names[number],
            info.connection == _CONNECTED,
            tuple(modes[mode] for mode in list(info.modes)[: info.num_preferred] if mode in modes),
            _crtc_config(connection, info.crtc, stamp, modes, names) if info.crtc else None,
            *_read_properties(connection, number),
        )
        for number, info in infos.items()
    )


def _mode(info: Any) -> XMode:
    lines = info.vtotal * (2 if info.mode_flags & _DOUBLE_SCAN else 1)
    has_rate = info.dot_clock and info.htotal and lines
    refresh_s = info.htotal * lines / info.dot_clock if has_rate else None
    interlaced = bool(info.mode_flags & _INTERLACE)
    if refresh_s is not None and interlaced:
        refresh_s /= 2
    return XMode(info.id, Size(max(info.width, 1), max(info.height, 1)), refresh_s, interlaced)


def _crtc_config(
    connection: XConnection, controller: int, stamp: int, modes: Mapping[int, XMode], names: Mapping[int, str]
) -> CrtcConfig | None:
    info = connection.ask("GetCrtcInfo", controller, stamp, extension=_RANDR)
    if info.mode not in modes or not info.width or not info.height:
        return None
    transform = connection.ask("GetCrtcTransform", controller, extension=_RANDR).current_transform
    panning = connection.ask("GetPanning", controller, extension=_RANDR)
    gamma = connection.ask("GetCrtcGamma", controller, extension=_RANDR)
    return CrtcConfig(
        controller,
        info.x,
        info.y,
        Size(info.width, info.height),
        modes[info.mode],
        info.rotation,
        tuple(getattr(transform, f"matrix{row}{column}") for row in (1, 2, 3) for column in (1, 2, 3)),
        (panning.left, panning.top, panning.width, panning.height),
        np.array([list(gamma.red), list(gamma.green), list(gamma.blue)], np.uint16),
        tuple(names.get(number, str(number)) for number in info.outputs),
    )


def _read_properties(connection: XConnection, output: int) -> tuple[Edid | None, dict[str, str | tuple[int, ...]]]:
    """Return the display's EDID, and the properties that are enumerated values or numbers."""
    edid: Edid | None = None
    properties: dict[str, str | tuple[int, ...]] = {}
    for number in connection.ask("ListOutputProperties", output, extension=_RANDR).atoms:
        name = atom_name(connection, number)
        value = connection.ask("GetOutputProperty", output, number, 0, 0, 128, False, False, extension=_RANDR)
        data = bytes(value.data.raw)
        if name == "EDID":
            edid = parse_edid(data)
        elif value.type == _ATOM and value.num_items == 1:
            properties[name] = atom_name(connection, struct.unpack("<I", data)[0])
        elif value.format == 32:
            properties[name] = struct.unpack(f"<{value.num_items}I", data)
    return edid, properties


def find_output(outputs: Sequence[Output], name: str) -> Output:
    """Return the connected output of that name.

    Raises
    ------
    UnsupportedByDeviceError
        No output has that name. Lists the connected ones.
    DeviceGoneError
        Nothing is connected to it.
    """
    connected = "; ".join(str(output) for output in outputs if output.connected) or "none"
    for output in outputs:
        if output.name == name and output.connected:
            return output
        if output.name == name:
            message = (
                f"output {name}: nothing is connected to it; connected are: {connected}; check the cable and that the "
                "projector is on, or write one of these names into the rig file"
            )
            raise DeviceGoneError(message)
    message = (
        f"output {name}: no output has that name; connected are: {connected}; write one of these into the rig file"
    )
    raise UnsupportedByDeviceError(message)


def require_exact(output: Output, others: Sequence[Output], *, native: Size | None, monitor: str | None) -> CrtcConfig:
    """Return an output's configuration if it shows every pixel unchanged, on this output alone.

    Parameters
    ----------
    others
        All outputs; `output` itself may be among them.
    native, monitor
        As in `ScreenOptions`.

    Raises
    ------
    UnsupportedByDeviceError
        It does not. Lists every fault.
    """
    faults = list(list_faults(output, others, native=native, monitor=monitor))
    if faults or output.crtc is None:
        lines = "".join(f"\n  {fault}" for fault in faults)
        message = f"output {output.name} would not show patterns pixel for pixel:{lines}"
        raise UnsupportedByDeviceError(message)
    return output.crtc


def list_faults(output: Output, others: Sequence[Output], *, native: Size | None, monitor: str | None) -> Iterator[str]:
    """Yield every fault of an output, with the command that corrects it."""
    command = f"xrandr --output {output.name}"
    if monitor is not None and monitor not in (str(output.edid), output.edid and output.edid.name):
        yield (
            f"the rig file requests the display '{monitor}', found '{output.edid or 'a display without EDID'}'; swap "
            "the cables, or correct monitor (slrig devices lists the connected displays)"
        )
    crtc = output.crtc
    if crtc is None:
        wanted = f"--mode {native.width_px}x{native.height_px}" if native is not None else "--preferred"
        active = [other.name for other in others if other.crtc is not None and other.name != output.name]
        yield f"it is switched off; {command} {wanted} --right-of {active[-1] if active else 'ANOTHER'}"
        return
    yield from _mode_faults(output, crtc, native, command)
    yield from _geometry_faults(crtc, others, command)
    yield from _colour_faults(output, crtc, command)
    yield from _sharing_faults(output, crtc, others, command)


def require_true_colour(screen: XScreen) -> None:
    """Raise UnsupportedByDeviceError unless a pixel is 8 bits of red, green and blue."""
    if screen.depth != 24 or screen.bits_per_pixel != 32 or screen.colour_masks != (0xFF0000, 0xFF00, 0xFF):
        message = (
            f"the X screen has {screen.depth} bits per pixel in {screen.bits_per_pixel} (colour masks "
            f"{', '.join(map(hex, screen.colour_masks))}), patterns need 8 bits per colour: set DefaultDepth 24 in the "
            "server's configuration (/etc/X11/xorg.conf.d), and start it again"
        )
        raise UnsupportedByDeviceError(message)
    if not screen.little_endian:
        message = "the X server is on a machine with another byte order; run slrig on the machine of the projector"
        raise UnsupportedByDeviceError(message)


def _mode_faults(output: Output, crtc: CrtcConfig, native: Size | None, command: str) -> Iterator[str]:
    mode = crtc.mode
    wanted = [native] if native is not None else [preferred.size for preferred in output.preferred]
    source = "the rig file's native_px" if native is not None else "its EDID"
    if wanted and mode.size not in wanted:
        size = wanted[0]
        yield (
            f"its mode is {mode}, the projector's own raster is {size} ({source}): it would be scaled; {command} "
            f"--mode {size.width_px}x{size.height_px}"
        )
    if not wanted:
        yield (
            f"its mode is {mode}, and no EDID states the projector's own raster; write native_px = [width, height] "
            "from its data sheet into the rig file"
        )
    if mode.interlaced:
        yield f"its mode is {mode}: every other row is late by half a frame; {command} --mode with one without 'i'"
    if mode.refresh_s is None:
        yield f"its mode is {mode}, which does not state the duration of a frame; {command} --mode with another one"


def _geometry_faults(crtc: CrtcConfig, others: Sequence[Output], command: str) -> Iterator[str]:
    if crtc.transform != IDENTITY:
        rows = [crtc.transform[start : start + 3] for start in (0, 3, 6)]
        numbers = "; ".join(", ".join(f"{value / 65536:g}" for value in row) for row in rows)
        yield f"its picture is transformed by [{numbers}]; {command} --transform none --scale 1x1"
    if crtc.rotation != UPRIGHT:
        orientation = " and ".join(name for bit, name in _ORIENTATIONS.items() if crtc.rotation & bit)
        yield f"its picture is {orientation}; {command} --rotate normal --reflect normal"
    _left, _top, width, height = crtc.panning
    size = crtc.mode.size
    if width not in (0, size.width_px) or height not in (0, size.height_px):
        # xrandr may fail to switch panning off by 0x0; an area as large as the picture leaves no room to move.
        other_crtcs = [each.crtc for each in others if each.crtc and each.crtc.controller != crtc.controller]
        right_edge_px = max((each.x + each.size.width_px for each in other_crtcs), default=0)
        area = f"{size.width_px}x{size.height_px}+{right_edge_px}+0"
        yield f"it is a window on {width} x {height} pixels that moves with the pointer; {command} --panning {area}"
    elif crtc.transform == IDENTITY and crtc.rotation == UPRIGHT and crtc.size != size:
        yield f"it shows {crtc.size} pixels of the screen by a mode of {crtc.mode.size}; {command} --scale 1x1"


def _colour_faults(output: Output, crtc: CrtcConfig, command: str) -> Iterator[str]:
    entries = crtc.gamma.shape[1]
    if entries > 1:
        deviation = float(np.abs(crtc.gamma - np.linspace(0, 65535, entries)).max())
        if deviation > MAX_GAMMA_DEVIATION:
            yield (
                f"its gamma ramp is up to {deviation / 65535:.1%} away from the identity: a night light, a colour "
                "profile or a brightness setting; switch that off, then: "
                f"{command} --gamma 1:1:1 --brightness 1"
            )
    properties = output.properties
    if str(properties.get("Broadcast RGB", "")).startswith("Limited"):
        yield f'its driver sends levels 16 to 235 only (Broadcast RGB); {command} --set "Broadcast RGB" "Full"'
    if properties.get("underscan", "off") not in ("off", "auto"):
        yield f"its driver shrinks the picture (underscan); {command} --set underscan off"
    matrix = properties.get("CTM")
    if isinstance(matrix, tuple) and len(matrix) == 18 and any(matrix) and matrix != _IDENTITY_CTM:
        identity = ",".join(map(str, _IDENTITY_CTM))
        yield f"its driver mixes colours (CTM), as night lights do; {command} --set CTM {identity}"


def _sharing_faults(output: Output, crtc: CrtcConfig, others: Sequence[Output], command: str) -> Iterator[str]:
    same = [name for name in crtc.outputs if name != output.name]
    same += [
        other.name
        for other in others
        if other.name not in (output.name, *crtc.outputs) and other.crtc and crtc.overlaps(other.crtc)
    ]
    if same:
        yield f"{', '.join(same)} shows the same part of the screen; {command} --right-of {same[0]}"

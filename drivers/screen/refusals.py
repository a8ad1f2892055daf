"""Why an output would not show pixels as they are, each with the command that mends it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.screen.connection import XScreen
from drivers.screen.randr import IDENTITY, UPRIGHT, Output, Picture
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

MOST_GAMMA_OFF = 257
"""How far a gamma ramp may be from the identity, of 65535: one step of 8 bits, by which servers' own ramps differ."""

_TURNED = {2: "turned left", 4: "turned upside down", 8: "turned right", 16: "mirrored in x", 32: "mirrored in y"}


def chosen(outputs: Sequence[Output], name: str) -> Output:
    """Return the output of that name, which is connected.

    Raises
    ------
    UnsupportedByDeviceError
        There is none of that name. Names those that there are.
    DeviceGoneError
        Nothing is connected to it.
    """
    connected = [output for output in outputs if output.connected]
    there = "; ".join(map(str, connected)) or "none"
    for output in outputs:
        if output.name == name and output.connected:
            return output
        if output.name == name:
            message = (
                f"output {name}: nothing is connected to it; connected are: {there}; check the cable and that the "
                "projector is on, or write one of these names into the rig file"
            )
            raise DeviceGoneError(message)
    message = f"output {name}: there is none of that name; connected are: {there}; write one of these into the rig file"
    raise UnsupportedByDeviceError(message)


def require_exact(output: Output, others: Sequence[Output], *, native: Size | None, monitor: str | None) -> Picture:
    """Return what an output shows, if it shows every pixel as it is, on this output alone.

    Parameters
    ----------
    others
        All outputs; `output` itself may be among them.
    native, monitor
        As in `ScreenOptions`.

    Raises
    ------
    UnsupportedByDeviceError
        With everything that speaks against it.
    """
    faults = list(refusals(output, others, native=native, monitor=monitor))
    if faults or output.picture is None:
        lines = "".join(f"\n  {fault}" for fault in faults)
        message = f"output {output.name} would not show patterns pixel for pixel:{lines}"
        raise UnsupportedByDeviceError(message)
    return output.picture


def refusals(output: Output, others: Sequence[Output], *, native: Size | None, monitor: str | None) -> Iterator[str]:
    """Everything that speaks against an output: what was found, and the command that mends it."""
    command = f"xrandr --output {output.name}"
    if monitor is not None and monitor not in (str(output.edid), output.edid and output.edid.name):
        yield (
            f"the rig file says that '{monitor}' is connected, found '{output.edid or 'a display without EDID'}'; swap "
            "the cables, or correct monitor (slrig devices lists what is where)"
        )
    picture = output.picture
    if picture is None:
        wanted = f"--mode {native.width_px}x{native.height_px}" if native is not None else "--preferred"
        yield f"it is switched off; {command} {wanted} --right-of {_neighbour(output, others)}"
        return
    yield from _wrong_mode(output, picture, native, command)
    yield from _moved(picture, others, command)
    yield from _recoloured(output, picture, command)
    yield from _elsewhere(output, picture, others, command)


def require_true_colour(screen: XScreen) -> None:
    """See that a pixel is 8 bits of red, green and blue. Raises UnsupportedByDeviceError."""
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


def _wrong_mode(output: Output, picture: Picture, native: Size | None, command: str) -> Iterator[str]:
    mode = picture.mode
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
            f"its mode is {mode}, and no EDID tells the projector's own raster; write native_px = [width, height] from "
            "its data sheet into the rig file"
        )
    if mode.interlaced:
        yield f"its mode is {mode}: every other row is late by half a frame; {command} --mode with one without 'i'"
    if mode.refresh_s is None:
        yield f"its mode is {mode}, which does not tell the time of a frame; {command} --mode with another one"


def _moved(picture: Picture, others: Sequence[Output], command: str) -> Iterator[str]:
    if picture.transform != IDENTITY:
        rows = [picture.transform[start : start + 3] for start in (0, 3, 6)]
        numbers = "; ".join(", ".join(f"{value / 65536:g}" for value in row) for row in rows)
        yield f"its picture is transformed by [{numbers}]; {command} --transform none --scale 1x1"
    if picture.rotation != UPRIGHT:
        turned = " and ".join(words for bit, words in _TURNED.items() if picture.rotation & bit)
        yield f"its picture is {turned}; {command} --rotate normal --reflect normal"
    _left, _top, width, height = picture.panning
    size = picture.mode.size
    if width not in (0, size.width_px) or height not in (0, size.height_px):
        # Switched off by 0x0, xrandr may fail; an area as large as the picture leaves nothing to move in.
        area = f"{size.width_px}x{size.height_px}+{_right_edge_px(picture, others)}+0"
        yield f"it is a window on {width} x {height} pixels that moves with the pointer; {command} --panning {area}"
    elif picture.transform == IDENTITY and picture.rotation == UPRIGHT and picture.size != size:
        yield f"it shows {picture.size} pixels of the screen by a mode of {picture.mode.size}; {command} --scale 1x1"


def _recoloured(output: Output, picture: Picture, command: str) -> Iterator[str]:
    entries = picture.gamma.shape[1]
    if entries > 1:
        straight = np.linspace(0, 65535, entries)
        off = float(np.abs(picture.gamma - straight).max())
        if off > MOST_GAMMA_OFF:
            yield (
                f"its gamma ramp is up to {off / 65535:.1%} away from the identity: a night light, a colour profile or "
                f"a brightness setting; switch that off, then: {command} --gamma 1:1:1 --brightness 1"
            )
    properties = output.properties
    if str(properties.get("Broadcast RGB", "")).startswith("Limited"):
        yield f'its driver sends levels 16 to 235 only (Broadcast RGB); {command} --set "Broadcast RGB" "Full"'
    if properties.get("underscan", "off") not in ("off", "auto"):
        yield f"its driver shrinks the picture (underscan); {command} --set underscan off"
    matrix = properties.get("CTM")
    if isinstance(matrix, tuple) and len(matrix) == 18 and any(matrix) and not _is_identity(matrix):
        yield f"its driver mixes colours (CTM), as night lights do; {command} --set CTM {_identity()}"


def _elsewhere(output: Output, picture: Picture, others: Sequence[Output], command: str) -> Iterator[str]:
    same = [name for name in picture.outputs if name != output.name]
    same += [
        other.name
        for other in others
        if other.name not in (output.name, *picture.outputs) and other.picture and picture.overlaps(other.picture)
    ]
    if same:
        yield f"{', '.join(same)} shows the same part of the screen; {command} --right-of {same[0]}"


def _neighbour(output: Output, others: Sequence[Output]) -> str:
    shown = [other.name for other in others if other.picture is not None and other.name != output.name]
    return shown[-1] if shown else "ANOTHER"


def _right_edge_px(picture: Picture, others: Sequence[Output]) -> int:
    """Where the outputs end that are driven otherwise than this picture."""
    shown = [other.picture for other in others if other.picture and other.picture.controller != picture.controller]
    return max((other.x + other.size.width_px for other in shown), default=0)


def _identity() -> str:
    return ",".join(map(str, _IDENTITY_MATRIX))


def _is_identity(matrix: tuple[int, ...]) -> bool:
    return matrix == _IDENTITY_MATRIX


_ONE = (0, 1)
_IDENTITY_MATRIX = tuple(word for index in range(9) for word in (_ONE if index % 4 == 0 else (0, 0)))
"""3 x 3 numbers of 64 bits each, sign and magnitude, 32 binary places: low word first."""

"""What a camera does to its own pictures: switched off where it can be, told where it cannot.

Sharpening makes halos at edges, and a stripe beside a printed edge moves; a curve that is not straight, or one that
follows the picture (backlight compensation, high dynamic range), makes greys of one light differ; noise reduction mixes
neighbours and frames. A frame rate that follows the light makes the time of a frame unknown. Stabilisation moves the
picture. Zoom, pan and tilt stay as the last program left them, which may have been a video call, and a calibration
holds for one value of each: they are set to their defaults, unless a person sets them.

Gamma: the USB Video Class counts it in hundredths, 1 to 500, so 100 is a gamma of 1 (USB Device Class Definition for
Video Devices 1.5, Processing Unit, "Gamma Control"; the same in Windows' KSPROPERTY_VIDEOPROCAMP_GAMMA). Many cameras
apply it on top of a curve of their own, so only a measurement tells that values grow with light: `slrig doctor` makes
it. V4L2 gives the control no unit, so of other drivers no value is known to be linear.

Noise reduction has no standard control; those of makers are known by their names.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from drivers.v4l2 import controls as ctl
from drivers.v4l2 import kernel
from drivers.v4l2.controls import Control, Controls
from slrig.errors import UnsupportedByDeviceError

_LINEAR_GAMMA = 100
_NAMED = re.compile(r"denoise|noise_reduction|(^|_)w?hdr(_|$)|wide_dynamic")


def switch_off_processing(
    handle: int, node: Path, controls: Controls, *, named: Collection[str], is_uvc: bool
) -> tuple[str, ...]:
    """Set what the device lets be set, read it back, and return what is not as it should be, in words.

    named : controls that a person sets, which are left to that person. is_uvc : the camera is one of USB's class.

    Raises
    ------
    DeviceGoneError
        The device is gone. What it refuses is told, not raised: a camera without these controls does no better.
    """
    notes: list[str] = []
    if _is_covered(handle):
        notes.append("its privacy shutter is closed, and its pictures are black: open it")
    for control in controls.values():
        wanted = _wanted(control, is_uvc=is_uvc)
        if wanted is None or control.name in named:
            continue
        if isinstance(wanted, str):
            notes.append(f"{wanted}; write what is right as controls = {{ {control.name} = … }} into its table")
            continue
        try:
            ctl.put(handle, node, control, wanted)
        except UnsupportedByDeviceError as refusal:
            notes.append(f"its own image processing cannot be switched off: {refusal}")
    return tuple(notes)


def _is_covered(handle: int) -> bool:
    """Whether a camera says so that can; mostly a shutter that a person moves, and no program."""
    answer = kernel.ControlValue(id=ctl.PRIVACY)
    with suppress(OSError):
        kernel.ask(handle, kernel.G_CTRL, answer)
    return bool(answer.value)


def _wanted(control: Control, *, is_uvc: bool) -> int | str | None:
    """The value to set; words where none is known to be right; None for a control that is no business of ours."""
    match control.number:
        case ctl.SHARPNESS:
            return control.minimum
        case ctl.CONTRAST | ctl.ZOOM_ABSOLUTE | ctl.PAN_ABSOLUTE | ctl.TILT_ABSOLUTE:
            return control.default
        case ctl.BACKLIGHT_COMPENSATION:
            return 0 if control.takes(0) else control.minimum
        case ctl.GAMMA:
            if is_uvc and control.nearest(_LINEAR_GAMMA) == _LINEAR_GAMMA:
                return _LINEAR_GAMMA
            return (
                f"which value of its control {control.name} ({control.minimum} to {control.maximum}) makes its values "
                "grow with the light is not known, and slrig doctor measures whether they do"
            )
        case (
            ctl.AUTOBRIGHTNESS | ctl.EXPOSURE_AUTO_PRIORITY | ctl.HDR_SENSOR_MODE | ctl.IMAGE_STABILIZATION
            | ctl.ISO_SENSITIVITY_AUTO | ctl.PRESET_WHITE_BALANCE | ctl.SCENE_MODE | ctl.WIDE_DYNAMIC_RANGE
        ):  # fmt: skip
            return 0
    if not _NAMED.search(control.name):
        return None
    if control.is_menu or not control.takes(0):
        return f"its control {control.name} changes its pictures, and which of its values means off is not known"
    return 0

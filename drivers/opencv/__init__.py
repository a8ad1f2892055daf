"""Cameras through `cv2.VideoCapture`: by index, by URL, or as a file. The portable fallback.

Two rules say when a frame was exposed; both err on the safe side, and the width of what is left open is `t_err_ns`.

By stamps (Linux, a camera by index or `/dev/video…`): OpenCV passes on the kernel's buffer time, CLOCK_MONOTONIC, and
does not say whether it names the start or the end of the exposure. So the exposure began one frame period and one
exposure before the stamp at the earliest.

By arrival (URLs, pipes, other systems' cameras): a frame that arrives at t, after a delay of 0 to `delay_s`, was
exposed within [t - delay_s - exposure, t]. What `read` of OpenCV returns may have lain in a queue for long, and arrived
any time since the queue was last empty; it was empty when the reader last slept in wait for a frame. t at the earliest
is the beginning of that wait. A thread reads all the time, so that this is one frame ago, and not when somebody asks.

Of a film (a regular file, a numbered series of images) the frames are exposed from `arm` on at the times that it gives
them: it cannot follow a projector, but a projector can follow it.

What OpenCV hides, this driver cannot tell: that the kernel has marked a buffer as damaged, that a decoder has made up
what was lost of a film or stream, that frames were lost before they came. JPEGs are taken as they were sent, so those
of which a part is missing are found and passed over. On Linux, the driver `v4l2` is told of damage and loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.devices import Camera


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a camera from a rig file's `[[camera]]` table (without driver, name, exposure_s and gain).

    Parameters
    ----------
    name
        The rig's name for it.
    options
        `drivers.opencv.options.OpenCvOptions`.
    folder
        The rig file's own: a file's path counts from there.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        There is no such device, nobody answers at the URL, or no frame comes.
    DeviceBusyError
        Another program streams from the camera.
    UnsupportedByDeviceError
        It cannot do what the options ask.
    """
    from drivers.opencv.camera import OpenCvCamera
    from drivers.opencv.options import parse_source

    return OpenCvCamera(name, parse_source(name, options, folder))


__all__ = ["open_camera"]

"""Cameras through `cv2.VideoCapture`: by index, by URL, or as a file. The portable fallback.

Two rules give exposure times. Both err on the safe side, and `t_err_ns` is the width of the remaining interval.

By stamps (Linux, a camera by index or `/dev/video…`): OpenCV passes on the kernel's buffer time, CLOCK_MONOTONIC,
without its meaning: start or end of the exposure. So the exposure began one frame period and one exposure before the
stamp at the earliest.

By arrival (URLs, pipes, cameras of other systems): a frame that arrives at t, after a delay of 0 to `delay_s`, was
exposed within [t - delay_s - exposure, t]. A frame that OpenCV's `read` returns may have been in a queue, and arrived
any time since the queue was last empty, which was when the reader last slept in wait for a frame. The earliest t is the
beginning of that wait. A thread reads all the time, so that the wait was one frame ago.

The frames of a film (a regular file, a numbered series of images) are exposed from `arm` on at the film's times. A film
cannot follow a projector, but a projector can follow a film.

OpenCV hides buffers that the kernel marked as damaged, lost parts of a film or stream that a decoder filled in, and
frames lost before they came. JPEGs are read as they were sent, so incomplete ones are found and skipped. On Linux, the
driver `v4l2` gets damage and loss from the kernel.
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
        The camera's name in the rig.
    options
        `drivers.opencv.options.OpenCvOptions`.
    folder
        The rig file's folder, from which file paths start.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        The device is not connected, the URL does not answer, or no frame comes.
    DeviceBusyError
        Another program streams from the camera.
    UnsupportedByDeviceError
        The source cannot do what the options request.
    """
    from drivers.opencv.camera import OpenCvCamera
    from drivers.opencv.options import parse_source

    return OpenCvCamera(name, parse_source(name, options, folder))


__all__ = ["open_camera"]

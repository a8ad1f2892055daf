"""What is set on a camera once, when it is opened, and what makes it expose: always read back."""

from __future__ import annotations

from drivers.genicam.connection import GenICamConnection
from drivers.genicam.options import GenICamCameraOptions, SensorRegion
from drivers.genicam.pixels import FORMATS
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

_SELECTOR = "TriggerSelector"
_STARTS = ("FrameStart", "ExposureStart")
"""What starts one frame; IDS' cameras (uEye+) have the latter only. For one exposure per frame they are the same."""

_AUTOMATIC = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto", "GammaAuto")


def set_up_camera(connection: GenICamConnection, options: GenICamCameraOptions) -> Size:
    """Stop what runs, switch off what is automatic, set format, region and features. Return the image's extent.

    Raises
    ------
    UnsupportedByDeviceError
        The camera does not take a value, or takes it otherwise.
    """
    features = connection.features
    with connection.asking("stopping it") as camera:
        # Another program may have left it running; settings are locked then.
        camera.stop_acquisition()
    if options.pixel_format not in FORMATS:
        message = (
            f"camera '{connection.name}': asked for pixel_format {options.pixel_format}, the driver reads "
            f"{', '.join(FORMATS)}; choose one that the camera offers: {', '.join(features.choices('PixelFormat'))}"
        )
        raise UnsupportedByDeviceError(message)
    features.choose("PixelFormat", options.pixel_format)
    for automatic in _AUTOMATIC:
        if features.has(automatic) and "Off" in features.choices(automatic):
            features.choose(automatic, "Off")
    if features.has("ExposureMode"):
        features.choose("ExposureMode", "Timed")
    if features.has("AcquisitionMode"):
        features.choose("AcquisitionMode", "Continuous")
    # Binning is among these, and bounds the region.
    for feature, value in options.features.items():
        features.set_any(feature, value)
    return _set_region(connection, options)


def _set_region(connection: GenICamConnection, options: GenICamCameraOptions) -> Size:
    features = connection.features
    # Extents are bounded by the offsets in use, so those go first, and come back last.
    for offset in ("OffsetX", "OffsetY"):
        if features.has(offset):
            features.set_whole(offset, 0)
    with connection.asking("asking for its extent") as camera:
        width_px, height_px = int(camera.get_width_bounds()[1]), int(camera.get_height_bounds()[1])
    region = options.region
    if region is None:
        region = SensorRegion(width_px=width_px, height_px=height_px)
    if region.x_px + region.width_px > width_px or region.y_px + region.height_px > height_px:
        message = (
            f"camera '{connection.name}': asked for a region of {region.width_px} x {region.height_px} px at column "
            f"{region.x_px}, row {region.y_px}; its image is {width_px} x {height_px} px; ask for what lies on it"
        )
        raise UnsupportedByDeviceError(message)
    features.set_whole("Width", region.width_px)
    features.set_whole("Height", region.height_px)
    for offset, value in (("OffsetX", region.x_px), ("OffsetY", region.y_px)):
        if value:
            features.set_whole(offset, value)
    return Size(region.width_px, region.height_px)


def choose_trigger_line(connection: GenICamConnection, options: GenICamCameraOptions) -> str | None:
    """Return the input that a hardware trigger comes by; None if the camera has none.

    Raises
    ------
    UnsupportedByDeviceError
        The line that was asked for is not among the camera's.
    """
    features = connection.features
    if features.has(_SELECTOR):
        features.choose(_SELECTOR, _start_selector(features.choices(_SELECTOR)))
    lines = (
        tuple(source for source in features.choices("TriggerSource") if source.startswith("Line"))
        if (features.has("TriggerSource"))
        else ()
    )
    if options.trigger_line is None:
        return lines[0] if lines else None
    if options.trigger_line not in lines:
        message = (
            f"camera '{connection.name}': asked for trigger_line {options.trigger_line}, it offers "
            f"{', '.join(lines) or 'none'}; choose one of these, or leave it out"
        )
        raise UnsupportedByDeviceError(message)
    return options.trigger_line


def set_trigger(connection: GenICamConnection, source: str | None, options: GenICamCameraOptions) -> None:
    """Let `source` start every exposure; None lets the camera run by itself.

    Raises
    ------
    UnsupportedByDeviceError
        The camera does not take it, or reads back otherwise.
    """
    features = connection.features
    selectors = features.choices(_SELECTOR) if features.has(_SELECTOR) else ()
    start = _start_selector(selectors)
    for selector in selectors:
        if selector != start:
            features.choose(_SELECTOR, selector)
            if features.has("TriggerMode"):
                features.choose("TriggerMode", "Off")
    if selectors:
        features.choose(_SELECTOR, start)
    if source is None:
        if features.has("TriggerMode"):
            features.choose("TriggerMode", "Off")
        return
    features.choose("TriggerMode", "On")
    features.choose("TriggerSource", source)
    if source != "Software" and features.has("TriggerActivation"):
        features.choose("TriggerActivation", options.trigger_activation)


def _start_selector(selectors: tuple[str, ...]) -> str:
    """The selector of what starts a frame; the usual one, which is then refused, where there is none of them."""
    return next((each for each in _STARTS if each in selectors), _STARTS[0])

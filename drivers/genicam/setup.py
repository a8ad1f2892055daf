"""Setting up a GenICam camera: format, region, image processing, and what triggers it.

Names are those of GenICam's Standard Features Naming Convention (SFNC), and makers' where they have others.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from drivers.genicam.connection import Features, GenICamCameraOptions, GenICamConnection, SensorRegion
from drivers.genicam.link import link_notes
from drivers.genicam.pixels import FORMATS
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

_SELECTOR = "TriggerSelector"
_START_SELECTORS = ("FrameStart", "ExposureStart")
"""Selectors that start one frame; IDS cameras (uEye+) have the latter only. For one exposure per frame they are
equivalent."""
_AUTOMATIC = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto", "GammaAuto")
_OVERLAPS = ("ReadOut", "PreviousFrame")
_NEUTRAL: tuple[tuple[tuple[str, ...], int], ...] = (
    (("GammaEnable", "GammaEnabled", "Gamma"), 1),
    (("LUTEnable",), 0),
    (("SharpeningEnable", "SharpnessEnable", "SharpnessEnabled", "SharpnessMode", "SharpeningMode"), 0),
    (("SharpnessEnhancement", "BslSharpnessEnhancement", "SharpnessEnhancementAbs"), 0),
    (("NoiseReductionEnable", "NoiseReductionMode", "DigitalNoiseReductionMode"), 0),
    (("NoiseReduction", "BslNoiseReduction", "NoiseReductionAbs"), 0),
    (("BslContrast",), 0),
    (("BslBrightness",), 0),
    (("BslLightSourcePreset", "LightSourceSelector"), 0),
    (("ProcessedRawEnable",), 0),
    (("TestPattern", "TestImageSelector"), 0),
    (("BinningHorizontal",), 1),
    (("BinningVertical",), 1),
    (("DecimationHorizontal",), 1),
    (("DecimationVertical",), 1),
    (("ReverseX",), 0),
    (("ReverseY",), 0),
    (("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled", "AcquisitionFrameRateMode"), 0),
    (("TriggerDelay", "TriggerDelayAbs"), 0),
)
"""Features that another program or a user set may have left on: groups of equal effect, of which the first that the
camera takes is switched off; and the number that is neutral where it is a number (the nearest that it takes)."""

_DEBOUNCERS = ("LineDebouncerTime", "LineDebouncerTimeAbs", "LineFilterWidth")


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A camera that was set up. line : the input of its wire trigger; None if it has none. notes : for the user."""

    size: Size
    line: str | None
    notes: tuple[str, ...]


def set_up_camera(connection: GenICamConnection, options: GenICamCameraOptions) -> CameraSetup:
    """Stop the camera, load the user set, switch triggers, automatic functions and image processing off, and set
    format, region and features.

    Raises UnsupportedByDeviceError if the camera does not accept an option, or changes it. Image processing that cannot
    be switched off is noted.
    """
    features = connection.features
    with connection.access("stopping it") as camera:
        # Another program may have left it running, with locked settings.
        camera.stop_acquisition()
    if options.user_set is not None:
        features.choose("UserSetSelector", options.user_set)
        features.execute("UserSetLoad")
    # After the user set, which has a packet size of its own.
    connection.prepare_link()
    # A trigger that is on locks other features.
    set_trigger(connection, None, options)
    if options.pixel_format not in FORMATS:
        message = (
            f"camera '{connection.name}': requested pixel_format {options.pixel_format}, the driver reads "
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
    notes = _switch_off_processing(features, options)
    # These may include binning, which limits the region.
    for feature, value in options.features.items():
        features.set_any(feature, value)
    size = _set_region(connection, options)
    line = _choose_trigger_line(connection, options)
    if line is not None:
        notes += _prepare_line(features, line)
    notes += link_notes(connection)
    return CameraSetup(size, line, tuple(notes))


def _switch_off_processing(features: Features, options: GenICamCameraOptions) -> list[str]:
    """Set each of `_NEUTRAL`. Return notes on what stays on."""
    notes = []
    for names, number in _NEUTRAL:
        refusal: UnsupportedByDeviceError | None = None
        for name in filter(features.has, names):
            try:
                features.neutralise(name, number)
            except UnsupportedByDeviceError as error:
                refusal = error
            else:
                break
        else:
            if refusal is not None:
                notes.append(f"what another program may have left on stays on: {refusal}")
    level = features.value("BlackLevel") if features.has("BlackLevel") else 0
    if level and "BlackLevel" not in options.features:
        notes.append(f"its black level is {level:g}; features = {{ BlackLevel = … }} sets another")
    return notes


def _prepare_line(features: Features, line: str) -> list[str]:
    """Make the line of the wire trigger an input, and return notes on what holds its pulses up."""
    if not features.has("LineSelector") or line not in features.choices("LineSelector"):
        return []
    features.choose("LineSelector", line)
    if features.has("LineMode") and "Input" in features.choices("LineMode"):
        features.choose("LineMode", "Input")
    for name in filter(features.has, _DEBOUNCERS):
        if delay_us := features.value(name):
            return [
                f"its input {line} takes a pulse after {delay_us:g} µs only ({name}): shorter ones are lost, and "
                f'exposures begin that much late; features = {{ LineSelector = "{line}", {name} = … }} changes it'
            ]
    return []


def _set_region(connection: GenICamConnection, options: GenICamCameraOptions) -> Size:
    features = connection.features
    # The offsets limit the size: reset them first, set them last.
    for offset in ("OffsetX", "OffsetY"):
        if features.has(offset):
            features.set_integer(offset, 0)
    with connection.access("reading its size") as camera:
        width_px, height_px = int(camera.get_width_bounds()[1]), int(camera.get_height_bounds()[1])
    region = options.region
    if region is None:
        region = SensorRegion(width_px=width_px, height_px=height_px)
    if region.x_px + region.width_px > width_px or region.y_px + region.height_px > height_px:
        message = (
            f"camera '{connection.name}': requested a region of {region.width_px} x {region.height_px} px at "
            f"column {region.x_px}, row {region.y_px}; its image is {width_px} x {height_px} px; choose a part of it"
        )
        raise UnsupportedByDeviceError(message)
    features.set_integer("Width", region.width_px)
    features.set_integer("Height", region.height_px)
    for offset, value in (("OffsetX", region.x_px), ("OffsetY", region.y_px)):
        if value:
            features.set_integer(offset, value)
    return Size(region.width_px, region.height_px)


def _choose_trigger_line(connection: GenICamConnection, options: GenICamCameraOptions) -> str | None:
    """Return the input of the hardware trigger; None if the camera has none. Raises UnsupportedByDeviceError if it does
    not have the requested line.
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
            f"camera '{connection.name}': requested trigger_line {options.trigger_line}, it offers "
            f"{', '.join(lines) or 'none'}; choose one of these, or leave it out"
        )
        raise UnsupportedByDeviceError(message)
    return options.trigger_line


def set_trigger(connection: GenICamConnection, source: str | None, options: GenICamCameraOptions) -> None:
    """Set `source` as the start of every exposure; None: the camera runs freely. Raises UnsupportedByDeviceError if it
    is not accepted.
    """
    features = connection.features
    selectors = features.choices(_SELECTOR) if features.has(_SELECTOR) else ()
    start = _start_selector(selectors)
    # Some cameras take the rest only while the trigger is off. What starts a frame comes last and stays selected.
    for selector in sorted(selectors, key=start.__eq__) or (start,):
        if selectors:
            features.choose(_SELECTOR, selector)
        if features.has("TriggerMode"):
            features.choose("TriggerMode", "Off")
    if source is None:
        return
    features.choose("TriggerSource", source)
    if source != "Software":
        if features.has("TriggerActivation"):
            features.choose("TriggerActivation", options.trigger_activation)
        _allow_overlap(features, options)
    features.choose("TriggerMode", "On")


def _allow_overlap(features: Features, options: GenICamCameraOptions) -> None:
    """Allow a pulse to start an exposure while the frame before is read out: many cameras ignore it otherwise."""
    if "TriggerOverlap" in options.features or not features.has("TriggerOverlap"):
        return
    offered = features.choices("TriggerOverlap")
    for overlap in _OVERLAPS:
        if overlap in offered:
            # A camera that refuses is slower, and captures find that out.
            with suppress(UnsupportedByDeviceError):
                features.choose("TriggerOverlap", overlap)
            return


def _start_selector(selectors: tuple[str, ...]) -> str:
    """Return the selector that starts a frame; the standard one if none is available."""
    return next((each for each in _START_SELECTORS if each in selectors), _START_SELECTORS[0])

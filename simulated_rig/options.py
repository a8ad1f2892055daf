"""The `[head]` table of a rendered rig: a strict model of every option, and the calibration that it describes."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from simulated_rig.light import Response
from simulated_rig.movements import (
    PROJECTOR,
    BumpFault,
    ObjectMotion,
    PoseDrift,
    PoseSeries,
    ScriptedPose,
    TurntableOptions,
)
from simulated_rig.optics import Focus, look_at
from simulated_rig.rendering import SensorModel
from simulated_rig.scene import Fraction, Names, NotNegative, Pair, Positive, Triple, require_one
from slrig.bundle.validation import Strict
from slrig.errors import CalibrationError
from slrig.model import Pinhole, Size

Count = Annotated[int, Field(ge=0)]
Counts = Annotated[tuple[Count, ...], Field(strict=False)]
PixelExtent = Annotated[int, Field(ge=16, le=16384)]
Row = Triple


class DeviceOptions(Strict, use_attribute_docstrings=True):
    """Lens and pose of a camera or the projector.

    The pose is either position_mm and target_mm (a look-at, `down` pointing down in the image), or rotation and
    translation_mm as a calibration has them: X_device = rotation @ X_world + translation_mm.
    """

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)]
    """[width, height] of the image."""

    focal_px: Annotated[tuple[Positive, Positive], Field(strict=False)]
    """Focal lengths along x and y."""

    principal_px: Pair | None = None
    """Where the optical axis meets the image; else its middle."""

    distortion: Annotated[tuple[float, float, float, float, float], Field(strict=False)] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 as OpenCV has them."""

    position_mm: Triple | None = None
    """Centre of the lens; with target_mm."""

    target_mm: Triple | None = None
    """A point on the optical axis."""

    down: Triple = (0.0, 1.0, 0.0)
    """What points down in the image of a device with position_mm and target_mm."""

    rotation: Annotated[tuple[Row, Row, Row], Field(strict=False)] | None = None
    """From the world to the device, three rows; with translation_mm."""

    translation_mm: Triple | None = None
    """The world's origin, in the device's frame."""

    blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the lens's Gaussian spread."""

    focus_mm: Positive | None = None
    """Distance from the lens at which it is sharp; else that of the world's origin."""

    defocus_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the further spread of a point far away; at a distance d it is that times |1 - focus/d|."""

    @model_validator(mode="after")
    def _check_pose(self) -> DeviceOptions:
        look = (self.position_mm is not None, self.target_mm is not None)
        matrix = (self.rotation is not None, self.translation_mm is not None)
        if not ((all(look) and not any(matrix)) or (all(matrix) and not any(look))):
            message = "a pose needs position_mm and target_mm, or rotation and translation_mm, and not both kinds"
            raise ValueError(message)
        try:
            self.pinhole()
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def size(self) -> Size:
        """The extent of the image."""
        return Size(*self.size_px)

    @property
    def focus(self) -> Focus:
        """Where the lens is sharp."""
        return Focus(self.focus_mm or float(np.linalg.norm(self.pinhole().centre_mm)), self.defocus_px)

    def pinhole(self) -> Pinhole:
        """Return the device as a calibration describes it. Raises CalibrationError."""
        width, height = self.size_px
        cx, cy = self.principal_px if self.principal_px is not None else ((width - 1) / 2, (height - 1) / 2)
        if self.position_mm is not None and self.target_mm is not None:
            rotation, translation = look_at(
                np.array(self.position_mm), np.array(self.target_mm), np.array(self.down, np.float64)
            )
        else:
            rotation, translation = np.array(self.rotation, np.float64), np.array(self.translation_mm, np.float64)
        matrix = np.array([(self.focal_px[0], 0.0, cx), (0.0, self.focal_px[1], cy), (0.0, 0.0, 1.0)])
        return Pinhole(self.size, matrix, np.array(self.distortion, np.float64), rotation, translation)


class SimulatedProjectorOptions(DeviceOptions):
    """The projector: `[head.projector]`. Its response is that of `light.Response`."""

    gamma: Annotated[float, Field(gt=0, le=5)] = 1.0
    """Light grows with the grey value to the power of this."""

    leak: Fraction = 0.001
    """Light of black, as a fraction of white's."""

    signal_blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the grey values' spread on their way to the pixels (a scaler, an analogue cable)."""

    working_distance_mm: Positive | None = None
    """Where a white diffuser has unit brightness; else the distance from the projector to the world's origin."""

    latency_s: NotNegative = 0.02
    """From `show` to light."""

    visible_error_s: NotNegative = 0.0005
    """Each time, light comes off that by this at most."""

    refresh_hz: Positive | None = None
    """Then light changes at the next refresh only; else at any time."""

    flicker_hz: Positive = 120.0
    """How often its light swings about its mean, as under a colour wheel."""

    flicker_depth: Fraction = 0.0
    """How far it swings, as a fraction of the mean."""

    fall_off: Annotated[tuple[NotNegative, Fraction], Field(strict=False)] = (0.0, 0.0)
    """Light off its axis falls with the cosine to the power of the first, 4 of a simple lens; and in the corners by the
    share of the second, elsewhere as the square of the distance from the axis."""

    lights: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] | None = (1 / 3, 1 / 3, 1 / 3)
    """How bright grey is in its blue, green and red light alone, of what it is in white."""

    max_patterns: Annotated[int, Field(ge=1)] = 1024
    """The longest sequence that it takes."""

    def response(self) -> Response:
        """Return how grey values become light."""
        return Response(
            gamma=self.gamma, leak=self.leak, blur_px=self.blur_px, signal_blur_px=self.signal_blur_px, focus=self.focus
        )


class SimulatedCameraOptions(DeviceOptions):
    """One camera: `[[head.camera]]`. Its noise is that of `sensor.SensorModel`."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_-]+$")]
    """The rig's name for it."""

    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    """Of a sample."""

    exposure_s: Positive = 0.0167
    """What the camera uses until it is configured."""

    exposure_min_s: Positive = 1e-5
    """The shortest exposure that it takes."""

    exposure_max_s: Positive = 10.0
    """The longest exposure that it takes."""

    gain_max: Annotated[float, Field(ge=1)] = 16.0
    """The largest gain that it takes."""

    saturation_s: Positive = 0.025
    """The exposure at which a white diffuser at the working distance, facing a white projector, fills the well."""

    full_well_e: Positive = 10000.0
    """Electrons that a pixel holds."""

    read_noise_e: NotNegative = 8.0
    """Standard deviation of reading a pixel."""

    pedestal_dn: NotNegative = 0.0
    """The value of a dark sample."""

    colour: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] | None = None
    """How strongly it sees blue, green and red, beside its grey picture, whose unit is 1; else it is mono."""

    response: Annotated[float, Field(gt=0, le=4)] = 1.0
    """Values grow with light to the power of this: 0.45 as a webcam's, made for displays."""

    exposure_drift: Annotated[float, Field(gt=-0.1, lt=0.1)] = 0.0
    """Each frame since the camera was armed has this share more light than the one before: its exposure creeps."""

    trigger_latency_s: NotNegative = 0.0002
    """From `trigger` to the exposure's start."""

    readout_s: NotNegative = 0.005
    """From the end of an exposure to the delivered frame."""

    period_s: Positive | None = None
    """Between the starts of free-running exposures; else exposure and readout."""

    stamp_error_s: NotNegative = 0.0
    """How well the times of a frame are known."""

    buffers: Annotated[int, Field(ge=1, le=1000)] = 4
    """How many finished frames a free-running camera keeps."""

    line_time_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """A rolling shutter's: each row is exposed this much later than the row above it; 0 is a global shutter."""

    @property
    def shutter_skew_s(self) -> float:
        """How much later than the first row the last row is exposed."""
        return (self.size.height_px - 1) * self.line_time_s

    @model_validator(mode="after")
    def _check_limits(self) -> SimulatedCameraOptions:
        if not self.exposure_min_s <= self.exposure_s <= self.exposure_max_s:
            message = (
                f"exposure_s must lie between exposure_min_s and exposure_max_s ({self.exposure_min_s} to "
                f"{self.exposure_max_s} s)"
            )
            raise ValueError(message)
        if self.stamp_error_s > self.trigger_latency_s:
            message = "stamp_error_s must not exceed trigger_latency_s: a frame would seem to begin before its trigger"
            raise ValueError(message)
        if self.pedestal_dn >= 2**self.bit_depth - 1:
            message = f"pedestal_dn must lie below full scale, {2**self.bit_depth - 1}"
            raise ValueError(message)
        return self

    def sensor(self) -> SensorModel:
        """Return the sensor."""
        return SensorModel(
            bit_depth=self.bit_depth,
            full_well_e=self.full_well_e,
            read_noise_e=self.read_noise_e,
            saturation_s=self.saturation_s,
            pedestal_dn=self.pedestal_dn,
            response=self.response,
        )


class Faults(Strict, use_attribute_docstrings=True):
    """What goes wrong, on demand: `[head.faults]`. Frames count from 0 for each camera, from its opening."""

    cameras: Names | None = None
    """Whom it befalls; else all."""

    drop_frames: Counts = ()
    """Frames that are made and lost."""

    drop_probability: Fraction = 0.0
    """That a frame is lost."""

    late_frames: Counts = ()
    """Frames that are delivered late_s late."""

    late_s: Positive = 1.0
    """How late they come."""

    stale_frames: Counts = ()
    """Frames with the image of the frame before, under fresh time stamps."""

    stale_probability: Fraction = 0.0
    """That a frame is stale."""

    corrupt_frames: Counts = ()
    """Frames of which a third of the rows is garbled."""

    corrupt_probability: Fraction = 0.0
    """That a frame is garbled."""

    jitter_s: NotNegative = 0.0
    """Each exposure starts, and each frame comes, up to this much later."""

    exposure_step_frames: Counts = ()
    """Automatic exposure that was not switched off: from each of these frames on, exposure_step times the light."""

    exposure_step: Annotated[float, Field(gt=0, le=10)] = 0.7
    """By how much."""

    unplug_camera_at_frame: Count | None = None
    """The camera is gone from then on."""

    unplug_projector_at_show: Count | None = None
    """The projector is gone from then on."""

    lamp_off: bool = False
    """The projector answers and stays dark."""

    light_delay_s: NotNegative = 0.0
    """Light comes this much later than the projector says."""

    picture: Literal["upright", "mirrored", "upside_down", "rotated"] = "upright"
    """How the patterns lie on the projector; rotated is by half a turn."""

    other_display: bool = False
    """Patterns go to another display, and the projector lights the scene with a desktop."""

    other_display_glow: Fraction = 0.0
    """White that the other display sends to the scene, as a fraction of the projector's."""

    bump: Annotated[tuple[BumpFault, ...], Field(strict=False)] = ()
    """Devices that are moved at a pose."""

    moving: Annotated[tuple[ObjectMotion, ...], Field(strict=False)] = ()
    """Poses of which the object does not stand still."""


class HeadOptions(Strict, use_attribute_docstrings=True):
    """The `[head]` table of a rendered rig without its `driver`."""

    scene: Annotated[str, Field(min_length=1)]
    """A scene file, from the rig file's folder."""

    seed: Count = 1
    """Of all noise."""

    realtime: bool = False
    """Run by the clock instead of as fast as possible."""

    samples_per_axis: Annotated[int, Field(ge=1, le=16)] = 2
    """Sub-pixel samples along x and along y."""

    jitter: bool = False
    """Samples lie anywhere in their cells instead of in the middles."""

    ambient: NotNegative = 0.0
    """Light of the room, as a fraction of the projector's white at the working distance."""

    ambient_flicker_hz: Positive = 100.0
    """How often it swings about its mean (lamps on mains of 50 Hz: 100 Hz)."""

    ambient_flicker_depth: Fraction = 0.0
    """How far it swings, as a fraction of the mean."""

    workers: Annotated[int, Field(ge=1, le=64)] = 2
    """Threads that trace."""

    projector: SimulatedProjectorOptions
    """The projector."""

    camera: Annotated[tuple[SimulatedCameraOptions, ...], Field(strict=False), AfterValidator(require_one)]
    """The cameras, one or more."""

    faults: Faults = Faults()
    """What goes wrong, on demand."""

    carries_calibration: bool = True
    """Whether the head knows its own calibration, exactly, but for what faults.bump and drift do to it."""

    pose: Annotated[tuple[ScriptedPose, ...], Field(strict=False)] = ()
    """A script for the scene's board, or another object, listed; the first pose is taken at the start."""

    poses: PoseSeries | None = None
    """The same, made up; after those that are listed."""

    turntable: TurntableOptions | None = None
    """What turns the scene's objects, instead of a script."""

    drift: Annotated[tuple[PoseDrift, ...], Field(strict=False)] = ()
    """Devices that move slowly."""

    @field_validator("camera")
    @classmethod
    def _check_camera_names(cls, cameras: tuple[SimulatedCameraOptions, ...]) -> tuple[SimulatedCameraOptions, ...]:
        names = [camera.name for camera in cameras]
        if len(set(names)) != len(names):
            message = f"each camera needs a name of its own, found {names}"
            raise ValueError(message)
        return cameras

    @model_validator(mode="after")
    def _check_faulty_cameras(self) -> HeadOptions:
        names = {camera.name for camera in self.camera}
        unknown = sorted(set(self.faults.cameras or ()) - names)
        if unknown:
            message = f"faults.cameras names {unknown}, the rig has {sorted(names)}"
            raise ValueError(message)
        return self

    @model_validator(mode="after")
    def _check_moved_devices(self) -> HeadOptions:
        names = {PROJECTOR, *(camera.name for camera in self.camera)}
        unknown = sorted({push.device for push in (*self.faults.bump, *self.drift)} - names)
        if unknown:
            message = f"faults.bump and drift name {unknown}, the rig has {sorted(names)}"
            raise ValueError(message)
        return self

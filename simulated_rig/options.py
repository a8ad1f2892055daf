"""Options of the simulated rig: the `[head]` table of a rig file, and the calibration that it describes."""

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
from slrig.bundle import Strict
from slrig.errors import CalibrationError
from slrig.model import Pinhole, Size

Count = Annotated[int, Field(ge=0)]
Counts = Annotated[tuple[Count, ...], Field(strict=False)]
PixelExtent = Annotated[int, Field(ge=16, le=16384)]
Row = Triple


class DeviceOptions(Strict, use_attribute_docstrings=True):
    """Lens and pose of a camera or the projector.

    Give the pose either as position_mm and target_mm (with `down` pointing down in the image), or as rotation and
    translation_mm as in a calibration: X_device = rotation @ X_world + translation_mm.
    """

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)]
    """[width, height] of the image."""

    focal_px: Annotated[tuple[Positive, Positive], Field(strict=False)]
    """Focal lengths along x and y."""

    principal_px: Pair | None = None
    """Principal point; default: the image centre."""

    distortion: Annotated[tuple[float, float, float, float, float], Field(strict=False)] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Coefficients k1, k2, p1, p2, k3 as in OpenCV."""

    position_mm: Triple | None = None
    """Centre of the lens; requires target_mm."""

    target_mm: Triple | None = None
    """A point on the optical axis."""

    down: Triple = (0.0, 1.0, 0.0)
    """World direction that points down in the image, with position_mm and target_mm."""

    rotation: Annotated[tuple[Row, Row, Row], Field(strict=False)] | None = None
    """Rotation from the world to the device, three rows; requires translation_mm."""

    translation_mm: Triple | None = None
    """The world's origin in the device's frame."""

    blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the lens's Gaussian blur."""

    focus_mm: Positive | None = None
    """Distance of the sharp plane from the lens; default: the distance of the world's origin."""

    defocus_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the additional blur of an infinitely distant point; at a distance d it is this times |1 -
    focus/d|."""

    @model_validator(mode="after")
    def _check_pose(self) -> DeviceOptions:
        target = (self.position_mm is not None, self.target_mm is not None)
        matrix = (self.rotation is not None, self.translation_mm is not None)
        if not ((all(target) and not any(matrix)) or (all(matrix) and not any(target))):
            message = "give a pose as position_mm and target_mm, or as rotation and translation_mm, not both"
            raise ValueError(message)
        try:
            self.pinhole()
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def size(self) -> Size:
        """Size of the image."""
        return Size(*self.size_px)

    @property
    def focus(self) -> Focus:
        """Focus of the lens."""
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
    """Options of the projector: `[head.projector]`. `light.Response` describes its response."""

    gamma: Annotated[float, Field(gt=0, le=5)] = 1.0
    """Exponent of the light over the grey value."""

    leak: Fraction = 0.001
    """Light of black, as a fraction of white."""

    signal_blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Standard deviation of the blur of grey values on their way to the pixels (a scaler, an analogue cable)."""

    working_distance_mm: Positive | None = None
    """Distance at which a white diffuser has unit brightness; default: from the projector to the world's origin."""

    latency_s: NotNegative = 0.02
    """Time from `show` to light."""

    visible_error_s: NotNegative = 0.0005
    """Maximum deviation of the time of light from that latency."""

    refresh_hz: Positive | None = None
    """Refresh rate: light changes only at a refresh; default: at any time."""

    flicker_hz: Positive = 120.0
    """Frequency of the light's oscillation about its mean, as of a colour wheel."""

    flicker_depth: Fraction = 0.0
    """Amplitude of that oscillation, as a fraction of the mean."""

    fall_off: Annotated[tuple[NotNegative, Fraction], Field(strict=False)] = (0.0, 0.0)
    """Vignetting. First: exponent of the cosine to the optical axis, 4 for a simple lens. Second: loss in the corners
    as a fraction; elsewhere it grows with the square of the distance from the axis."""

    lights: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] | None = (1 / 3, 1 / 3, 1 / 3)
    """Brightness of grey in the blue, green and red light alone, relative to white."""

    max_patterns: Annotated[int, Field(ge=1)] = 1024
    """Maximum length of a sequence."""

    def response(self) -> Response:
        """Return the projector's response."""
        return Response(
            gamma=self.gamma, leak=self.leak, blur_px=self.blur_px, signal_blur_px=self.signal_blur_px, focus=self.focus
        )


class SimulatedCameraOptions(DeviceOptions):
    """Options of one camera: `[[head.camera]]`. `rendering.SensorModel` describes its noise."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_-]+$")]
    """Name of the camera in the rig."""

    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    """Bits of a sample."""

    exposure_s: Positive = 0.0167
    """Exposure until the camera is configured."""

    exposure_min_s: Positive = 1e-5
    """Shortest accepted exposure."""

    exposure_max_s: Positive = 10.0
    """Longest accepted exposure."""

    gain_max: Annotated[float, Field(ge=1)] = 16.0
    """Largest accepted gain."""

    saturation_s: Positive = 0.025
    """Exposure at which a white diffuser at the working distance, facing a white projector, saturates the sensor."""

    full_well_e: Positive = 10000.0
    """Full well capacity of a pixel in electrons."""

    read_noise_e: NotNegative = 8.0
    """Standard deviation of the read noise."""

    pedestal_dn: NotNegative = 0.0
    """Value of a dark sample."""

    colour: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] | None = None
    """Sensitivity to blue, green and red relative to the grey image; default: a mono camera."""

    response: Annotated[float, Field(gt=0, le=4)] = 1.0
    """Exponent of the values over the light: 0.45 for a webcam, whose images are made for displays."""

    exposure_drift: Annotated[float, Field(gt=-0.1, lt=0.1)] = 0.0
    """Relative increase of the light from each frame to the next since the camera was armed."""

    trigger_latency_s: NotNegative = 0.0002
    """Time from `trigger` to the start of the exposure."""

    readout_s: NotNegative = 0.005
    """Time from the end of an exposure to the delivery of the frame."""

    period_s: Positive | None = None
    """Period of free-running exposures; default: exposure and readout."""

    stamp_error_s: NotNegative = 0.0
    """Error bound of the time stamps."""

    buffers: Annotated[int, Field(ge=1, le=1000)] = 4
    """Number of finished frames that a free-running camera stores."""

    line_time_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Delay of a rolling shutter from each row to the next; 0 is a global shutter."""

    @property
    def shutter_skew_s(self) -> float:
        """Delay of the last row's exposure after the first row's."""
        return (self.size.height_px - 1) * self.line_time_s

    @model_validator(mode="after")
    def _check_limits(self) -> SimulatedCameraOptions:
        if not self.exposure_min_s <= self.exposure_s <= self.exposure_max_s:
            message = (
                f"exposure_s must be between exposure_min_s and exposure_max_s ({self.exposure_min_s} to "
                f"{self.exposure_max_s} s)"
            )
            raise ValueError(message)
        if self.stamp_error_s > self.trigger_latency_s:
            message = "stamp_error_s must not exceed trigger_latency_s: a frame would seem to begin before its trigger"
            raise ValueError(message)
        if self.pedestal_dn >= 2**self.bit_depth - 1:
            message = f"pedestal_dn must be below full scale, {2**self.bit_depth - 1}"
            raise ValueError(message)
        return self

    def sensor(self) -> SensorModel:
        """Return the sensor model."""
        return SensorModel(
            bit_depth=self.bit_depth,
            full_well_e=self.full_well_e,
            read_noise_e=self.read_noise_e,
            saturation_s=self.saturation_s,
            pedestal_dn=self.pedestal_dn,
            response=self.response,
        )


class Faults(Strict, use_attribute_docstrings=True):
    """Faults on demand: `[head.faults]`. Frames count from 0 for each camera since it was opened."""

    cameras: Names | None = None
    """Affected cameras; default: all."""

    drop_frames: Counts = ()
    """Frames that are lost."""

    drop_probability: Fraction = 0.0
    """Probability that a frame is lost."""

    late_frames: Counts = ()
    """Frames that are delivered late_s late."""

    late_s: Positive = 1.0
    """Delay of late frames."""

    stale_frames: Counts = ()
    """Frames that repeat the image of the previous frame with new time stamps."""

    stale_probability: Fraction = 0.0
    """Probability that a frame is stale."""

    corrupt_frames: Counts = ()
    """Frames with a third of the rows corrupted."""

    corrupt_probability: Fraction = 0.0
    """Probability that a frame is corrupted."""

    jitter_s: NotNegative = 0.0
    """Maximum random delay of each exposure and of each delivery."""

    exposure_step_frames: Counts = ()
    """Frames from each of which on the light is multiplied by exposure_step, as by automatic exposure."""

    exposure_step: Annotated[float, Field(gt=0, le=10)] = 0.7
    """Factor of each exposure step."""

    unplug_camera_at_frame: Count | None = None
    """Frame at which the camera is unplugged."""

    unplug_projector_at_show: Count | None = None
    """Number of the call of show at which the projector is unplugged."""

    lamp_off: bool = False
    """The projector responds but stays dark."""

    light_delay_s: NotNegative = 0.0
    """Delay of the light after the reported time."""

    picture: Literal["upright", "mirrored", "upside_down", "rotated"] = "upright"
    """Orientation of the patterns on the projector; "rotated" is by 180°."""

    other_display: bool = False
    """Patterns go to another display, and the projector shows a desktop."""

    other_display_glow: Fraction = 0.0
    """White light that the other display sends to the scene, as a fraction of the projector's."""

    bump: Annotated[tuple[BumpFault, ...], Field(strict=False)] = ()
    """Devices that are moved at a pose."""

    moving: Annotated[tuple[ObjectMotion, ...], Field(strict=False)] = ()
    """Poses during which the object moves."""


class HeadOptions(Strict, use_attribute_docstrings=True):
    """The `[head]` table of a simulated rig, without its `driver`."""

    scene: Annotated[str, Field(min_length=1)]
    """Scene file, relative to the rig file's folder."""

    seed: Count = 1
    """Seed of all noise."""

    realtime: bool = False
    """Run in real time instead of as fast as possible."""

    samples_per_axis: Annotated[int, Field(ge=1, le=16)] = 2
    """Sub-pixel samples along x and along y."""

    jitter: bool = False
    """Place samples randomly in their cells instead of at the centres."""

    ambient: NotNegative = 0.0
    """Ambient light, as a fraction of the projector's white at the working distance."""

    ambient_flicker_hz: Positive = 100.0
    """Frequency of the ambient light's oscillation about its mean (lamps on 50 Hz mains: 100 Hz)."""

    ambient_flicker_depth: Fraction = 0.0
    """Amplitude of that oscillation, as a fraction of the mean."""

    workers: Annotated[int, Field(ge=1, le=64)] = 2
    """Number of tracing threads."""

    projector: SimulatedProjectorOptions
    """The projector."""

    camera: Annotated[tuple[SimulatedCameraOptions, ...], Field(strict=False), AfterValidator(require_one)]
    """The cameras, one or more."""

    faults: Faults = Faults()
    """Faults on demand."""

    carries_calibration: bool = True
    """Provide the exact calibration with the head. faults.bump and drift do not change it."""

    pose: Annotated[tuple[ScriptedPose, ...], Field(strict=False)] = ()
    """Poses of the scene's board or another object; the first pose is taken at the start."""

    poses: PoseSeries | None = None
    """Generated poses, after those listed in pose."""

    turntable: TurntableOptions | None = None
    """Turntable for the scene's objects, instead of poses."""

    drift: Annotated[tuple[PoseDrift, ...], Field(strict=False)] = ()
    """Devices that drift slowly."""

    @field_validator("camera")
    @classmethod
    def _check_camera_names(cls, cameras: tuple[SimulatedCameraOptions, ...]) -> tuple[SimulatedCameraOptions, ...]:
        names = [camera.name for camera in cameras]
        if len(set(names)) != len(names):
            message = f"camera names must be unique, found {names}"
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

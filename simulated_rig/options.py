"""The `[head]` table of a rendered rig: a strict model of every option, and the calibration that it describes."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from simulated_rig.disturbing import PROJECTOR, Bump, Drift, Moving
from simulated_rig.light import Response
from simulated_rig.optics import look_at
from simulated_rig.poses import Pose, PoseSeries
from simulated_rig.sensor import Sensor
from simulated_rig.tables import Fraction, NotNegative, Pair, Positive, Table, Triple, at_least_one
from slrig.errors import CalibrationError
from slrig.model import Pinhole, Size

Count = Annotated[int, Field(ge=0)]
Counts = Annotated[tuple[Count, ...], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
PixelExtent = Annotated[int, Field(ge=16, le=16384)]
Row = Triple


class Device(Table):
    """Lens and pose of a camera or the projector.

    The pose is either position_mm and target_mm (a look-at, `down` pointing down in the image), or rotation and
    translation_mm as a calibration has them: X_device = rotation @ X_world + translation_mm.
    """

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)]
    focal_px: Annotated[tuple[Positive, Positive], Field(strict=False)]
    principal_px: Pair | None = None
    distortion: Annotated[tuple[float, float, float, float, float], Field(strict=False)] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_mm: Triple | None = None
    target_mm: Triple | None = None
    down: Triple = (0.0, 1.0, 0.0)
    rotation: Annotated[tuple[Row, Row, Row], Field(strict=False)] | None = None
    translation_mm: Triple | None = None
    blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0

    @model_validator(mode="after")
    def _posed(self) -> Device:
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


class ProjectorOptions(Device):
    """The projector: `[head.projector]`.

    gamma, leak, signal_blur_px : response (see `light.Response`). working_distance_mm : where a white diffuser has
    unit brightness; absent, the distance from the projector to the world's origin. latency_s : from `show` to light,
    each time off by at most visible_error_s; then at the next refresh, if the projector has a refresh_hz.
    flicker_hz, flicker_depth : its light swings about its mean by that fraction, as under a colour wheel.
    """

    gamma: Annotated[float, Field(gt=0, le=5)] = 1.0
    leak: Fraction = 0.001
    signal_blur_px: Annotated[float, Field(ge=0, le=20)] = 0.0
    working_distance_mm: Positive | None = None
    latency_s: NotNegative = 0.02
    visible_error_s: NotNegative = 0.0005
    refresh_hz: Positive | None = None
    flicker_hz: Positive = 120.0
    flicker_depth: Fraction = 0.0
    max_patterns: Annotated[int, Field(ge=1)] = 1024

    def response(self) -> Response:
        """Return how grey values become light."""
        return Response(gamma=self.gamma, leak=self.leak, blur_px=self.blur_px, signal_blur_px=self.signal_blur_px)


class CameraOptions(Device):
    """One camera: `[[head.camera]]`.

    exposure_s : what the camera uses until it is configured. Noise and response: see `sensor.Sensor`.
    trigger_latency_s : from `trigger` to the exposure's start. readout_s : from its end to the delivered frame.
    period_s : between the starts of free-running exposures; absent, exposure and readout. stamp_error_s : how well
    the times of a frame are known. buffers : how many finished frames a free-running camera keeps.
    line_time_s : a rolling shutter's: each row is exposed this much later than the row above it; 0 is a global shutter.
    """

    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_-]+$")]
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    exposure_s: Positive = 0.0167
    exposure_min_s: Positive = 1e-5
    exposure_max_s: Positive = 10.0
    gain_max: Annotated[float, Field(ge=1)] = 16.0
    saturation_s: Positive = 0.025
    full_well_e: Positive = 10000.0
    read_noise_e: NotNegative = 8.0
    pedestal_dn: NotNegative = 0.0
    trigger_latency_s: NotNegative = 0.0002
    readout_s: NotNegative = 0.005
    period_s: Positive | None = None
    stamp_error_s: NotNegative = 0.0
    buffers: Annotated[int, Field(ge=1, le=1000)] = 4
    line_time_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0

    @property
    def shutter_skew_s(self) -> float:
        """How much later than the first row the last row is exposed."""
        return (self.size.height_px - 1) * self.line_time_s

    @model_validator(mode="after")
    def _consistent(self) -> CameraOptions:
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

    def sensor(self) -> Sensor:
        """Return the sensor."""
        return Sensor(
            bit_depth=self.bit_depth,
            full_well_e=self.full_well_e,
            read_noise_e=self.read_noise_e,
            saturation_s=self.saturation_s,
            pedestal_dn=self.pedestal_dn,
        )


class Faults(Table):
    """What goes wrong, on demand: `[head.faults]`. Frames count from 0 for each camera, from its opening.

    cameras : whom it befalls; absent, all. drop_* : the frame is made and lost. late_frames : delivered late_s late.
    stale_* : the image of the frame before, under fresh time stamps. corrupt_* : a third of the rows garbled.
    *_probability : of each frame. jitter_s : each exposure starts, and each frame comes, up to this much later.
    unplug_camera_at_frame, unplug_projector_at_show : gone from then on. lamp_off : the projector answers and stays
    dark. light_delay_s : light comes this much later than the projector says. picture : how the patterns lie on the
    projector; "rotated" is by half a turn. other_display : patterns go to another display, and the projector lights the
    scene with a desktop; other_display_glow of white is what that display sends to the scene, as a fraction of the
    projector's. bump : a device is moved at a pose (see `disturbing.Bump`). moving : the object of a pose does not
    stand still (see `disturbing.Moving`).
    """

    cameras: Names | None = None
    drop_frames: Counts = ()
    drop_probability: Fraction = 0.0
    late_frames: Counts = ()
    late_s: Positive = 1.0
    stale_frames: Counts = ()
    stale_probability: Fraction = 0.0
    corrupt_frames: Counts = ()
    corrupt_probability: Fraction = 0.0
    jitter_s: NotNegative = 0.0
    unplug_camera_at_frame: Count | None = None
    unplug_projector_at_show: Count | None = None
    lamp_off: bool = False
    light_delay_s: NotNegative = 0.0
    picture: Literal["upright", "mirrored", "upside_down", "rotated"] = "upright"
    other_display: bool = False
    other_display_glow: Fraction = 0.0
    bump: Annotated[tuple[Bump, ...], Field(strict=False)] = ()
    moving: Annotated[tuple[Moving, ...], Field(strict=False)] = ()


class HeadOptions(Table):
    """The `[head]` table without its `driver`.

    scene : a scene file, from the rig file's folder. seed : of all noise. realtime : run by CLOCK_MONOTONIC instead of
    as fast as possible. samples_per_axis, jitter : sub-pixel samples (see `transport.paths`). ambient : light of the
    room, as a fraction of the projector's white at the working distance; ambient_flicker_hz, ambient_flicker_depth : it
    swings about its mean by that fraction (lamps on mains of 50 Hz flicker at 100 Hz). workers : threads that trace.
    carries_calibration : whether the head knows its own calibration, exactly, but for what `faults.bump` and `drift`
    do to it. pose, poses : a script for the scene's board, or another object, listed, made up, or both, in this order;
    the first is taken at the start. drift : devices that move slowly (see `disturbing.Drift`).
    """

    scene: Annotated[str, Field(min_length=1)]
    seed: Count = 1
    realtime: bool = False
    samples_per_axis: Annotated[int, Field(ge=1, le=16)] = 2
    jitter: bool = False
    ambient: NotNegative = 0.0
    ambient_flicker_hz: Positive = 100.0
    ambient_flicker_depth: Fraction = 0.0
    workers: Annotated[int, Field(ge=1, le=64)] = 2
    projector: ProjectorOptions
    camera: Annotated[tuple[CameraOptions, ...], Field(strict=False), AfterValidator(at_least_one)]
    faults: Faults = Faults()
    carries_calibration: bool = True
    pose: Annotated[tuple[Pose, ...], Field(strict=False)] = ()
    poses: PoseSeries | None = None
    drift: Annotated[tuple[Drift, ...], Field(strict=False)] = ()

    @field_validator("camera")
    @classmethod
    def _different_names(cls, cameras: tuple[CameraOptions, ...]) -> tuple[CameraOptions, ...]:
        names = [camera.name for camera in cameras]
        if len(set(names)) != len(names):
            message = f"each camera needs a name of its own, found {names}"
            raise ValueError(message)
        return cameras

    @model_validator(mode="after")
    def _faulty_cameras_exist(self) -> HeadOptions:
        names = {camera.name for camera in self.camera}
        unknown = sorted(set(self.faults.cameras or ()) - names)
        if unknown:
            message = f"faults.cameras names {unknown}, the rig has {sorted(names)}"
            raise ValueError(message)
        return self

    @model_validator(mode="after")
    def _pushed_devices_exist(self) -> HeadOptions:
        names = {PROJECTOR, *(camera.name for camera in self.camera)}
        unknown = sorted({push.device for push in (*self.faults.bump, *self.drift)} - names)
        if unknown:
            message = f"faults.bump and drift name {unknown}, the rig has {sorted(names)}"
            raise ValueError(message)
        return self

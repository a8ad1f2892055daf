"""A camera of the simulated rig: triggers, timing, frames and their faults."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from simulated_rig.light import Float32Array, Lamp, LampFlicker, LightTable, nanoseconds
from simulated_rig.options import Faults, SimulatedCameraOptions
from simulated_rig.rendering import CameraView
from slrig.devices import COMPUTED_LIMITS, AppliedSettings, CameraInfo, CameraSettings, CameraState, Clock, Trigger
from slrig.errors import DeviceGoneError, FrameTimeoutError
from slrig.model import CameraFormat, Frame, Pixels

_NOISE, _FATE, _GARBLE, _STALE, _CORRUPT, _START, _DELIVERY, _COLOUR = range(8)


@dataclass(frozen=True, slots=True)
class _ExposureTimes:
    """Times of one exposure of the sensor; `t_ready_ns` is when its frame can be read."""

    number: int
    t_start_ns: int
    t_end_ns: int
    t_ready_ns: int


class SimulatedCamera:
    """Implements `slrig.devices.Camera` in the simulated world.

    Noise depends only on the seed and the frame's sequence number: runs are reproducible, and frames differ.
    """

    def __init__(
        self,
        options: SimulatedCameraOptions,
        view: CameraView,
        lamp: Lamp,
        clock: Clock,
        *,
        faults: Faults,
        seed: tuple[int, int],
        ambient_flicker: LampFlicker | None = None,
    ) -> None:
        self._options = options
        self._view = view
        self._lamp = lamp
        self._clock = clock
        self._faults = faults
        self._seed = seed
        self._ambient_flicker = ambient_flicker
        self._sensor = options.sensor()
        self._settings = AppliedSettings(options.exposure_s, 1.0)
        self._state = CameraState(options.name)
        self._pending: deque[_ExposureTimes] = deque()
        self._made = self._armed_at = 0
        self._dropped = 0
        self._t_armed_ns = 0
        self._t_busy_ns = 0
        self._free_index = 0
        self._last_image: Pixels | None = None
        self._last_colour: Callable[[], Pixels] | None = None
        self._gone = False

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        options = self._options
        return CameraInfo(
            name=options.name,
            model="rendered camera",
            serial=f"simulated-{options.name}",
            format=CameraFormat(options.size, options.bit_depth),
            triggers=frozenset({Trigger.FREE, Trigger.SOFTWARE}),
            exposure_range_s=(options.exposure_min_s, options.exposure_max_s),
            gain_range=(1.0, options.gain_max),
            limits=COMPUTED_LIMITS,
            colour=options.colour is not None,
        )

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`."""
        self._require_usable()
        self._state.check_settings(settings, self.info)
        self._settings = AppliedSettings(settings.exposure_s, settings.gain)
        return self._settings

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. More than `count` frames are available: a caller may repeat one."""
        self._require_usable()
        self._state.check_arming(count, trigger, self.info)
        # Tracing takes seconds; done here, it delays no frame.
        self._view.prepare()
        self._pending.clear()
        self._dropped = self._free_index = 0
        self._t_armed_ns = self._t_busy_ns = self._clock.now_ns()
        self._state.armed = trigger
        self._armed_at = self._made

    def trigger(self) -> None:
        """See `Camera`. A trigger during an exposure starts the next one right after it."""
        self._require_usable()
        self._state.require_armed(Trigger.SOFTWARE)
        latency_s = self._options.trigger_latency_s + self._jitter_s(_START, self._made)
        start_ns = max(self._clock.now_ns() + nanoseconds(latency_s), self._t_busy_ns)
        exposure = self._schedule_exposure(self._made, start_ns)
        self._made += 1
        self._t_busy_ns = exposure.t_end_ns
        self._pending.append(exposure)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`."""
        self._require_usable()
        self._state.require_armed()
        started_ns = self._clock.now_ns()
        deadline_ns = started_ns + nanoseconds(timeout_s)
        while True:
            exposure = self._next_exposure(after_ns, deadline_ns)
            is_ready = exposure is not None and exposure.t_ready_ns <= deadline_ns
            if exposure is not None and is_ready and not self._is_dropped(exposure.number):
                # Rendering takes real time: do it during the exposure, not after the read-out.
                self._view.rehearse(self._lights_during(exposure))
            self._clock.wait_until(
                exposure.t_ready_ns if exposure is not None and is_ready else deadline_ns, self._state.closed
            )
            self._require_usable()
            if exposure is None or not is_ready:
                message = (
                    f"camera '{self._options.name}': no frame that began after {after_ns} ns arrived in {timeout_s} s "
                    f"({self._dropped} lost since it was armed); trigger again, or allow more time"
                )
                raise FrameTimeoutError(message)
            self._pending.popleft()
            if self._is_dropped(exposure.number):
                self._dropped += 1
                continue
            return self._make_frame(exposure)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._state.armed is Trigger.FREE:
            begun = (self._clock.now_ns() - self._t_armed_ns) // self._period_ns + 1
            self._made += max(begun, self._free_index)
        self._state.armed = None
        self._pending.clear()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._state.close()

    @property
    def _period_ns(self) -> int:
        shortest = self._span_ns + nanoseconds(self._options.readout_s)
        return max(shortest, nanoseconds(self._options.period_s or 0.0), 1)

    @property
    def _span_ns(self) -> int:
        """Time from the first row's start to the last row's end."""
        return nanoseconds(self._settings.exposure_s) + nanoseconds(self._options.shutter_skew_s)

    def _schedule_exposure(self, number: int, start_ns: int) -> _ExposureTimes:
        end_ns = start_ns + self._span_ns
        late_s = self._faults.late_s if self._is_affected(self._faults.late_frames, number) else 0.0
        late_s += self._jitter_s(_DELIVERY, number)
        return _ExposureTimes(number, start_ns, end_ns, end_ns + nanoseconds(self._options.readout_s + late_s))

    def _next_exposure(self, after_ns: int, deadline_ns: int) -> _ExposureTimes | None:
        """Return the first exposure that begins after `after_ns`, skipping earlier ones, or None."""
        earliest_ns = after_ns + nanoseconds(self._options.stamp_error_s)
        while True:
            if not self._pending and self._state.armed is Trigger.FREE:
                self._run_free(earliest_ns, deadline_ns)
            if not self._pending:
                return None
            upcoming = self._pending[0]
            unplug = self._faults.unplug_camera_at_frame
            if unplug is not None and self._is_faulty and upcoming.number >= unplug:
                self._clock.wait_until(min(upcoming.t_ready_ns, deadline_ns), self._state.closed)
                self._gone = True
                self._require_usable()
            if upcoming.t_start_ns >= earliest_ns:
                return upcoming
            self._pending.popleft()

    def _run_free(self, earliest_ns: int, deadline_ns: int) -> None:
        """Append the next free-running exposure that began late enough, if its time comes before the deadline.

        Frames that finished before it are skipped, or were overwritten before they were read.
        """
        overwritten = max(self._count_read_out(self._clock.now_ns()) - self._options.buffers - self._free_index, 0)
        self._dropped += overwritten
        self._free_index += overwritten
        wanted = -((self._t_armed_ns - earliest_ns) // self._period_ns)
        by_deadline = self._count_read_out(deadline_ns)
        index = max(self._free_index, wanted)
        if index < by_deadline:
            start_ns = self._t_armed_ns + index * self._period_ns
            self._pending.append(self._schedule_exposure(self._made + index, start_ns))
            self._free_index = index + 1
        else:
            self._free_index = max(self._free_index, min(wanted, by_deadline))

    def _count_read_out(self, t_ns: int) -> int:
        """Number of free-running exposures read out by `t_ns`."""
        first_ns = self._t_armed_ns + self._span_ns + nanoseconds(self._options.readout_s)
        return max((t_ns - first_ns) // self._period_ns + 1, 0)

    def _make_frame(self, exposure: _ExposureTimes) -> Frame:
        is_stale = self._is_affected(self._faults.stale_frames, exposure.number) or self._draw_fault(
            self._faults.stale_probability, _STALE, exposure.number
        )
        repeated = self._last_image if is_stale else None
        image = repeated if repeated is not None else self._render(exposure)
        self._last_image = image
        if repeated is None and self._options.colour is not None:
            mean = self._view.colour(self._lights_during(exposure), ambient=self._ambient(exposure))
            self._last_colour = partial(self._render_colour, mean, exposure.number, self._settings)
        if self._is_affected(self._faults.corrupt_frames, exposure.number) or self._draw_fault(
            self._faults.corrupt_probability, _CORRUPT, exposure.number
        ):
            image = self._garble(image, exposure.number)
        return Frame(
            camera=self._options.name,
            image=image,
            t_start_ns=exposure.t_start_ns,
            t_end_ns=exposure.t_end_ns,
            t_err_ns=nanoseconds(self._options.stamp_error_s),
            sequence_number=exposure.number,
            dropped_count=self._dropped,
            exposure_s=self._settings.exposure_s,
            gain=self._settings.gain,
            shutter_skew_s=self._options.shutter_skew_s,
            colour=self._last_colour,
        )

    def _render(self, exposure: _ExposureTimes) -> Pixels:
        mean = self._view.image(self._lights_during(exposure), ambient=self._ambient(exposure))
        exposure_s = self._settings.exposure_s * self._light_factor(exposure.number)
        electrons = self._sensor.electrons(mean, exposure_s)
        return self._sensor.read_out(electrons, gain=self._settings.gain, rng=self._rng(_NOISE, exposure.number))

    def _render_colour(self, mean: Callable[[], Float32Array], number: int, settings: AppliedSettings) -> Pixels:
        """Render a colour frame, with its own noise."""
        light = mean() * np.array(self._options.colour, np.float32)
        electrons = self._sensor.electrons(light, settings.exposure_s * self._light_factor(number))
        flat = electrons.reshape(len(electrons), -1)
        return self._sensor.read_out(flat, gain=settings.gain, rng=self._rng(_COLOUR, number)).reshape(light.shape)

    def _light_factor(self, number: int) -> float:
        """Return the frame's light relative to the settings."""
        steps = sum(number >= first for first in self._faults.exposure_step_frames) if self._is_faulty else 0
        drift = (1 + self._options.exposure_drift) ** max(number - self._armed_at, 0)
        return float(drift * self._faults.exposure_step**steps)

    def _lights_during(self, exposure: _ExposureTimes) -> Sequence[tuple[float | Float32Array, LightTable]]:
        """Return each light during an exposure with its fraction: a number, or (H, 1) if it differs between rows."""
        together = self._lamp.light_between(exposure.t_start_ns, exposure.t_end_ns)
        if self._options.line_time_s == 0 or (len(together) == 1 and self._lamp.flicker is None):
            return together
        rows = self._options.size.height_px
        lights = {id(light): light for _, light in together}
        fractions = {key: np.zeros((rows, 1), np.float32) for key in lights}
        for row in range(rows):
            for fraction, light in self._lamp.light_between(*self._row_times_ns(exposure, row)):
                fractions[id(light)][row] += np.float32(fraction)
        return [(fractions[key], light) for key, light in lights.items()]

    def _row_times_ns(self, exposure: _ExposureTimes, row: int) -> tuple[int, int]:
        begin_ns = exposure.t_start_ns + nanoseconds(row * self._options.line_time_s)
        return begin_ns, begin_ns + nanoseconds(self._settings.exposure_s)

    def _ambient(self, exposure: _ExposureTimes) -> Float32Array | None:
        """Ambient light over its mean: (1, 1), or (H, 1) if it differs between rows; None without flicker."""
        if self._ambient_flicker is None:
            return None
        rows = self._options.size.height_px if self._options.line_time_s > 0 else 1
        means = [self._ambient_flicker.mean(*self._row_times_ns(exposure, row)) for row in range(rows)]
        return np.array(means, np.float32)[:, None]

    def _garble(self, image: Pixels, number: int) -> Pixels:
        rng = self._rng(_GARBLE, number)
        rows = len(image)
        band = slice(rows // 3, rows // 3 + max(rows // 3, 1))
        out = image.copy()
        out[band] = rng.integers(0, self._sensor.full_scale, out[band].shape, dtype=out.dtype, endpoint=True)
        return out

    def _rng(self, purpose: int, number: int) -> np.random.Generator:
        return np.random.default_rng((*self._seed, purpose, number))

    @property
    def _is_faulty(self) -> bool:
        return self._faults.cameras is None or self._options.name in self._faults.cameras

    def _is_affected(self, frames: tuple[int, ...], number: int) -> bool:
        return self._is_faulty and number in frames

    def _is_dropped(self, number: int) -> bool:
        return self._is_affected(self._faults.drop_frames, number) or self._draw_fault(
            self._faults.drop_probability, _FATE, number
        )

    def _draw_fault(self, probability: float, purpose: int, number: int) -> bool:
        return self._is_faulty and probability > 0 and bool(self._rng(purpose, number).random() < probability)

    def _jitter_s(self, purpose: int, number: int) -> float:
        max_s = self._faults.jitter_s if self._is_faulty else 0.0
        return float(self._rng(purpose, number).uniform(0, max_s)) if max_s else 0.0

    def _require_usable(self) -> None:
        self._state.require_open()
        if self._gone:
            message = f"camera '{self._options.name}' is gone (unplugged or powered off); plug it in and open it again"
            raise DeviceGoneError(message)

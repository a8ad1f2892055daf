"""A recorded scan bundle as a rig: showing a pattern makes the cameras deliver the frames that were taken of it.

Time is virtual: it starts at 0 with the recording, jumps to the recorded time of each pattern's first frame when that
pattern is shown, and never runs by itself, so a replay is as fast as the disk was.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field, ValidationError

from slrig.bundle import Bundle, read_bundle
from slrig.bundle.faults import Strict, explain, keys_of
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Head, Projector, ProjectorInfo, Shown
from slrig.devices import Trigger as TriggerKind
from slrig.errors import (
    BundleError,
    ConfigError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import Black, Calibration, Frame, Gray, LineShift, Pattern, PatternSequence, Shot, Truth, White

_SAME_EXPOSURE = 0.01
_TICK_NS = 1_000


class ReplayOptions(Strict):
    """The `[head]` table of a replayed rig. bundle : the folder, from the rig file's own."""

    bundle: str = Field(min_length=1)


@dataclass(slots=True)
class _Clock:
    """The recording's time, ns. `held_ns` is when the last exposure ends: no pattern changes before."""

    now_ns: int = 0
    held_ns: int = 0


@dataclass(slots=True)
class _Stage:
    """What lies before the cameras: the pattern shown, and the how-manieth showing of it in the sequence."""

    shown: tuple[Pattern, int] | None = None


class ReplayCamera:
    """Implements `slrig.devices.Camera` on one camera's recorded frames."""

    def __init__(self, name: str, bundle: Bundle, clock: _Clock, stage: _Stage) -> None:
        capture = bundle.capture
        self._recorded: dict[Pattern, list[Shot]] = defaultdict(list)
        for shot in capture.shots:
            if shot.camera == name:
                self._recorded[capture.patterns[shot.pattern]].append(shot)
        exposures = sorted({shot.exposure_s for shot in capture.shots if shot.camera == name and shot.exposure_s})
        self._exposures_s = exposures
        self._info = CameraInfo(
            name=name,
            model="recorded camera",
            serial=f"{bundle.folder.name}-{name}",
            format=capture.cameras[name],
            triggers=frozenset({TriggerKind.SOFTWARE}),
            # A recording that does not tell its exposure agrees with every one.
            exposure_range_s=(exposures[0], exposures[-1]) if exposures else (1e-6, 3600.0),
            gain_range=(1.0, 1.0),
        )
        self._applied = AppliedSettings(exposures[0] if exposures else 0.01, 1.0)
        self._clock = clock
        self._stage = stage
        self._pending: deque[Frame] = deque()
        self._armed = False
        self._closed = False
        self._number = 0
        self._busy_ns = 0

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Takes an exposure that was recorded, within 1 %, and gain 1."""
        self._require_open()
        if self._armed:
            message = f"camera '{self._info.name}' is armed; disarm it before changing its settings"
            raise DeviceStateError(message)
        nearest_s = min(self._exposures_s, key=lambda have: abs(have - settings.exposure_s), default=None)
        low_s, high_s = self._info.exposure_range_s
        if nearest_s is None:
            fits, had = low_s <= settings.exposure_s <= high_s, f"{low_s:g} to {high_s:g} s"
        else:
            fits = abs(nearest_s - settings.exposure_s) <= _SAME_EXPOSURE * nearest_s
            had = ", ".join(f"{exposure_s:.6g} s" for exposure_s in self._exposures_s)
        if not fits:
            message = (
                f"camera '{self._info.name}': asked for an exposure of {settings.exposure_s:.6g} s, the recording was "
                f"made with {had}; write that as exposure_s into the rig file, or leave exposure_s out"
            )
            raise UnsupportedByDeviceError(message)
        if abs(settings.gain - 1) > _SAME_EXPOSURE:
            message = (
                f"camera '{self._info.name}': asked for gain {settings.gain:g}, a recording cannot be amplified; use 1"
            )
            raise UnsupportedByDeviceError(message)
        self._applied = AppliedSettings(nearest_s if nearest_s is not None else settings.exposure_s, 1.0)
        return self._applied

    def arm(self, count: int, trigger: TriggerKind) -> None:
        """See `Camera`. Frames beyond `count` can be had: a caller may take one again."""
        self._require_open()
        if self._armed:
            message = f"camera '{self._info.name}' is armed already; disarm it first"
            raise DeviceStateError(message)
        if count < 1 or trigger is not TriggerKind.SOFTWARE:
            message = (
                f"camera '{self._info.name}': asked for {count} frames by {trigger} trigger, a recording gives 1 or "
                "more by software trigger"
            )
            raise UnsupportedByDeviceError(message)
        self._armed = True

    def trigger(self) -> None:
        """See `Camera`. Takes the recorded frame of what is shown now; in the dark, that of the black pattern."""
        self._require_armed()
        shot = self._shot()
        start_ns = max(self._clock.now_ns, self._busy_ns, _recorded_ns(shot))
        end_ns = start_ns + round(self._applied.exposure_s * 1e9)
        self._busy_ns = end_ns
        self._clock.held_ns = max(self._clock.held_ns, end_ns)
        self._pending.append(
            Frame(
                camera=self._info.name,
                image=shot.image,
                t_start_ns=start_ns,
                t_end_ns=end_ns,
                t_err_ns=0,
                sequence_number=self._number,
                dropped_count=0,
                exposure_s=self._applied.exposure_s,
                gain=self._applied.gain,
            )
        )
        self._number += 1

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. A frame that was not triggered will never come, so nothing is waited for."""
        self._require_armed()
        while self._pending:
            frame = self._pending.popleft()
            if frame.t_start_ns >= after_ns:
                return frame
        self._clock.now_ns = self._clock.held_ns = max(self._clock.now_ns + round(timeout_s * 1e9), self._clock.held_ns)
        message = (
            f"camera '{self._info.name}': no frame that began after {after_ns} ns was triggered, none came in "
            f"{timeout_s} s of the recording's time; trigger after show"
        )
        raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        self._armed = False
        self._pending.clear()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._recorded.clear()
        self._closed = True

    def frames_of(self, pattern: Pattern) -> Sequence[Shot]:
        """Return the recorded frames of a pattern at the exposure in use; at any exposure where there is none such."""
        shots = self._recorded.get(pattern, [])
        in_use_s = self._applied.exposure_s
        alike = [
            s for s in shots if s.exposure_s is not None and abs(s.exposure_s - in_use_s) <= _SAME_EXPOSURE * in_use_s
        ]
        return alike or shots

    def _shot(self) -> Shot:
        pattern, showing = self._stage.shown if self._stage.shown is not None else (Black(), 0)
        shots = self.frames_of(pattern)
        if not shots:
            message = (
                f"camera '{self._info.name}': triggered while the projector is dark, and the recording has no black "
                "frame; show a pattern first"
            )
            raise DeviceStateError(message)
        # A pattern that is shown more often than it was recorded looks as it did the last time.
        return shots[min(showing, len(shots) - 1)]

    def _require_open(self) -> None:
        if self._closed:
            message = f"camera '{self._info.name}' is closed; open the rig again"
            raise DeviceStateError(message)

    def _require_armed(self) -> None:
        self._require_open()
        if not self._armed:
            message = f"camera '{self._info.name}' is not armed; call arm first"
            raise DeviceStateError(message)


class ReplayProjector:
    """Implements `slrig.devices.Projector` on the patterns of a recording."""

    def __init__(self, bundle: Bundle, cameras: Mapping[str, ReplayCamera], clock: _Clock, stage: _Stage) -> None:
        self._info = ProjectorInfo(
            name="projector",
            model="recorded projector",
            serial=bundle.folder.name,
            size=bundle.capture.projector,
            plays=False,
            latency_s=0.0,
        )
        self._recorded = tuple(dict.fromkeys(bundle.capture.patterns))
        self._cameras = cameras
        self._clock = clock
        self._stage = stage
        self._loaded: tuple[Pattern, ...] | None = None
        self._closed = False

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses a pattern of which a camera has no frame."""
        self._require_open()
        if sequence.projector != self._info.size:
            message = (
                f"the recording was made with a projector of {self._info.size}, the sequence is for "
                f"{sequence.projector}; encode it for {self._info.size}"
            )
            raise UnsupportedByDeviceError(message)
        for pattern in sequence.patterns:
            lacking = [name for name, camera in self._cameras.items() if not camera.frames_of(pattern)]
            if lacking:
                recorded = "; ".join(dict.fromkeys(map(_family, self._recorded)))
                message = (
                    f"the recording '{self._info.serial}' has no frame of {_member(pattern)} from camera "
                    f"{', '.join(lacking)}; it has {recorded}. Ask for what was recorded: gray_cell_px, "
                    "line_shift_period_px and their like, in the request or in the rig file's [scan]"
                )
                raise UnsupportedByDeviceError(message)
        self.blank()
        self._loaded = sequence.patterns

    def show(self, index: int) -> Shown:
        """See `Projector`."""
        self._require_open()
        if self._loaded is None:
            message = f"asked to show pattern {index}, no sequence is loaded; call load first"
            raise DeviceStateError(message)
        if not 0 <= index < len(self._loaded):
            message = f"asked to show pattern {index}, the loaded sequence has patterns 0 to {len(self._loaded) - 1}"
            raise UnsupportedByDeviceError(message)
        pattern = self._loaded[index]
        showing = self._loaded[:index].count(pattern)
        self._stage.shown = (pattern, showing)
        recorded_ns = min(
            _recorded_ns(shots[min(showing, len(shots) - 1)])
            for shots in (camera.frames_of(pattern) for camera in self._cameras.values())
        )
        self._clock.now_ns = max(self._clock.now_ns + _TICK_NS, self._clock.held_ns + _TICK_NS, recorded_ns)
        return Shown(index, self._clock.now_ns, 0)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. A recording does not play."""
        self._require_open()
        message = (
            f"asked to play {exposure_s} s patterns every {period_s} s, a recording has no trigger wire; show each "
            "pattern and trigger the cameras by software"
        )
        raise UnsupportedByDeviceError(message)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        self._stage.shown = None
        self._clock.now_ns = max(self._clock.now_ns, self._clock.held_ns) + _TICK_NS

    def close(self) -> None:
        """See `Projector`."""
        self.blank()
        self._loaded = None
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            message = "the projector is closed; open the rig again"
            raise DeviceStateError(message)


class ReplayHead:
    """Implements `slrig.devices.Head` on a recorded bundle."""

    def __init__(self, bundle: Bundle) -> None:
        clock, stage = _Clock(), _Stage()
        self._calibration = bundle.calibration
        self._cameras = {name: ReplayCamera(name, bundle, clock, stage) for name in bundle.capture.cameras}
        self._projector = ReplayProjector(bundle, self._cameras, clock, stage)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """See `Head`."""
        return self._cameras

    @property
    def projector(self) -> Projector:
        """See `Head`."""
        return self._projector

    @property
    def calibration(self) -> Calibration | None:
        """See `Head`: the calibration that lies in the bundle."""
        return self._calibration

    def truth(self) -> Truth | None:
        """See `Head`. A recording knows its frames only."""
        return None


def open_head(options: Mapping[str, object], folder: Path) -> Head:
    """Open a recorded bundle as a rig, from a rig file's `[head]` table (without its `driver`).

    Parameters
    ----------
    options
        `ReplayOptions`.
    folder
        The rig file's own: the bundle's path counts from there.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message, or there is no bundle.
    BundleError
        The bundle is damaged.
    CalibrationError
        Its calibration is.
    """
    try:
        table = ReplayOptions.model_validate(dict(options))
    except ValidationError as error:
        message = f"the [head] table of a replayed rig is wrong:\n{explain(error, options, keys_of(ReplayOptions))}"
        raise ConfigError(message) from error
    path = folder / table.bundle
    if not (path / "bundle.json").is_file():
        message = f'[head] bundle = "{table.bundle}": {path} is no scan bundle (it has no bundle.json); name its folder'
        raise ConfigError(message)
    bundle = read_bundle(path)
    if not bundle.capture.shots:
        message = f"{path / 'bundle.json'}: the recording has no frames; there is nothing to replay"
        raise BundleError(message)
    return ReplayHead(bundle)


def _recorded_ns(shot: Shot) -> int:
    return round(shot.time_s * 1e9) if shot.time_s is not None else 0


def _member(pattern: Pattern) -> str:
    """Which pattern of its family."""
    match pattern:
        case Gray():
            return f"bit {pattern.bit} of {_family(pattern)}"
        case LineShift():
            return f"shift {pattern.shift} of {_family(pattern)}"
        case _:
            return _family(pattern)


def _family(pattern: Pattern) -> str:
    """What a pattern is one of, in the words of a request."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            offset = f", offset {pattern.offset_px} px" if pattern.offset_px else ""
            return (
                f"a {pattern.axis} Gray code of {pattern.bits} bits with cells of {pattern.cell_px} px{offset}{inverse}"
            )
        case LineShift():
            return f"{pattern.axis} lines of {pattern.line_width_px} px, period {pattern.period_px} px"

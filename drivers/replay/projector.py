"""The projector of a recording: it shows the recorded patterns, and refuses others."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.replay.camera import ReplayCamera, ReplayState
from drivers.replay.clock import ReplayClock
from slrig.bundle import Bundle
from slrig.devices import COMPUTED_LIMITS, DisplayedPattern, ProjectorInfo, ProjectorState
from slrig.errors import UnsupportedByDeviceError, setting
from slrig.model import Black, Gray, LineShift, Pattern, PatternSequence, Primary, White


class ReplayProjector:
    """Implements `slrig.devices.Projector` on the patterns of a recording."""

    def __init__(
        self, bundle: Bundle, cameras: Mapping[str, ReplayCamera], clock: ReplayClock, replay_state: ReplayState
    ) -> None:
        self._info = ProjectorInfo(
            name="projector",
            model="recorded projector",
            serial=bundle.folder.name,
            size=bundle.capture.projector,
            plays=False,
            latency_s=0.0,
            limits=COMPUTED_LIMITS,
            recorded=tuple(
                pattern
                for pattern in bundle.capture.patterns
                if all(camera.recorded_frames(pattern) for camera in cameras.values())
            ),
            lights=any(isinstance(pattern, Primary) for pattern in bundle.capture.patterns),
        )
        self._recorded = tuple(dict.fromkeys(bundle.capture.patterns))
        self._cameras = cameras
        self._clock = clock
        self._replay_state = replay_state
        self._state = ProjectorState("the recording's projector")

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses a pattern of which a camera has no frame."""
        self._state.require_open()
        self._state.require_size(sequence, self._info.size)
        for pattern in sequence.patterns:
            missing = [name for name, camera in self._cameras.items() if not camera.recorded_frames(pattern)]
            if missing:
                recorded = "; ".join(dict.fromkeys(map(_describe_family, self._recorded)))
                message = (
                    f"the recording '{self._info.serial}' has no frame of {_describe_pattern(pattern)} from camera "
                    f"{', '.join(missing)}; it has {recorded}. Leave the patterns out of the "
                    "request and of the rig file's [scan] to replay all recorded ones; or request some of them: "
                    f"{setting('gray_cell_px')}, {setting('line_shift_period_px')} and similar settings"
                )
                raise UnsupportedByDeviceError(message)
        self.blank()
        self._clock.rewind()
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`."""
        patterns = self._state.require_pattern(index).patterns
        pattern = patterns[index]
        showing = patterns[:index].count(pattern)
        self._replay_state.pattern = (pattern, showing)
        times_s = [
            shots[min(showing, len(shots) - 1)].time_s
            for shots in (camera.recorded_frames(pattern) for camera in self._cameras.values())
        ]
        first_s = min((time_s for time_s in times_s if time_s is not None), default=0.0)
        return DisplayedPattern(index, self._clock.change_light(first_s), 0)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Not supported."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        self._replay_state.pattern = None
        self._clock.change_light()

    def close(self) -> None:
        """See `Projector`."""
        self._clock.release()
        self.blank()
        self._state.loaded = None
        self._state.closed.set()


def _describe_pattern(pattern: Pattern) -> str:
    """Describe a pattern within its family."""
    match pattern:
        case Gray():
            return f"bit {pattern.bit} of {_describe_family(pattern)}"
        case LineShift():
            return f"shift {pattern.shift} of {_describe_family(pattern)}"
        case _:
            return _describe_family(pattern)


def _describe_family(pattern: Pattern) -> str:
    """Describe the family of a pattern as in a request."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Primary():
            return pattern.description
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            offset = f", offset {pattern.offset_px} px" if pattern.offset_px else ""
            return (
                f"a {pattern.axis} Gray code of {pattern.bits} bits with cells of {pattern.cell_px} px{offset}{inverse}"
            )
        case LineShift():
            return f"{pattern.axis} lines of {pattern.line_width_px} px, period {pattern.period_px} px"

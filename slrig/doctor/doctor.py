"""The examination of a rig, one thing after the other: what it finds, and the values for a better rig file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from slrig.capture import DEFAULT_SEARCH_S, LatencyMeasurement, choose_triggers, earliest_change_s
from slrig.devices import CameraInfo, FoundDevice, ProjectorInfo, Rig, Synchronisation, UnknownPolarityProjector
from slrig.doctor import timing
from slrig.doctor.advice import ExposureAdvice, LineAdvice, exposure_advice, is_whole, line_advice, unsnapped
from slrig.doctor.current import sense_of_current
from slrig.doctor.findings import Finding, Severity, camera_named, fault, ms, note, ok
from slrig.doctor.flicker import Flicker, flicker
from slrig.doctor.focus import focus
from slrig.doctor.geometry import picture
from slrig.doctor.light import Seen, at_exposure, look
from slrig.doctor.measures.levels import ResponseCurve
from slrig.doctor.response import response
from slrig.doctor.sharpening import sharpening
from slrig.doctor.viewing import Viewer
from slrig.errors import DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size
from slrig.patterns import encode, scan_patterns

Told = Callable[[str, float, str], None]

USUAL_PERIOD_PX = 8


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What an examination found. None or absent is what could not be measured.

    exposures : by camera. lines : that suit the blur better than the rig's own. synchronisation : as measured; None too
    where the rig needs none. refresh_hz : None without a grid of refreshes.
    """

    rig: str
    findings: tuple[Finding, ...]
    exposures: Mapping[str, ExposureAdvice]
    lines: LineAdvice | None
    synchronisation: Synchronisation | None
    refresh_hz: float | None
    response: ResponseCurve | None
    flickers: tuple[Flicker, ...]

    @property
    def healthy(self) -> bool:
        """Whether there is no fault."""
        return not self.of(Severity.FAULT)

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """The findings that matter so much."""
        return tuple(each for each in self.findings if each.severity is severity)

    def document(self) -> dict[str, Any]:
        """The diagnosis as JSON can hold it."""
        document: dict[str, Any] = _plain({"healthy": self.healthy, **asdict(self)})
        return document


def doctor_sequence(size: Size) -> PatternSequence:
    """White, black, and a Gray code of single columns and rows: its finest bars tell the focus."""
    patterns = scan_patterns(
        size, line_shift=False, period_px=8, line_width_px=1, gray_cell_px=1, gray_offset_px=0, rows=True
    )
    return encode(patterns, size)


def examine(
    rig: Rig,
    *,
    own_sequence: PatternSequence,
    displays: Sequence[FoundDevice] = (),
    period_px: int = USUAL_PERIOD_PX,
    steps: int = USUAL_PERIOD_PX,
    search_s: float = DEFAULT_SEARCH_S,
    told: Told = lambda _stage, _fraction, _detail: None,
) -> Diagnosis:
    """Examine an open rig. However it ends, the projector is dark and the cameras are disarmed afterwards.

    own_sequence : the patterns of a scan on this rig, for a projector that holds them and can show no others.
    displays : projectors and outputs that finders found, this rig's among them. period_px : distance of the lines that
    this rig scans with, by which its focus is judged; steps : how many frames of them it plays. search_s : how late
    light may be. told : is told the stage, the fraction done and a detail.
    """
    examination = _Examination(rig, own_sequence, displays, period_px, steps, search_s, told)
    try:
        examination.run()
    finally:
        for camera in rig.cameras.values():
            with suppress(Exception):
                camera.disarm()
        with suppress(Exception):
            rig.projector.blank()
    return examination.diagnosis()


@dataclass
class _Examination:
    """One examination under way."""

    rig: Rig
    sequence: PatternSequence
    displays: Sequence[FoundDevice]
    period_px: int
    steps: int
    search_s: float
    told: Told

    def __post_init__(self) -> None:
        self.findings: list[Finding] = []
        self.seen: dict[str, Seen] = {}
        self.measured: LatencyMeasurement | None = None
        self.refresh_hz: float | None = None
        self.curve: ResponseCurve | None = None
        self.flickers: tuple[Flicker, ...] = ()
        self.is_polarity_unknown = False
        self._advice: dict[str, ExposureAdvice] = {}
        self._blurs_px: list[float] = []

    def run(self) -> None:
        self.findings += _declared(self.rig, self.displays)
        steps: list[tuple[str, Callable[[], None]]] = [
            ("patterns", self._choose_sequence),
            ("light", self._look),
            ("current", self._prove),
            ("timing", self._time),
            ("picture and focus", self._picture),
            ("response", self._response),
            ("flicker", self._flicker),
            ("exposure", self._advise),
        ]
        for number, (stage, step) in enumerate(steps):
            self.told(stage, number / len(steps), "")
            try:
                step()
            except DeviceError as error:
                self.findings.append(_failed(stage, error))
                if isinstance(error, DeviceGoneError):
                    return
            if self.is_polarity_unknown:
                # All else would be measured in a light that is not the one of scans.
                return

    def diagnosis(self) -> Diagnosis:
        order = list(Severity)[::-1]
        findings = tuple(sorted(self.findings, key=lambda each: order.index(each.severity)))
        return Diagnosis(
            self.rig.name, findings, self._advice, self._lines(), self.synchronisation, self.refresh_hz, self.curve,
            self.flickers,
        )  # fmt: skip

    def _lines(self) -> LineAdvice | None:
        """By the camera that sees them least sharp."""
        measured = [blur_px for blur_px in self._blurs_px if math.isfinite(blur_px)]
        return line_advice(max(measured), self.period_px, self.steps) if measured else None

    @property
    def synchronisation(self) -> Synchronisation | None:
        """As measured, None where it was not or where nothing has to be waited for."""
        if self.measured is None:
            return None
        found = self.measured.synchronisation
        streams = earliest_change_s(replace(self.rig, synchronisation=found), choose_triggers(self.rig)) is not None
        needless = timing.late_s(self.measured) < timing.LATE_S and not found.line_time_s and not streams
        return None if needless and self.rig.synchronisation is None else found

    def _choose_sequence(self) -> None:
        """Our own patterns where the projector takes them; else those of a scan, which it may hold."""
        asked = doctor_sequence(self.rig.projector.info.size)
        try:
            self.rig.projector.load(asked)
            self.sequence = asked
        except DeviceGoneError:
            raise
        except DeviceError as error:
            self.rig.projector.load(self.sequence)
            found = f"it is examined with the patterns of a scan, since it does not take others: {error}"
            self.findings.append(ok("patterns.own", "projector", found))

    def _look(self) -> None:
        others = _others(self.displays)
        for name in self.rig.cameras:
            try:
                viewer = Viewer(self.rig, name, wait_s=self.search_s)
            except UnsupportedByDeviceError as error:
                remedy = "choose another trigger in its options to have it examined"
                self.findings.append(note("device.unexamined", camera_named(name), f"not examined: {error}", remedy))
                continue
            try:
                seen, findings = look(viewer, self.sequence, others=others)
            except DeviceGoneError:
                raise
            except DeviceError as error:
                self.findings.append(_failed("light", error, camera_named(name)))
                continue
            self.findings += findings
            if seen is not None:
                self.seen[name] = seen

    def _prove(self) -> None:
        """Find out which way the current goes, where the projector does not know."""
        projector, best_lit = self.rig.projector, self._best_lit()
        self.is_polarity_unknown = isinstance(projector, UnknownPolarityProjector) and projector.is_polarity_unknown
        if self.is_polarity_unknown and best_lit is not None:
            self.findings.append(sense_of_current(self._viewer(best_lit.name), self.sequence, best_lit))

    def _time(self) -> None:
        if not self.seen:
            return
        self.refresh_hz, findings = timing.refresh(self.rig)
        self.findings += findings
        self.measured, findings = timing.latency(self.rig, self.seen, search_s=self.search_s, told=self.told)
        self.findings += findings
        if self.refresh_hz is not None:
            self.seen = {name: self._snapped(each, 1 / self.refresh_hz) for name, each in self.seen.items()}

    def _snapped(self, seen: Seen, period_s: float) -> Seen:
        """The same with an exposure for the examination of whole refresh periods, where one fits."""
        if is_whole(seen.exposure_s, period_s) or seen.exposure_s < period_s:
            return seen
        exposure_s = math.floor(seen.exposure_s / period_s) * period_s
        return at_exposure(self._viewer(seen.name), self.sequence, seen, exposure_s)

    def _viewer(self, name: str) -> Viewer:
        """A camera that waits for as long as was measured, or for as long as light was searched for."""
        if self.measured is None:
            return Viewer(self.rig, name, wait_s=self.search_s)
        return Viewer(replace(self.rig, synchronisation=self.measured.synchronisation), name)

    def _picture(self) -> None:
        for name, seen in self.seen.items():
            shown, findings = picture(self._viewer(name), self.sequence, seen, self.rig.calibration)
            self.findings += findings
            blur_px, findings = focus(name, self.sequence, seen, shown, period_px=self.period_px)
            self._blurs_px.append(blur_px)
            self.findings += findings
            self.findings += sharpening(name, seen, shown, self.rig.calibration)

    def _best_lit(self) -> Seen | None:
        """What the camera sees that is asked about the projector: the one whose image it lights most."""
        return max(self.seen.values(), key=lambda each: each.levels.lit_share, default=None)

    def _response(self) -> None:
        if (best_lit := self._best_lit()) is not None:
            self.curve, findings = response(self._viewer(best_lit.name), best_lit)
            self.findings += findings

    def _flicker(self) -> None:
        if (best_lit := self._best_lit()) is None:
            return
        viewer = self._viewer(best_lit.name)
        rows = viewer.camera.info.format.size.height_px
        line_time_s = best_lit.skew_s / max(rows - 1, 1)
        if self.measured is not None:
            line_time_s = self.measured.line_time_s.get(best_lit.name, line_time_s)
        self.flickers, findings = flicker(viewer, best_lit, line_time_s=line_time_s)
        self.findings += findings

    def _advise(self) -> None:
        for name, seen in self.seen.items():
            self.findings += unsnapped(seen, self.refresh_hz)
            limits_s = self.rig.cameras[name].info.exposure_range_s
            self._advice[name] = exposure_advice(seen, limits_s, refresh_hz=self.refresh_hz, flickers=self.flickers)


def _declared(rig: Rig, displays: Sequence[FoundDevice]) -> list[Finding]:
    found = [ok("device.projector", "projector", _of_projector(rig.projector.info))]
    for name, camera in rig.cameras.items():
        found.append(ok("device.camera", camera_named(name), _of_camera(camera.info)))
        remedy = (
            "do what it says, in the camera's table of the rig file; slrig devices --options lists what can be written"
        )
        found += [
            note("device.told", camera_named(name), f"its driver tells: {each}", remedy) for each in camera.info.notes
        ]
    if displays:
        listed = "; ".join(f"{each.device} ({each.driver}): {each.label}" for each in displays)
        found.append(ok("device.displays", "projector", f"projectors and outputs that were found: {listed}"))
    if rig.calibration is None:
        remedy = "calibrate it once the other findings are put right; a scan without one gives no millimetres"
        found.append(note("device.uncalibrated", "rig", "it has no calibration", remedy))
    return found


def _of_projector(info: ProjectorInfo) -> str:
    plays = "plays sequences by itself" if info.plays else "shows one pattern at a time"
    return f"{info.model} {info.serial}: {info.size} pixels, {plays}, typically {ms(info.latency_s)} to light"


def _of_camera(info: CameraInfo) -> str:
    least_s, most_s = info.exposure_range_s
    return (
        f"{info.model} {info.serial}: {info.format.size} pixels of {info.format.bit_depth} bits, triggered by "
        f"{', '.join(sorted(info.triggers))}; exposures {ms(least_s)} to {ms(most_s)}"
    )


def _others(displays: Sequence[FoundDevice]) -> str:
    if not displays:
        return "No finder found other displays"
    return "Displays that were found: " + ", ".join(f"{each.device} ({each.label})" for each in displays)


def _failed(stage: str, error: DeviceError, subject: str = "rig") -> Finding:
    remedy = "put that right, and run the doctor again; slrig conform tells faults of drivers"
    found = f"the examination of {stage} ended with a fault of a device: {error}"
    return fault("device.failed", subject, found, remedy)


def _plain(value: Any) -> Any:
    """A value as JSON can hold it: no arrays, no NaN, no infinity."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

"""Examination of a rig: findings about its light, timing, focus and flicker, and values for a better rig file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self, TypeVar, cast

import numpy as np

from slrig.capture.latency import DEFAULT_SEARCH_S, CameraLatency, LatencyMeasurement
from slrig.capture.sequencer import choose_triggers
from slrig.capture.streaming import earliest_change_s
from slrig.capture.triggering import differs_from_request
from slrig.devices import (
    CameraInfo,
    FoundDevice,
    ProjectorInfo,
    Rig,
    Synchronisation,
    Trigger,
    UnknownPolarityProjector,
)
from slrig.doctor import timing
from slrig.doctor.advice import (
    ExposureAdvice,
    LineAdvice,
    advise_exposure,
    advise_lines,
    check_refresh_multiple,
    is_whole_periods,
)
from slrig.doctor.image import (
    check_calibrated,
    check_exposures,
    check_focus,
    check_sharpening,
    check_steady,
    measure_response,
)
from slrig.doctor.light import (
    CameraSession,
    Finding,
    LightMeasurement,
    LocatedPicture,
    Severity,
    camera_label,
    fault,
    find_current_direction,
    format_ms,
    locate_picture,
    measure_light,
    note,
    ok,
    remeasure_light,
)
from slrig.doctor.measures import ResponseCurve
from slrig.errors import DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.jobs.listener import SILENT, Listener
from slrig.model import PatternSequence, Size
from slrig.patterns import encode, scan_patterns

_Value = TypeVar("_Value")

DEFAULT_PERIOD_PX = 8


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of an examination. None or absent is what could not be measured.

    exposures : by camera. lines : lines that suit the blur better than the rig's own. synchronisation : as measured;
    None too if scans need not wait. refresh_hz : None if the display has no grid of refreshes.
    trigger_period_s : least time between trigger pulses; None too if the cameras follow the rate that they state.
    """

    rig: str
    findings: tuple[Finding, ...]
    exposures: Mapping[str, ExposureAdvice]
    lines: LineAdvice | None
    synchronisation: Synchronisation | None
    refresh_hz: float | None
    response: ResponseCurve | None
    flickers: tuple[timing.LightFlicker, ...]
    trigger_period_s: float | None = None

    @property
    def healthy(self) -> bool:
        """True if there are no faults."""
        return not self.with_severity(Severity.FAULT)

    def with_severity(self, severity: Severity) -> tuple[Finding, ...]:
        """Return the findings of one severity."""
        return tuple(each for each in self.findings if each.severity is severity)

    def document(self) -> dict[str, Any]:
        """Return the diagnosis as JSON can hold it."""
        document: dict[str, Any] = _to_json({"healthy": self.healthy, **asdict(self)})
        return document

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Self:
        """The diagnosis that `document` returned."""
        lines, curve, synchronisation = document["lines"], document["response"], document["synchronisation"]
        if curve is not None:
            curve = {**curve, **{name: np.asarray(curve[name], np.float64) for name in ("values", "light")}}
        return cls(
            rig=document["rig"],
            findings=tuple(
                Finding(**{**each, "severity": Severity(each["severity"])}) for each in document["findings"]
            ),
            exposures={name: _restored(ExposureAdvice, each) for name, each in document["exposures"].items()},
            lines=None if lines is None else _restored(LineAdvice, lines),
            synchronisation=None if synchronisation is None else Synchronisation(**synchronisation),
            refresh_hz=document["refresh_hz"],
            response=None if curve is None else _restored(ResponseCurve, curve),
            flickers=tuple(_restored(timing.LightFlicker, each) for each in document["flickers"]),
            trigger_period_s=document.get("trigger_period_s"),
        )


def latency_document(measured: LatencyMeasurement, known: Synchronisation | None) -> dict[str, Any]:
    """Synchronisation and latencies of the cameras as JSON can hold them. known : what the rig file says: it keeps the
    period of its trigger pulses, which flashes do not measure.
    """
    cameras = {name: asdict(each) for name, each in measured.cameras.items()}
    found = replace(measured.synchronisation, trigger_period_s=None if known is None else known.trigger_period_s)
    document: dict[str, Any] = _to_json({"synchronisation": asdict(found), "cameras": cameras})
    return document


def latency_from_document(document: Mapping[str, Any]) -> tuple[Synchronisation, dict[str, CameraLatency]]:
    """What `latency_document` returned, as values."""
    cameras = {name: _restored(CameraLatency, each) for name, each in document["cameras"].items()}
    return Synchronisation(**document["synchronisation"]), cameras


def doctor_sequence(size: Size) -> PatternSequence:
    """White, black, and a Gray code of single columns and rows, whose finest bars show the blur."""
    patterns = scan_patterns(
        size, line_shift=False, period_px=8, line_width_px=1, gray_cell_px=1, gray_offset_px=0, rows=True
    )
    return encode(patterns, size)


def examine(
    rig: Rig,
    listener: Listener = SILENT,
    *,
    own_sequence: PatternSequence,
    displays: Sequence[FoundDevice] = (),
    period_px: int = DEFAULT_PERIOD_PX,
    steps: int = DEFAULT_PERIOD_PX,
    sines: bool = False,
    search_s: float = DEFAULT_SEARCH_S,
) -> Diagnosis:
    """Examine an open rig. In every case the projector is dark and the cameras are disarmed afterwards.

    own_sequence : patterns of a scan on this rig, for a projector that can show only the patterns it holds.
    displays : projectors and outputs that the finders found, including the rig's own.
    period_px : distance of the lines that this rig scans with; steps : number of frames of them. sines : it scans with
    sinusoids of that period in place of lines.
    search_s : longest latency to search for.
    """
    run = _DoctorRun(rig, own_sequence, displays, period_px, steps, sines, search_s, listener)
    try:
        run.run()
    finally:
        for camera in rig.cameras.values():
            with suppress(Exception):
                camera.disarm()
        with suppress(Exception):
            rig.projector.blank()
    return run.diagnosis()


@dataclass
class _DoctorRun:
    """One examination in progress."""

    rig: Rig
    sequence: PatternSequence
    displays: Sequence[FoundDevice]
    period_px: int
    steps: int
    sines: bool
    search_s: float
    listener: Listener

    def __post_init__(self) -> None:
        self.findings: list[Finding] = []
        self.lights: dict[str, LightMeasurement] = {}
        self.latency: LatencyMeasurement | None = None
        self.refresh_hz: float | None = None
        self.curve: ResponseCurve | None = None
        self.flickers: tuple[timing.LightFlicker, ...] = ()
        self.trigger_period_s: float | None = None
        self.is_polarity_unknown = False
        self._advice: dict[str, ExposureAdvice] = {}
        self._blurs_px: list[float] = []
        self._exponents: dict[str, float | None] = {}
        self._pictures: dict[str, LocatedPicture] = {}

    def run(self) -> None:
        self.findings += _describe_devices(self.rig, self.displays)
        checks: list[tuple[str, Callable[[], None]]] = [
            ("patterns", self._choose_sequence),
            ("light", self._measure_lights),
            ("current", self._check_current),
            ("exposures", self._check_exposures),
            ("timing", self._measure_timing),
            ("picture and focus", self._check_pictures),
            ("response", self._measure_response),
            # A lens that moves back and forth may be back where it was at one measurement.
            ("steadiness", self._check_steady),
            ("flicker", self._measure_flicker),
            ("exposure", self._advise_exposures),
            ("steadiness", self._check_steady),
            ("live depth", self._measure_live),
            ("steadiness", self._check_steady),
        ]
        if self.rig.projector.info.plays and all(
            Trigger.HARDWARE in camera.info.triggers for camera in self.rig.cameras.values()
        ):
            checks.append(("trigger pulses", self._measure_pulses))
        for number, (stage, check) in enumerate(checks):
            self.listener.step(stage, number / len(checks), "")
            try:
                check()
            except DeviceError as error:
                self.findings.append(_device_failure(stage, error))
                if isinstance(error, DeviceGoneError):
                    return
            if self.is_polarity_unknown:
                # The other checks would measure a light that is not the light of scans.
                return

    def diagnosis(self) -> Diagnosis:
        order = list(Severity)[::-1]
        findings = tuple(sorted(self.findings, key=lambda each: order.index(each.severity)))
        blurs_px = [blur_px for blur_px in self._blurs_px if math.isfinite(blur_px)]
        # The camera with the greatest blur decides.
        lines = advise_lines(max(blurs_px, default=math.inf), self.period_px, self.steps, sines=self.sines)
        return Diagnosis(
            self.rig.name, findings, self._advice, lines, self.synchronisation, self.refresh_hz, self.curve,
            self.flickers, self.trigger_period_s,
        )  # fmt: skip

    @property
    def synchronisation(self) -> Synchronisation | None:
        """Measured synchronisation; None if it was not measured, or if scans need not wait."""
        if self.latency is None:
            return None
        measured = self.latency.synchronisation
        streams = earliest_change_s(replace(self.rig, synchronisation=measured), choose_triggers(self.rig)) is not None
        is_late = timing.lateness_s(self.latency) >= timing.MAX_LATENESS_S
        is_needed = is_late or measured.line_time_s or streams or self.rig.synchronisation is not None
        return measured if is_needed else None

    def _choose_sequence(self) -> None:
        """Load the doctor's own patterns or, if the projector refuses them, those of a scan."""
        own = doctor_sequence(self.rig.projector.info.size)
        try:
            self.rig.projector.load(own)
            self.sequence = own
        except DeviceGoneError:
            raise
        except DeviceError as error:
            self.rig.projector.load(self.sequence)
            message = f"it is examined with the patterns of a scan, because it refuses others: {error}"
            self.findings.append(ok("patterns.own", "projector", message))

    def _measure_lights(self) -> None:
        displays = _describe_displays(self.displays)
        for name in self.rig.cameras:
            subject = camera_label(name)
            try:
                session = CameraSession(self.rig, name, wait_s=self.search_s)
            except UnsupportedByDeviceError as error:
                remedy = "choose another trigger in its options to have it examined"
                self.findings.append(note("device.unexamined", subject, f"not examined: {error}", remedy))
                continue
            try:
                light, findings = measure_light(session, self.sequence, displays=displays)
            except DeviceGoneError:
                raise
            except DeviceError as error:
                self.findings.append(_device_failure("light", error, subject))
                continue
            self.findings += findings
            if light is not None:
                self.lights[name] = light

    def _check_current(self) -> None:
        projector, best_lit = self.rig.projector, self._best_lit()
        self.is_polarity_unknown = isinstance(projector, UnknownPolarityProjector) and projector.is_polarity_unknown
        if self.is_polarity_unknown and best_lit is not None:
            finding = find_current_direction(self._open_session(best_lit.name), self.sequence, best_lit)
            self.findings.append(finding)

    def _check_exposures(self) -> None:
        for name, light in self.lights.items():
            session = self._open_session(name)
            self.lights[name], self._exponents[name], findings = check_exposures(session, self.sequence, light)
            self.findings += findings

    def _measure_timing(self) -> None:
        if not self.lights:
            return
        self.refresh_hz, findings = timing.measure_refresh(self.rig)
        self.findings += findings
        scans_s = {
            name: advise_exposure(
                light, self.rig.cameras[name].info.exposure_range_s, refresh_hz=self.refresh_hz, flickers=()
            ).exposure_s
            for name, light in self.lights.items()
        }
        self.latency, findings = timing.measure_light_latency(
            self.rig, self.lights, scans_s, self.listener, search_s=self.search_s
        )
        self.findings += findings
        if self.refresh_hz is not None:
            self.lights = {name: self._snap_exposure(each, 1 / self.refresh_hz) for name, each in self.lights.items()}

    def _snap_exposure(self, light: LightMeasurement, period_s: float) -> LightMeasurement:
        """Measure again with an exposure of whole refresh periods, if one fits."""
        if is_whole_periods(light.exposure_s, period_s) or light.exposure_s < period_s:
            return light
        exposure_s = math.floor(light.exposure_s / period_s) * period_s
        return remeasure_light(self._open_session(light.name), self.sequence, light, exposure_s)

    def _open_session(self, name: str) -> CameraSession:
        """Return a session that waits for the measured latency or, if there is none, for the longest searched."""
        if self.latency is None:
            return CameraSession(self.rig, name, wait_s=self.search_s)
        return CameraSession(replace(self.rig, synchronisation=self.latency.synchronisation), name)

    def _check_pictures(self) -> None:
        for name, light in self.lights.items():
            picture, findings = locate_picture(self._open_session(name), self.sequence, light, self.rig.calibration)
            if not any(each.severity is Severity.FAULT for each in findings):
                findings += check_calibrated(name, light, picture, self.rig.calibration)
            self.findings += findings
            blur_px, findings = check_focus(
                name, self.sequence, light, picture, period_px=self.period_px, steps=self.steps, sines=self.sines
            )
            self._blurs_px.append(blur_px)
            self.findings += findings
            self.findings += check_sharpening(name, light, picture, self.rig.calibration)
            self._pictures[name] = picture

    def _check_steady(self) -> None:
        for name, picture in self._pictures.items():
            label = camera_label(name)
            before = [each for each in self.findings if (each.name, each.subject) == ("picture.steady", label)]
            if all(each.severity is Severity.OK for each in before):
                found = check_steady(self._open_session(name), self.sequence, self.lights[name], picture)
                # A lens that moves is the cause of blur, and not where it or the projector's stood at one look.
                caused = {"projector", label} if len(self._pictures) == 1 else {label}
                moves = any(each.severity is Severity.FAULT for each in found)
                self.findings = [
                    each for each in self.findings
                    if each not in before and not (moves and each.name.startswith("focus.") and each.subject in caused)
                ] + found  # fmt: skip

    def _best_lit(self) -> LightMeasurement | None:
        """Measurement by the camera whose image the projector lights most: it examines the projector."""
        return max(self.lights.values(), key=lambda each: each.levels.lit_share, default=None)

    def _measure_response(self) -> None:
        if (best_lit := self._best_lit()) is not None:
            session = self._open_session(best_lit.name)
            self.curve, findings = measure_response(session, best_lit, self._exponents[best_lit.name])
            self.findings += findings

    def _measure_flicker(self) -> None:
        if (best_lit := self._best_lit()) is None:
            return
        session = self._open_session(best_lit.name)
        rows = session.camera.info.format.size.height_px
        line_time_s = best_lit.skew_s / max(rows - 1, 1)
        if self.latency is not None:
            line_time_s = self.latency.line_time_s.get(best_lit.name, line_time_s)
        self.flickers, findings = timing.measure_flicker(session, best_lit, line_time_s=line_time_s)
        self.findings += findings

    def _advise_exposures(self) -> None:
        for name, light in self.lights.items():
            self.findings += check_refresh_multiple(light, self.refresh_hz)
            camera = self.rig.cameras[name]
            limits_s = camera.info.exposure_range_s
            advice = advise_exposure(light, limits_s, refresh_hz=self.refresh_hz, flickers=self.flickers)
            camera.disarm()
            settings = replace(self.rig.settings[name], exposure_s=advice.exposure_s)
            taken_s = camera.configure(settings).exposure_s
            if differs_from_request(taken_s, advice.exposure_s):
                reason = f"{advice.reason}; of {format_ms(advice.exposure_s)} the camera takes this"
                advice = replace(advice, exposure_s=taken_s, reason=reason)
            self._advice[name] = advice

    def _measure_live(self) -> None:
        """Play live depth to each camera that takes real time."""
        rig = self.rig if self.synchronisation is None else replace(self.rig, synchronisation=self.synchronisation)
        for name, camera in rig.cameras.items():
            if name in self._advice and not camera.info.limits.computed:
                self.findings.append(timing.measure_live(rig, name, self._advice[name].exposure_s))

    def _measure_pulses(self) -> None:
        """Measure with the exposures that were advised, without what the rig file says of the period."""
        settings = {
            name: replace(each, exposure_s=self._advice[name].exposure_s) if name in self._advice else each
            for name, each in self.rig.settings.items()
        }
        known = self.rig.synchronisation if self.latency is None else self.latency.synchronisation
        known = None if known is None else replace(known, trigger_period_s=None)
        rig = replace(self.rig, settings=settings, synchronisation=known)
        self.trigger_period_s, findings = timing.measure_pulses(rig, self.sequence)
        self.findings += findings


def _describe_devices(rig: Rig, displays: Sequence[FoundDevice]) -> list[Finding]:
    findings = [ok("device.projector", "projector", _describe_projector(rig.projector.info))]
    for name, camera in rig.cameras.items():
        findings.append(ok("device.camera", camera_label(name), _describe_camera(camera.info)))
        remedy = "follow it in the camera's table of the rig file; slrig devices --options lists all options"
        findings += [
            note("device.note", camera_label(name), f"its driver notes: {each}", remedy) for each in camera.info.notes
        ]
    if displays:
        listed = "; ".join(f"{each.device} ({each.driver}): {each.label}" for each in displays)
        findings.append(ok("device.displays", "projector", f"projectors and outputs that were found: {listed}"))
    if rig.calibration is None:
        # Lenses that nobody knows explain a picture that is zoomed or warped from four corners as well as a true one.
        remedy = (
            "switch keystone correction, digital zoom and overscan off, which cannot be seen before, and calibrate it "
            "after the other findings are corrected; without calibration, scans have no millimetres"
        )
        findings.append(note("device.uncalibrated", "rig", "it has no calibration", remedy))
    return findings


def _describe_projector(info: ProjectorInfo) -> str:
    plays = "plays sequences by itself" if info.plays else "shows one pattern at a time"
    return f"{info.model} {info.serial}: {info.size} pixels, {plays}, typically {format_ms(info.latency_s)} to light"


def _describe_camera(info: CameraInfo) -> str:
    min_s, max_s = info.exposure_range_s
    return (
        f"{info.model} {info.serial}: {info.format.size} pixels of {info.format.bit_depth} bits, triggered by "
        f"{', '.join(sorted(info.triggers))}; exposures {format_ms(min_s)} to {format_ms(max_s)}"
    )


def _describe_displays(displays: Sequence[FoundDevice]) -> str:
    if not displays:
        return "No finder found other displays"
    return "Displays that were found: " + ", ".join(f"{each.device} ({each.label})" for each in displays)


def _device_failure(stage: str, error: DeviceError, subject: str = "rig") -> Finding:
    remedy = "correct that, and run the doctor again; slrig conform finds faults of drivers"
    return fault("device.failed", subject, f"the examination of {stage} failed on a device: {error}", remedy)


def _restored(kind: type[_Value], document: Mapping[str, Any]) -> _Value:
    """A dataclass from its JSON values: NaN where a float is null, tuples where it has lists."""
    floats = {each.name for each in fields(cast("Any", kind)) if each.type == "float"}
    values = {
        name: math.nan if each is None and name in floats else tuple(each) if isinstance(each, list) else each
        for name, each in document.items()
    }
    return kind(**values)


def _to_json(value: Any) -> Any:
    """Return a value as JSON can hold it: no arrays, no NaN, no infinity."""
    if isinstance(value, Mapping):
        return {key: _to_json(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(each) for each in value]
    if isinstance(value, np.ndarray):
        return _to_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

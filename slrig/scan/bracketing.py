"""The sequence of a scan, played once, or once for each exposure of a bracket, and what its frames prove together.

An exposure under which a camera sees too little or too much is left out for that camera, and the scan says so. That is
believed only as light allows it: too dark, if no shorter exposure was bright enough. Anything else that speaks against
a frame ends the scan, as it does with one exposure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

from slrig.bundle import RefusedFrame
from slrig.capture import (
    NOISE_FLOOR_DN,
    Evidence,
    EvidenceSummary,
    ExposureFault,
    ExposureSamples,
    ExposureVerdict,
    Sampler,
    Samples,
    bracket_summary,
    capture,
    detect_movement,
    judge_exposure,
)
from slrig.devices import CameraSettings, Rig
from slrig.errors import ScanEvidenceError
from slrig.model import Black, PatternSequence, Pixels, Shot, White


@dataclass(slots=True)
class _BracketRun:
    """One sequence at one exposure: what of it stands, how often each frame was refused, white and black as last seen,
    and samples for the comparison with other exposures.
    """

    exposure_s: float | None
    evidence: Evidence
    standing: set[tuple[int, str]] = field(default_factory=set)
    refused: Counter[tuple[int, str]] = field(default_factory=Counter)
    ends: dict[tuple[int, str], Pixels] = field(default_factory=dict)
    samples: dict[str, dict[int, Samples]] = field(default_factory=dict)


class Exposing:
    """Plays the sequence of a plan on a rig.

    Parameters
    ----------
    exposures_s
        From short to long, for every camera; empty leaves each as its rig file has it.
    refused
        Is told of every exposure that does not count.
    colour
        Cameras whose white and black frames are kept in colour, too.
    """

    def __init__(
        self,
        rig: Rig,
        sequence: PatternSequence,
        exposures_s: Sequence[float],
        *,
        cancelled: Callable[[], bool],
        refused: Callable[[RefusedFrame], None],
        colour: Collection[str] = (),
    ) -> None:
        self._rig = rig
        self._sequence = sequence
        self._exposures_s: tuple[float | None, ...] = tuple(exposures_s) or (None,)
        self._cancelled = cancelled
        self._tell = refused
        self._colour = colour
        self._formats = {name: camera.info.format for name, camera in rig.cameras.items()}
        self._samplers = (
            {name: Sampler.from_size(form.size) for name, form in self._formats.items()} if self._bracket else {}
        )
        self._runs: list[_BracketRun] = []
        self._compared: dict[str, ExposureSamples] = {}
        self._refused: list[RefusedFrame] = []
        self._done: set[tuple[float | None, int, str]] = set()
        self._begun_s: float | None = None
        self._causes: dict[str, str] = {}

    @property
    def _bracket(self) -> bool:
        return len(self._exposures_s) > 1

    @property
    def total(self) -> int:
        """How many frames there will be, those that are left out among them."""
        return len(self._exposures_s) * len(self._sequence) * len(self._formats)

    @property
    def done(self) -> int:
        """How many of them are there, or left out."""
        return len(self._done)

    @property
    def refused_count(self) -> int:
        """How many exposures were refused."""
        return len(self._refused)

    def shots(self) -> Iterator[Shot]:
        """Yield the frames as `slrig.capture.sequencer.capture` does, and raise what that raises.

        Raises
        ------
        ScanEvidenceError
            Also: no exposure of a bracket is of use to a camera, or something moved between two of them.
        """
        since_ns = self._rig.clock.now_ns() if self._bracket else None
        cameras = list(self._rig.cameras)
        for exposure_s in self._exposures_s:
            yield from self._exposed(exposure_s, cameras, since_ns)
        unseen = [name for name in self._formats if name not in self._compared]
        if self._bracket and unseen:
            message = f"no exposure of the bracket is of use to camera '{unseen[0]}': {self._causes[unseen[0]]}"
            raise ScanEvidenceError(message)

    def summary(self) -> EvidenceSummary:
        """Sum up what the frames have proven, once all are there."""
        if not self._bracket:
            return self._runs[0].evidence.summary()
        parts = [(run.exposure_s or 0.0, run.evidence.summary()) for run in self._runs]
        return bracket_summary(parts, self._refused, (), self._sequence.patterns)

    def _exposed(self, exposure_s: float | None, cameras: list[str], since_ns: int | None) -> Iterator[Shot]:
        """One sequence at one exposure, without the cameras that it is of no use to; those for which it is too long
        are taken from `cameras`.
        """
        taking = list(cameras)
        self._skip(exposure_s, set(self._formats) - set(cameras))
        while taking:
            formats = {name: self._formats[name] for name in taking}
            run = _BracketRun(
                exposure_s, Evidence(self._sequence.patterns, formats, projector=self._sequence.projector)
            )
            try:
                yield from self._run(run, taking, since_ns)
            except ScanEvidenceError as error:
                unfit = self._unfit(run, taking)
                if not unfit:
                    raise self._placed(error, run) from error
                self._leave_out(run, unfit)
                taking = [name for name in taking if name not in unfit]
                cameras[:] = [n for n in cameras if n not in unfit or unfit[n].fault is not ExposureFault.TOO_BRIGHT]
                continue
            self._compare(run, taking)
            # Whole images: nobody asks for them again.
            run.ends.clear()
            self._runs.append(run)
            return

    def _run(self, run: _BracketRun, taking: Sequence[str], since_ns: int | None) -> Iterator[Shot]:
        shots = capture(
            self._set_to(run.exposure_s, taking),
            self._sequence,
            cancelled=self._cancelled,
            evidence=run.evidence,
            refused=lambda refused: self._take_refusal(run, refused),
            since_ns=since_ns,
            colour=self._colour,
        )
        for taken in shots:
            shot = self._timed(taken)
            self._see(run, shot)
            run.standing.add((shot.pattern, shot.camera))
            self._done.add((run.exposure_s, shot.pattern, shot.camera))
            yield shot

    def _set_to(self, exposure_s: float | None, taking: Sequence[str]) -> Rig:
        rig = self._rig
        if exposure_s is None:
            return rig
        # A rig file without a gain means 1.
        known = {name: rig.settings.get(name, CameraSettings(exposure_s)) for name in taking}
        return replace(
            rig,
            cameras={name: rig.cameras[name] for name in taking},
            settings={name: replace(each, exposure_s=exposure_s) for name, each in known.items()},
        )

    def _timed(self, shot: Shot) -> Shot:
        """The frame with its time counted from the first frame of all."""
        if not self._bracket or shot.time_s is None:
            return shot
        if self._begun_s is None:
            self._begun_s = shot.time_s
        return replace(shot, time_s=round(shot.time_s - self._begun_s, 9))

    def _see(self, run: _BracketRun, shot: Shot) -> None:
        if self._bracket:
            if isinstance(self._sequence.patterns[shot.pattern], White | Black):
                run.ends[shot.pattern, shot.camera] = shot.image
            samples = self._samplers[shot.camera].take(shot.image)
            run.samples.setdefault(shot.camera, {})[shot.pattern] = samples

    def _take_refusal(self, run: _BracketRun, refused: RefusedFrame) -> None:
        if self._bracket:
            shot = None if refused.shot is None else self._timed(refused.shot)
            if shot is not None:
                self._see(run, shot)
            refused = replace(refused, shot=shot, cause=f"at {run.exposure_s:g} s, {refused.cause}")
        run.standing.discard((refused.pattern, refused.camera))
        run.refused[refused.pattern, refused.camera] += 1
        self._note(refused)

    def _note(self, refused: RefusedFrame) -> None:
        self._refused.append(refused)
        self._tell(refused)

    def _unfit(self, run: _BracketRun, taking: Sequence[str]) -> dict[str, ExposureVerdict]:
        """The cameras to which this exposure is of no use, and why."""
        if not self._bracket:
            return {}
        found: dict[str, ExposureVerdict] = {}
        for name in taking:
            white, black = (self._end(run, name, kind) for kind in (White(), Black()))
            if white is None or black is None:
                continue
            told = judge_exposure(white, black, self._formats[name])
            # Light that a shorter exposure has seen cannot be too little for a longer one: then it went off.
            if told is not None and (told.fault is ExposureFault.TOO_BRIGHT or name not in self._compared):
                found[name] = told
        return found

    def _end(self, run: _BracketRun, name: str, kind: White | Black) -> Pixels | None:
        index = self._sequence.patterns.index(kind) if kind in self._sequence.patterns else -1
        return run.ends.get((index, name))

    def _leave_out(self, run: _BracketRun, unfit: dict[str, ExposureVerdict]) -> None:
        """Take back what there is of a sequence, and say why."""
        again = f"at {run.exposure_s:g} s, the sequence was begun again without camera {', '.join(unfit)}"
        for name, told in unfit.items():
            longer = "; it was not exposed longer than that" if told.fault is ExposureFault.TOO_BRIGHT else ""
            cause = f"{run.exposure_s:g} s is {told.fault} for camera '{name}': {told.description}{longer}"
            self._causes[name] = cause
            white = self._sequence.patterns.index(White())
            self._note(RefusedFrame(white, name, run.refused[white, name] + 1, cause, left_out=True))
        for pattern, name in sorted(run.standing):
            cause = self._causes[name] if name in unfit else again
            attempt = run.refused[pattern, name] + 1
            self._note(RefusedFrame(pattern, name, attempt, cause, delivered=True, left_out=name in unfit))
        self._skip(run.exposure_s, set(unfit))

    def _skip(self, exposure_s: float | None, cameras: set[str]) -> None:
        self._done.update((exposure_s, index, name) for name in cameras for index in range(len(self._sequence)))

    def _compare(self, run: _BracketRun, taking: Sequence[str]) -> None:
        """Raise ScanEvidenceError if something moved since the exposure before."""
        if not self._bracket:
            return
        noises = run.evidence.summary().noise_dn
        for name in taking:
            exposed = ExposureSamples(run.exposure_s or 0.0, run.samples[name], noises.get(name, NOISE_FLOOR_DN))
            before = self._compared.get(name)
            if before is not None:
                fault = detect_movement(before, exposed, self._sequence.patterns, self._formats[name].full_scale)
                if fault is not None:
                    message = f"camera '{name}', {fault}"
                    raise ScanEvidenceError(message)
            self._compared[name] = exposed

    def _placed(self, error: ScanEvidenceError, run: _BracketRun) -> ScanEvidenceError:
        return ScanEvidenceError(f"at an exposure of {run.exposure_s:g} s, {error}") if self._bracket else error

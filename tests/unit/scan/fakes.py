"""A rig of two tame devices, a capture that a test steers, and a clock that a test sets."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from slrig.bundle import write_bundle
from slrig.capture.verifier import EvidenceSummary
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, DisplayedPattern, ProjectorInfo, Rig, Trigger
from slrig.discovery import DiscoveredDevices
from slrig.doctor import Diagnosis
from slrig.errors import ScanCancelledError
from slrig.jobs.job import FrameSink, JobRun, Recording
from slrig.jobs.listener import Listener
from slrig.jobs.worker import Task, job_task
from slrig.model import (
    Axis,
    Black,
    Calibration,
    CameraFormat,
    Capture,
    Frame,
    Gray,
    Pattern,
    Pinhole,
    Shot,
    Size,
    SolveRecord,
    White,
)
from slrig.model.capture import CaptureHeader
from slrig.scan.job import ScanJob
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from tests.unit.stand_ins import stand_ins

WAIT_S = 20.0
"""How long a test waits for an event that must come; a pass never waits for it to run out."""


OUTLINE = CaptureHeader(
    Size(64, 40), (White(), Black()), {"cam0": CameraFormat(Size(64, 48), 8)}, ((0, "cam0"), (1, "cam0"))
)
CALIBRATION = Calibration({}, None)
SHOTS = tuple(Shot(index, "cam0", np.zeros((48, 64), dtype=np.uint8)) for index in range(2))
EVIDENCE = EvidenceSummary(2, 2, {}, {}, {}, ())


CAMERA, PROJECTOR_SIZE = Size(64, 48), Size(64, 40)
"""Of the tame devices."""


def tame_calibration(
    *, camera: Size = CAMERA, projector: Size = PROJECTOR_SIZE, focal_px: float = 80.0, sigma: float = 0.1
) -> Calibration:
    """A calibration of the tame bench's devices; `sigma` is the deviation of every number."""
    eye, there = np.eye(3), np.array([-100.0, 0.0, 0.0])
    lens = np.array([[focal_px, 0.0, 31.5], [0.0, focal_px, 23.5], [0.0, 0.0, 1.0]])
    volume = np.array([[-40.0, -30.0, 450.0], [40.0, 30.0, 550.0]])
    solved = SolveRecord("tame", "2026-11-21T11:00:00+00:00", np.eye(30) * sigma**2, volume, 0.02)
    cameras = {"cam0": Pinhole(camera, lens, np.zeros(5), eye, np.zeros(3))}
    return Calibration(cameras, Pinhole(projector, lens, np.zeros(5), eye, there), solved)


class SetClock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.now

    def move(self, **by: float) -> None:
        """Move the clock on by a timedelta's arguments."""
        self.now += timedelta(**by)


def reconstruction(folder: Path, plan: ReconstructionPlan = ReconstructionPlan()) -> Task:  # noqa: B008 - frozen
    """The second part of a scan whose bundle lies in a folder, as the worker is given it."""
    run = JobRun(uuid4(), folder, None)
    return job_task(ScanJob(ScanPlan(reconstruction=plan)), run)


def never(*given: Any, **options: Any) -> Any:
    raise AssertionError(given, options)


class TameCamera:
    """A camera that is never exposed: the fake capture reads none."""

    arm = trigger = disarm = staticmethod(never)

    def __init__(self) -> None:
        self.closed = False
        self.close_error: Exception | None = None
        self.info = CameraInfo(
            name="cam0",
            model="tame",
            serial="1",
            format=CameraFormat(Size(64, 48), 8),
            triggers=frozenset({Trigger.SOFTWARE}),
            exposure_range_s=(0.001, 1.0),
            gain_range=(1.0, 1.0),
        )

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return AppliedSettings(settings.exposure_s, settings.gain)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        raise AssertionError((after_ns, timeout_s))

    def close(self) -> None:
        self.closed = True
        if self.close_error is not None:
            raise self.close_error


class TameProjector:
    """A projector that remembers whether it is dark."""

    load = play = staticmethod(never)

    def __init__(self) -> None:
        self.dark = True
        self.closed = False
        self.blank_error: Exception | None = None
        self.info = ProjectorInfo("projector", "tame", "2", Size(64, 40), plays=False, latency_s=0.0)

    def show(self, index: int) -> DisplayedPattern:
        self.dark = False
        return DisplayedPattern(index, 0, 0)

    def stop(self) -> None:
        self.dark = True

    def blank(self) -> None:
        if self.blank_error is not None:
            raise self.blank_error
        self.dark = True

    def close(self) -> None:
        self.dark = self.closed = True


class TamePositioner:
    """Stands where it was sent."""

    def __init__(self, poses: Sequence[str], moves: list[int] | None = None) -> None:
        self.poses = poses
        self.moves: list[int] = [] if moves is None else moves

    def move(self, index: int) -> None:
        self.moves.append(index)

    def close(self) -> None:
        """Nothing to close."""


class TameRecording:
    """A bundle that was written while it was captured. `error` is raised in place of its end."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.discarded = 0

    def finish(self) -> None:
        if self.error is not None:
            raise self.error

    def discard(self) -> None:
        self.discarded += 1


class TameBench:
    """Opens rigs, and captures with them as told. captured : the rig, the plan and the health of each capture.

    `order` is what the fake reconstruction will read; `error` is raised in place of the next capture. While `gate`
    is clear a capture holds the rig, with its light on; `began` is set when one does. A `deaf` capture hears no cancel.
    `opened_again` is set when the rig was opened for the second time.
    """

    def __init__(self) -> None:
        self.order = "finish"
        self.calibration: Calibration | None = tame_calibration()
        self.recording = TameRecording()
        self.error: Exception | None = None
        self.open_error: Exception | None = None
        self.deaf = False
        self.opened_again = threading.Event()
        self.began = threading.Event()
        self.gate = threading.Event()
        self.gate.set()
        self.opened: list[tuple[TameCamera, TameProjector]] = []
        self.captured: list[tuple[Rig, ScanPlan, Mapping[str, Any] | None]] = []

    def captures(self) -> AbstractContextManager[None]:
        """Have every kind of job capture by `capture` within the block."""
        modules = ("scan.job", "calibrate.job", "calibrate.verification", "accept.job")
        functions: dict[str, Callable[..., Any]] = {f"{module}.capture_frames": self.capture for module in modules}
        functions["doctor.job.examine"] = self.examine
        functions["doctor.job.discover_devices"] = lambda: DiscoveredDevices((), (), ())
        return stand_ins(functions)

    def examine(self, rig: Rig, listener: Listener, /, **_: Any) -> Diagnosis:
        """An examination that finds nothing but its rig."""
        rig.projector.show(0)
        self.began.set()
        while not self.gate.wait(0.01):
            listener.step("light", 0.5, "")
        if self.error is not None:
            error, self.error = self.error, None
            raise error
        return Diagnosis(rig.name, (), {}, None, None, 60.0, None, ())

    def open_rig(self) -> Rig:
        if self.open_error is not None:
            raise self.open_error
        camera, projector = TameCamera(), TameProjector()
        self.opened.append((camera, projector))
        if len(self.opened) > 1:
            self.opened_again.set()
        return Rig("bench", {"cam0": camera}, projector, {"cam0": CameraSettings(0.01)}, self.calibration)

    def capture(
        self,
        rig: Rig,
        plan: ScanPlan,
        folder: Path,
        listener: Listener,
        /,
        *,
        frames: FrameSink | None = None,
        health: Mapping[str, Any] | None = None,
        may_lose: bool = False,  # noqa: ARG002 - of the contract
    ) -> Recording:
        rig.projector.show(0)
        self.captured.append((rig, plan, health))
        if frames is not None:
            frames.begin(OUTLINE, CALIBRATION)
            frames.take(SHOTS[0])
        listener.report("capture", 0.0, "frame 1 of 2")
        self.began.set()
        while not self.gate.wait(0.01):
            if listener.cancelled() and not self.deaf:
                message = "The scan was cancelled."
                raise ScanCancelledError(message)
        if self.error is not None:
            error, self.error = self.error, None
            raise error
        patterns: tuple[Pattern, ...] = (White(), Black())
        if plan.patterns.codes:
            patterns += (Gray(Axis.COLUMN, 0, 6),)
        image = np.zeros((48, 64), dtype=np.uint8)
        shots = tuple(Shot(index, "cam0", image) for index in range(len(patterns)))
        write_bundle(folder, Capture(OUTLINE.projector, patterns, OUTLINE.cameras, shots), rig.calibration)
        (folder / "order").write_text(self.order)
        if frames is not None:
            frames.take(SHOTS[1])
            frames.end(EVIDENCE)
        listener.report("capture", 1.0, "frame 2 of 2")
        return self.recording

"""The process that decodes live depth: frames come through shared memory, newest first, and messages go back.

It is apart from the worker of jobs, so that a reconstruction under way does not hold up the picture.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
import time
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.failure import JobFailure, job_failure
from slrig.live.plan import LivePlan
from slrig.model import Calibration, CameraFormat, Pixels, Region

_SERVER = "slrig.live.server"

PLACES = 8
"""Frames that shared memory holds: those of the last tenths of a second. Later ones replace the earliest. After the
number of the frame in each place comes that of the last frame that was taken."""

_MOST_BEHIND = 8 * PLACES
"""Messages that wait in the pipe: a process that is stopped, or still compiles, must not fill it."""


@dataclass(frozen=True, slots=True)
class LiveTask:
    """What to decode. camera : its name in the calibration. step : at least, pixels from ray to ray along rows and
    columns. region : what of the scene; None for all.
    """

    plan: LivePlan
    calibration: Calibration
    camera: str
    format: CameraFormat
    step: int = 1
    region: Region | None = None


@dataclass(frozen=True, slots=True)
class FrameCame:
    """Parent to child: a frame lies in shared memory. number : counts them; its place is the rest of a division.
    came_s : when, by `time.monotonic`.
    """

    number: int
    pattern: int
    begin_s: float
    end_s: float
    came_s: float


@dataclass(frozen=True, slots=True)
class PlayBegan:
    """Parent to child: frames come again, after something else held the rig."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Parent to child: which steps, in pixels of the camera, viewers watch."""

    steps: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class DepthCame:
    """Child to parent: one depth image for each step that is watched. facts : what `depth_facts` found."""

    number: int
    messages: dict[int, bytes]
    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class NoDepth:
    """Child to parent: frames come, and make no depth image for now. cause : in words."""

    cause: str


@dataclass(frozen=True, slots=True)
class GeometryCame:
    """Child to parent: the first message for those who watch a step."""

    messages: dict[int, bytes]


@dataclass(frozen=True, slots=True)
class LiveFailed:
    """Child to parent: it cannot go on. trace : for the log."""

    fault: JobFailure
    trace: str


class LiveProcess:
    """The process, from the side of the service. `put` is for the thread that owns the rig, the rest for any."""

    def __init__(self, task: LiveTask) -> None:
        spawning = multiprocessing.get_context("spawn")
        sample = np.dtype(np.uint8 if task.format.full_scale <= 255 else np.uint16)
        shape = (PLACES, *task.format.size.shape)
        self._memory = RawArray("B", int(np.prod(shape)) * sample.itemsize)
        self._numbers = RawArray("q", PLACES + 1)
        self._frames: NDArray[Any] = np.frombuffer(self._memory, sample).reshape(shape)
        self.messages, far = spawning.Pipe()
        self._sending = threading.Lock()
        self._number = 0
        self._process: BaseProcess = spawning.Process(
            target=serve_live, args=(far, task, self._memory, self._numbers, sample.str), name="slrig-live", daemon=True
        )
        self._process.start()
        far.close()

    @property
    def behind(self) -> int:
        """How many of the frames that were handed over have not been looked at."""
        return self._number - int(self._numbers[PLACES])

    def put(self, pattern: int, image: Pixels, begin_s: float, end_s: float) -> None:
        """Hand over a frame. Returns at once. Where many wait, because the process stands still, it is dropped."""
        if self.behind >= _MOST_BEHIND:
            return
        self._number += 1
        place = self._number % PLACES
        self._numbers[place] = -1
        self._frames[place] = image
        self._numbers[place] = self._number
        self._send(FrameCame(self._number, pattern, begin_s, end_s, time.monotonic()))

    def begin(self) -> None:
        """Say that frames come again after a pause."""
        self._send(PlayBegan())

    def want(self, steps: tuple[int, ...]) -> None:
        """Have depth images made for these steps, and no others."""
        self._send(Wanted(steps))

    def close(self) -> None:
        """End the process. Idempotent."""
        self._process.kill()
        self._process.join()

    def _send(self, message: object) -> None:
        # A process that is gone is noticed by who reads its messages.
        with self._sending, contextlib.suppress(OSError):
            self.messages.send(message)


def serve_live(pipe: Connection, task: LiveTask, memory: Any, numbers: Any, sample: str) -> None:
    """The child's life, until the parent's end of the pipe is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):  # not on Windows
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        # Where memory runs out the kernel ends this process, and not the service.
        Path("/proc/self/oom_score_adj").write_text("600")
    frames = np.frombuffer(memory, np.dtype(sample)).reshape(PLACES, *task.format.size.shape)
    try:
        # By its name, because the service loads no mathematics.
        importlib.import_module(_SERVER).LiveServer(pipe, task, frames, numbers).run()
    except (EOFError, ConnectionError):
        return
    except Exception as error:  # noqa: BLE001 - the parent is told, and ends the live depth by it
        with contextlib.suppress(OSError):
            pipe.send(LiveFailed(job_failure(error), traceback.format_exc()))
    finally:
        # No thread of a kernel holds the process up.
        os._exit(0)

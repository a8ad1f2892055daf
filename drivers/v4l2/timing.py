"""Exposure times of frames, from the time stamps of their buffers.

A stamp marks one instant of a frame, and devices differ in which. So the interval returned holds the whole exposure of
every row in each case, and its width is stated as error:

- stamp of the start of exposure: taken at the start, or (most webcams) when the first packet came, after the first
  row's exposure had ended. The exposure began one exposure before the stamp at the earliest; the last row of a rolling
  shutter ended a read-out and an exposure after it at the latest.
- stamp of the end of the frame: the last row had arrived. The first row's exposure began one read-out and one exposure
  before; the last row's ended before the stamp.
- no stamp, or one of another clock: the frame was written into its buffer after that had been queued, and before it
  was dequeued.

Sources: kernel documentation of `V4L2_BUF_FLAG_TSTAMP_SRC_SOE` and `_EOF`, and of `VIDIOC_QBUF`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

OTHER_CLOCK_NS = 1_000_000_000
"""A stamp that is off by more is of another clock. uvcvideo can be set to stamp by CLOCK_REALTIME, and still declares
CLOCK_MONOTONIC."""


class StampSource(StrEnum):
    """The instant of a frame that a buffer's time stamp marks."""

    EXPOSURE_START = "start of exposure"
    FRAME_END = "end of frame"
    NONE = "nothing"


@dataclass(frozen=True, slots=True)
class SensorDurations:
    """Durations of a sensor, ns. readout_ns : from the first row to the last. delay_ns : delay of its time stamps."""

    exposure_ns: int
    readout_ns: int
    delay_ns: int = 0


@dataclass(frozen=True, slots=True)
class BufferStamp:
    """A buffer's time stamp, and when it was queued and dequeued, ns, CLOCK_MONOTONIC."""

    source: StampSource
    stamp_ns: int
    queued_ns: int
    dequeued_ns: int


@dataclass(frozen=True, slots=True)
class ExposureInterval:
    """All rows were exposed between `earliest_ns` and `latest_ns`."""

    earliest_ns: int
    latest_ns: int

    def centred_exposure(self, exposure_ns: int) -> tuple[int, int, int]:
        """Return start, end and error of an exposure of this length in the middle of the interval.

        >>> ExposureInterval(100, 160).centred_exposure(20)
        (120, 140, 20)
        """
        spare_ns = max(self.latest_ns - self.earliest_ns - exposure_ns, 0)
        error_ns = (spare_ns + 1) // 2
        start_ns = self.earliest_ns + error_ns
        return start_ns, start_ns + exposure_ns, error_ns


def is_monotonic_stamp(stamp: BufferStamp, durations: SensorDurations) -> bool:
    """True if a stamp can be an instant of its frame by CLOCK_MONOTONIC."""
    min_ns = stamp.queued_ns - durations.readout_ns - durations.exposure_ns - OTHER_CLOCK_NS
    return min_ns <= stamp.stamp_ns <= stamp.dequeued_ns + OTHER_CLOCK_NS


def exposure_interval(stamp: BufferStamp, durations: SensorDurations) -> ExposureInterval:
    """Return the interval in which every row was exposed; see the module's docstring."""
    before_ns = durations.exposure_ns + durations.delay_ns
    source = stamp.source if is_monotonic_stamp(stamp, durations) else StampSource.NONE
    match source:
        case StampSource.EXPOSURE_START:
            latest_ns = stamp.stamp_ns + durations.readout_ns + durations.exposure_ns
            return ExposureInterval(stamp.stamp_ns - before_ns, latest_ns)
        case StampSource.FRAME_END:
            return ExposureInterval(stamp.stamp_ns - durations.readout_ns - before_ns, stamp.stamp_ns)
        case StampSource.NONE:
            return ExposureInterval(stamp.queued_ns - durations.readout_ns - before_ns, stamp.dequeued_ns)

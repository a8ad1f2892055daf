"""When a frame was exposed, from what the driver says of its buffer.

A stamp names one instant of a frame; which one, devices get wrong. So an interval is claimed that holds the whole
exposure of every row whatever the device meant, and its width is told as an error:

- stamp of the start of exposure: taken at the start, or (most webcams) when the first packet came, which is when the
  first row's exposure had ended. The exposure began one exposure before the stamp at the earliest; the last row of a
  rolling shutter ended a read-out and an exposure after it at the latest.
- stamp of the end of the frame: the last row had arrived. The first row's exposure began one read-out and one exposure
  before; the last row's ended before the stamp.
- no stamp, or one of another clock: the frame was written into its buffer after that had been queued, and before it
  was taken.

Sources: kernel documentation of `V4L2_BUF_FLAG_TSTAMP_SRC_SOE` and `_EOF`, and of `VIDIOC_QBUF`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

OTHER_CLOCK_NS = 1_000_000_000
"""A stamp that is off by so much is none. uvcvideo, for one, stamps by CLOCK_REALTIME if its module is told to, and
declares CLOCK_MONOTONIC all the same."""


class StampSource(StrEnum):
    """What a buffer's time stamp names."""

    EXPOSURE_START = "start of exposure"
    FRAME_END = "end of frame"
    NONE = "nothing"


@dataclass(frozen=True, slots=True)
class SensorDurations:
    """What is known of the sensor, ns. `readout_ns` from the first row to the last; `delay_ns`: stamps come so late."""

    exposure_ns: int
    readout_ns: int
    delay_ns: int = 0


@dataclass(frozen=True, slots=True)
class BufferStamp:
    """What the driver said of one buffer, ns, CLOCK_MONOTONIC: its stamp, and when it was queued and taken."""

    source: StampSource
    stamp_ns: int
    queued_ns: int
    taken_ns: int


@dataclass(frozen=True, slots=True)
class ExposureInterval:
    """All rows were exposed between `earliest_ns` and `latest_ns`."""

    earliest_ns: int
    latest_ns: int

    def centred_exposure(self, exposure_ns: int) -> tuple[int, int, int]:
        """Start, end and error of an exposure of this length in the middle: both ends are right within the error.

        >>> ExposureInterval(100, 160).centred_exposure(20)
        (120, 140, 20)
        """
        spare_ns = max(self.latest_ns - self.earliest_ns - exposure_ns, 0)
        error_ns = (spare_ns + 1) // 2
        start_ns = self.earliest_ns + error_ns
        return start_ns, start_ns + exposure_ns, error_ns


def is_monotonic_stamp(stamp: BufferStamp, durations: SensorDurations) -> bool:
    """Whether a stamp can be an instant of its frame: a clock other than CLOCK_MONOTONIC gives itself away."""
    least_ns = stamp.queued_ns - durations.readout_ns - durations.exposure_ns - OTHER_CLOCK_NS
    return least_ns <= stamp.stamp_ns <= stamp.taken_ns + OTHER_CLOCK_NS


def exposure_interval(stamp: BufferStamp, durations: SensorDurations) -> ExposureInterval:
    """Return the interval in which every row was exposed, whatever the device meant by its stamp."""
    before_ns = durations.exposure_ns + durations.delay_ns
    source = stamp.source if is_monotonic_stamp(stamp, durations) else StampSource.NONE
    match source:
        case StampSource.EXPOSURE_START:
            latest_ns = stamp.stamp_ns + durations.readout_ns + durations.exposure_ns
            return ExposureInterval(stamp.stamp_ns - before_ns, latest_ns)
        case StampSource.FRAME_END:
            return ExposureInterval(stamp.stamp_ns - durations.readout_ns - before_ns, stamp.stamp_ns)
        case StampSource.NONE:
            return ExposureInterval(stamp.queued_ns - durations.readout_ns - before_ns, stamp.taken_ns)

"""The interval that is claimed holds the exposure of every row, whatever kind of camera stamped the frame."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.v4l2.timing import Durations, Exposure, Stamp, StampSource, exposure_of, of_this_clock

MS = 1_000_000


@pytest.mark.parametrize("meant", ["start", "first packet", "end", "none"])
def test_the_claim_holds_the_exposure_whatever_the_stamp_meant(meant: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(2000):
        period, exposure_ns = sorted(rng.integers(1, 40 * MS, 2), reverse=True)
        # From first to last row; the last row's bytes arrive when it has been exposed, or later.
        skew_ns = int(rng.integers(0, period))
        start_ns = 10**12 + int(rng.integers(0, 10**9))
        end_ns = start_ns + int(exposure_ns) + skew_ns
        arrived_ns = end_ns + int(rng.integers(0, period - skew_ns + 1))
        late_ns = int(rng.integers(0, 5 * MS))
        stamp_ns, source = {
            "start": (start_ns, StampSource.EXPOSURE_START),
            "first packet": (start_ns + int(exposure_ns), StampSource.EXPOSURE_START),
            "end": (arrived_ns, StampSource.FRAME_END),
            "none": (0, StampSource.NONE),
        }[meant]
        queued_ns = start_ns + int(exposure_ns) - int(rng.integers(0, 100 * MS))
        taken_ns = arrived_ns + late_ns
        durations = Durations(int(exposure_ns), int(period))
        claim = exposure_of(Stamp(source, stamp_ns, queued_ns, taken_ns), durations)
        assert claim.earliest_ns <= start_ns
        assert claim.latest_ns >= end_ns
        begin_ns, finish_ns, error_ns = claim.centred(int(exposure_ns))
        assert finish_ns - begin_ns == exposure_ns
        assert begin_ns - error_ns >= claim.earliest_ns - 1
        assert begin_ns - error_ns <= claim.earliest_ns
        assert finish_ns + error_ns >= claim.latest_ns


def test_a_camera_that_stamps_late_is_believed_less() -> None:
    stamp = Stamp(StampSource.EXPOSURE_START, 10**12, 10**12 - 80 * MS, 10**12 + 30 * MS)
    prompt = exposure_of(stamp, Durations(10 * MS, 20 * MS))
    late = exposure_of(stamp, Durations(10 * MS, 20 * MS, 7 * MS))
    assert prompt == Exposure(10**12 - 10 * MS, 10**12 + 30 * MS)
    assert late.earliest_ns == prompt.earliest_ns - 7 * MS


@pytest.mark.parametrize("offset_ns", [1_700_000_000 * 10**9, -(10**12), 2 * 10**9])
def test_a_stamp_of_another_clock_is_no_stamp(offset_ns: int) -> None:
    now_ns = 2 * 10**12
    stamp = Stamp(StampSource.EXPOSURE_START, now_ns + offset_ns, now_ns - 100 * MS, now_ns)
    durations = Durations(10 * MS, 20 * MS)
    assert not of_this_clock(stamp, durations)
    assert exposure_of(stamp, durations) == Exposure(now_ns - 130 * MS, now_ns)

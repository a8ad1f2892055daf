"""How much earlier than its light a pattern may be asked for."""

from __future__ import annotations

import numpy as np

from slrig.capture.streaming import _Lead

REFRESH_NS = 16_666_667
DELAY_NS = 46_800_000
"""From the refresh that takes a picture to its light."""


def test_one_pattern_tells_a_displays_lead_wherever_in_its_refresh_it_was_asked_for() -> None:
    for asked_ns in np.linspace(0, REFRESH_NS, 7).astype(int).tolist():
        lead = _Lead(REFRESH_NS)
        assert lead.ns == 0
        lead.note(asked_ns, REFRESH_NS, REFRESH_NS + DELAY_NS)
        assert lead.ns == DELAY_NS


def test_a_thread_that_wakes_late_makes_the_lead_shorter_until_one_wakes_in_time() -> None:
    lead = _Lead(REFRESH_NS)
    lead.note(10_000_000, REFRESH_NS + 4_000_000, REFRESH_NS + DELAY_NS)
    assert lead.ns == DELAY_NS - 4_000_000
    lead.note(12_000_000, REFRESH_NS + 100_000, REFRESH_NS + DELAY_NS)
    assert lead.ns == DELAY_NS - 100_000
    # As late as several refreshes: no more than one of them was waited for.
    late = _Lead(REFRESH_NS)
    late.note(0, 5 * REFRESH_NS, REFRESH_NS + DELAY_NS)
    assert late.ns == DELAY_NS


def test_a_projector_without_refreshes_is_asked_by_the_shortest_lead_it_had() -> None:
    lead = _Lead(0)
    for asked_ns, begins_ns in ((0, 9_000_000), (0, 5_000_000), (0, 7_000_000)):
        lead.note(asked_ns, begins_ns - 1, begins_ns)
    assert lead.ns == 5_000_000
    lead.note(3_000_000, 3_500_000, 2_000_000)  # its light may be there before it returns
    assert lead.ns == 0

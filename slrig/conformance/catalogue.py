"""Every check, in the order in which a rig is examined: what is declared first, whole sequences last."""

from __future__ import annotations

from slrig.conformance import declared, frames, freshness, sequences, settings, shutdown, states
from slrig.conformance.check import Check

CHECKS: tuple[Check, ...] = (
    *declared.CHECKS,
    *states.CHECKS,
    *settings.CHECKS,
    *frames.CHECKS,
    *freshness.CHECKS,
    *sequences.CHECKS,
    *shutdown.CHECKS,
)

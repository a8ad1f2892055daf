"""Checks of the driver contract for cameras, projectors and positioners, and a scored report of a rig.

`slrig conform RIG` runs them on a rig; tests of a driver call `run_checks`, or `ConformanceRun.run_check` for each.
"""

from slrig.conformance.bench import Check, Failure
from slrig.conformance.job import ConformanceJob
from slrig.conformance.running import CHECKS, CheckOutcome, CheckResult, ConformanceReport, ConformanceRun, run_checks

__all__ = [
    "CHECKS",
    "Check",
    "CheckOutcome",
    "CheckResult",
    "ConformanceJob",
    "ConformanceReport",
    "ConformanceRun",
    "Failure",
    "run_checks",
]

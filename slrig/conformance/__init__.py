"""The contract of cameras and projectors, as checks that hold for every driver, and a scored report of a rig.

`slrig conform RIG` runs them on a rig; a driver's own tests call `run`, or `Examination.judge` check by check.
"""

from slrig.conformance.bench import Check, Failure
from slrig.conformance.running import CHECKS, Examination, Outcome, Progress, Report, Result, run

__all__ = ["CHECKS", "Check", "Examination", "Failure", "Outcome", "Progress", "Report", "Result", "run"]

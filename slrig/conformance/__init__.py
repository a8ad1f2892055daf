"""The contract of cameras and projectors, as checks that hold for every driver, and a scored report of a rig.

`slrig conform RIG` runs them on a rig; a driver's own tests call `run`, or `Examination.judge` check by check.
"""

from slrig.conformance.catalogue import CHECKS
from slrig.conformance.check import Check
from slrig.conformance.expectation import Failure
from slrig.conformance.report import Outcome, Report, Result
from slrig.conformance.running import Examination, Progress, run

__all__ = ["CHECKS", "Check", "Examination", "Failure", "Outcome", "Progress", "Report", "Result", "run"]

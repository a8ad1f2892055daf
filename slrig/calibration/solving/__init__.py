"""Solve a calibration from observations of a board."""

from slrig.calibration.solving.solve import solve

__all__ = ["solve"]

"""Calibration sessions: capturing and judging poses, solving, storing calibrations."""

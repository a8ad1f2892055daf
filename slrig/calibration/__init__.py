"""Calibration: boards, what a pose of one tells, the solve, and how far the result may be trusted. Mathematics only."""

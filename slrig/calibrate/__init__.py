"""Calibration sessions: poses shot, read and judged, solves, and what is kept of them."""

"""Solve a calibration from observations of a board."""

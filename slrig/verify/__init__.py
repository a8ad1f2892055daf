"""Verifications of a calibration, and their history."""

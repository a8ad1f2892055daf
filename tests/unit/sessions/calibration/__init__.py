"""Tests of slrig.sessions.calibration."""

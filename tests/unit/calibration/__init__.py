"""Tests of slrig.calibration."""

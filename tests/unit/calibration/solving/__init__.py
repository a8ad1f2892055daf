"""Tests of slrig.calibration.solving."""

"""Tests of slrig.calibration.detection."""

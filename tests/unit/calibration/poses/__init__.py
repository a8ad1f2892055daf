"""Tests of slrig.calibration.poses."""

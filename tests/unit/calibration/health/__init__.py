"""Tests of slrig.calibration.health."""

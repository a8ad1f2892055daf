"""Tests of slrig.calibration.judging."""

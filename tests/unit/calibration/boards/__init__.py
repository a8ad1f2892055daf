"""Tests of slrig.calibration.boards."""

"""Tests of slrig.calibrate."""

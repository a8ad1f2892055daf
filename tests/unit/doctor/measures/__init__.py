"""Tests of slrig.doctor.measures."""

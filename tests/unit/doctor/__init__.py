"""Tests of slrig.doctor."""

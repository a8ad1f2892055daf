"""Tests of slrig.combine."""

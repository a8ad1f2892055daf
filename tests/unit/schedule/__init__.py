"""Tests of slrig.schedule."""

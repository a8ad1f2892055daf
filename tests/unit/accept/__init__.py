"""Tests of slrig.accept."""

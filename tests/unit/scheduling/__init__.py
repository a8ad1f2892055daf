"""Tests of slrig.scheduling."""

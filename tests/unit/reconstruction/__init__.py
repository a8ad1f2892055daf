"""Tests of slrig.reconstruction."""

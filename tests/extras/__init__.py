"""Tests of `slrig.extras`."""

"""Tests of slrig.verify."""

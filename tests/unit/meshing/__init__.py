"""Tests of slrig.meshing."""

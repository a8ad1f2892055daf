"""Tests of the figures that the benchmarks print."""

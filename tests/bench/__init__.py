"""Benchmarks, each run by name: they print a table and hold what it has to show."""

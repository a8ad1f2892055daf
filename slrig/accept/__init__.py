"""Acceptance tests: their plan, their run, their evaluation and their report."""

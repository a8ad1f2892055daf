"""Tests of slrig.model_jobs."""

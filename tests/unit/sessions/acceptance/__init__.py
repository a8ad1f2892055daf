"""Tests of slrig.sessions.acceptance."""

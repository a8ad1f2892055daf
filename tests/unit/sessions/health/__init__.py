"""Tests of slrig.sessions.health."""

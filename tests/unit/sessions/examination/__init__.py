"""Tests of slrig.sessions.examination."""

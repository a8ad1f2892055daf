"""Faults, kills and ends of the real service, one after the other."""

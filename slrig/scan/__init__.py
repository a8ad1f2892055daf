"""Scans: plan, acquisition, the steps from frames to files, report, formats."""

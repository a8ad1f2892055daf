"""Boards: how they are printed, and how their corners are found in an image."""

"""Poses of a board: what they cover, which can be used, and which to hold next."""

"""How far a solved calibration may be trusted, and how it compares with another."""

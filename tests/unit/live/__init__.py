"""Live depth."""

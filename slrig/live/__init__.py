"""Live depth: the projector repeats a short sequence, and every new frame gives a new depth image."""

"""What the doctor measures of frames: pure, on arrays."""

"""The HTTP edge, over fakes."""

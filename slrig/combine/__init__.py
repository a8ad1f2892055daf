"""Models: scans from several sides, shot or at hand, made one mesh; their jobs, their report."""

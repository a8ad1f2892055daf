"""Models: scans of one object from several sides, combined into one mesh; their jobs and their report."""

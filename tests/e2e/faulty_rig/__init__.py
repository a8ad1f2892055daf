"""A rig that fails on demand at a named step: its driver runs in the service, and a test decides its faults."""

"""A rig that fails on demand, at a named step: its driver runs inside the service, its faults are told from outside."""

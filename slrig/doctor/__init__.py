"""The examination of a rig: its faults, and the values for a better rig file."""

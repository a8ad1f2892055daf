"""The examination of a rig: what is wrong with it, and the values for a better rig file."""

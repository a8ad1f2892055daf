"""Playing a pattern sequence on a rig and taking the frames that show it."""

"""Does a calibration still hold? What a verification by the board says of a rig that may have changed."""

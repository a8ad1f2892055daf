"""Does a calibration still hold? What a look at the board says of a rig that may have changed."""

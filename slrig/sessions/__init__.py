"""Work with a rig that is more than one scan: examinations that say what is wrong with it, and what to do."""

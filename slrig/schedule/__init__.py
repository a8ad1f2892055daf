"""Work for the rig at times that a person set: which runs are due, which were done, and what became of the others."""

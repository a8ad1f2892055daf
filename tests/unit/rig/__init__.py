"""Records, data folder, runner and worker."""

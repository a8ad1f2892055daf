"""Work on the rig and in the worker: jobs, their queue, their records and their files."""

"""What people use today, run beside our own method on the same frames, each in a process of its own.

`measuring` has seconds and memory, `worker` is the process, `catalogue` names the methods, `figures` scores their
meshes alike, `table` shows them. The peers themselves: `gray`, `meshers`; our own is `ours`.
"""

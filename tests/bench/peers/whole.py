"""What a person would run without slrig, as one process from the frames on disk to a mesh on disk.

    python -m tests.bench.peers.whole METHOD BUNDLE POINTS OUTPUT

METHOD is `gray_arrays` or `ball_pivoting`: the latter takes our points, and adds a decoding of its own to the time, as
one who has no slrig would have to.
"""

from __future__ import annotations

import sys
from pathlib import Path

import trimesh

from tests.bench.peers.gray import columns_by_arrays, gray_mesh, triangulated_mm
from tests.bench.peers.measuring import Meter
from tests.bench.peers.meshers import ball_pivoting
from tests.bench.peers.scene import read_cloud, read_gray_frames


def main(method: str, bundle: str, points_file: str, output: str) -> None:
    """Make the mesh, and write it."""
    frames = read_gray_frames(Path(bundle))
    if method == "gray_arrays":
        mesh = gray_mesh(frames, Meter(), decoder=columns_by_arrays)
    else:
        triangulated_mm(columns_by_arrays(frames), frames.camera, frames.projector)
        mesh = ball_pivoting(read_cloud(Path(bundle), Path(points_file)), Meter())
    trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(output)


if __name__ == "__main__":
    main(*sys.argv[1:])

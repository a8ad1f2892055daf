"""The surface net of fields that cross cells in every possible way."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.topology import topology_counts
from slrig.model import FloatArray, IntArray
from slrig.multiview.fusion_grid import Grid, brick_key
from slrig.multiview.fusion_mesh import SurfaceNet, extract_net

# Only models of several views need these kernels.
pytestmark = pytest.mark.slow
BRICKS = 3


def block() -> Grid:
    """3 x 3 x 3 bricks, as `build_grid` numbers them."""
    place = np.argwhere(np.ones((BRICKS,) * 3))
    keys = np.array([brick_key(*each) for each in (place + 1).tolist()])
    around = np.full((len(keys), 27), -1, dtype=np.int32)
    for number, step in enumerate(np.argwhere(np.ones((3, 3, 3))) - 1):
        other = place + step
        inside = ((other >= 0) & (other < BRICKS)).all(axis=1)
        around[inside, number] = (other @ (9, 3, 1))[inside]
    return Grid(np.zeros(3), 0.5, keys, around)


def flat(field: FloatArray) -> FloatArray:
    """A (24, 24, 24) field by cell index."""
    return np.ascontiguousarray(field.reshape(3, 8, 3, 8, 3, 8).transpose(0, 2, 4, 1, 3, 5)).ravel()


def triangles(made: SurfaceNet) -> IntArray:
    return made.quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def fans(faces: IntArray, vertex: int) -> int:
    """Number of fans of triangles at a vertex: triangles that share an edge at it belong to one fan."""
    ends = [set(face) - {vertex} for face in faces[(faces == vertex).any(axis=1)].tolist()]
    count = 0
    while ends:
        fan, count = ends.pop(), count + 1
        while touching := [each for each in ends if each & fan]:
            fan = fan.union(*touching)
            ends = [each for each in ends if each not in touching]
    return count


@pytest.mark.parametrize("density", [0.3, 0.5, 0.8])
def test_a_random_field_gives_a_closed_manifold(density: float) -> None:
    random = np.random.default_rng(0)
    field = random.uniform(0.1, 1, (24, 24, 24)) * np.where(random.uniform(size=(24, 24, 24)) < density, -1, 1)
    # Outside all around: nothing can be open.
    field[[0, -1]] = field[:, [0, -1]] = field[:, :, [0, -1]] = 1.0
    made = extract_net(block(), flat(field))
    counts = topology_counts(triangles(made))
    assert counts.edges > 10_000
    faults = (counts.boundary_edges, counts.nonmanifold_edges, counts.misoriented_edges, counts.duplicate_faces)
    assert faults == (0, 0, 0, 0)
    # Many cells have several vertices, and none is pinched.
    assert len(np.unique(made.cells)) < 0.9 * len(made.cells)
    assert {fans(triangles(made), vertex) for vertex in random.choice(counts.vertices, 200).tolist()} == {1}
    assert (np.diff(made.cells) >= 0).all()


def test_a_ball_has_its_place_and_volume_and_faces_outward() -> None:
    place = 0.5 * np.argwhere(np.ones((24, 24, 24))).reshape(24, 24, 24, 3)
    # The first brick is (1, 1, 1), four millimetres from the origin.
    middle = np.array([6.1, 5.8, 6.3])
    made = extract_net(block(), flat(np.linalg.norm(place - middle, axis=-1) - 4.0))
    faces = triangles(made)
    a, b, c = (made.points_mm[faces[:, k]] - middle - 4.0 for k in range(3))
    counts = topology_counts(faces)
    assert (counts.euler_characteristic, counts.boundary_edges, counts.components) == (2, 0, 1)
    assert np.linalg.norm(made.points_mm - middle - 4.0, axis=1) == pytest.approx(4.0, abs=0.03)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(4 / 3 * np.pi * 4.0**3, rel=0.03)

"""The stages of meshing, one after the other, on a surface with a cliff."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slrig.meshing.facing import Viewpoints, facing_sides
from slrig.meshing.surface import MeshingLimits, SurfaceMesh, build_surface
from slrig.meshing.topology import component_sizes, topology_counts
from slrig.model import FlipRule, FloatArray, IntArray

EYE_MM = np.array([0.0, 0.0, -500.0])


def from_eye(points: FloatArray) -> Viewpoints:
    """Camera and projector stand in one place."""
    camera = np.zeros(len(points), dtype=np.int32)
    return Viewpoints(EYE_MM[None], camera, camera, np.zeros_like(points))


LIMITS = MeshingLimits(
    widest_step_px=1.0,
    depth_edge_ratio=6.0,
    keep_holes=False,
    flip_rule=FlipRule.CONSTRAINED,
    smooth_boundary=True,
)


def jagged_curves(*, curves: int = 60, points: int = 80) -> tuple[FloatArray, IntArray]:
    """Curves running down at unit distance, their ends uneven."""
    random = np.random.default_rng(3)
    parts = []
    for c in range(curves):
        first, last = random.integers(0, 4), points - random.integers(0, 4)
        y = np.arange(first, last) + random.uniform(-0.3, 0.3, last - first)
        z = 0.02 * (c - 30) ** 2 + 0.4 * np.sin(y / 6)
        parts.append(np.stack([np.full(len(y), float(c)), y, z], axis=1))
    offsets = np.cumsum([0, *map(len, parts)]).astype(np.int32)
    return np.concatenate(parts), offsets


def meshed(points: FloatArray, offsets: IntArray, limits: MeshingLimits = LIMITS) -> tuple[SurfaceMesh, list[str]]:
    told: list[str] = []
    made = build_surface(
        points, offsets, np.arange(len(offsets) - 1.0), np.zeros(len(points), dtype=bool), np.ones(len(points)),
        from_eye(points), limits, on_step=told.append,
    )  # fmt: skip
    return made, told


def test_every_stage_is_told_and_counted_in_the_order_of_the_paper() -> None:
    made, told = meshed(*jagged_curves())
    names = [
        "initial meshing",
        "global optimisation",
        "shrinking boundary",
        "smoothing boundary",
        "optimising boundary",
    ]
    assert [stage.name for stage in made.stages] == names
    assert told == [*names, "vertex normals"]
    initial = made.steps["initial"]
    assert made.stages[0].triangles == initial["triangles"]
    assert (initial["strip_triangles"], initial["dropped_triangles"]) == (made.stages[0].triangles, 0)
    # Flips keep the number of triangles and the boundary; the last stage is what is returned.
    assert made.stages[0].triangles == made.stages[1].triangles
    assert made.stages[0].boundary_points == made.stages[1].boundary_points
    assert made.stages[-1].triangles == len(made.faces)
    assert made.stages[-1].boundary_points == topology_counts(made.faces).boundary_vertices


def test_smoothing_leaves_a_shorter_boundary_and_a_sound_mesh() -> None:
    made, _ = meshed(*jagged_curves())
    counts = topology_counts(made.faces)
    assert (counts.nonmanifold_edges, counts.misoriented_edges, counts.duplicate_faces) == (0, 0, 0)
    assert made.stages[-1].boundary_points < made.stages[0].boundary_points
    added = made.steps["boundary"]["added_triangles"]
    assert isinstance(added, int)
    assert added > 0


def test_the_boundary_is_left_alone_when_asked() -> None:
    made, told = meshed(*jagged_curves(), replace(LIMITS, smooth_boundary=False))
    assert [stage.name for stage in made.stages] == ["initial meshing", "global optimisation"]
    assert made.steps.keys() == {"initial", "optimisation", "facing"}
    assert "shrinking boundary" not in told


def test_a_hole_at_a_bridge_stays_open_when_holes_are_kept() -> None:
    points, offsets = jagged_curves()
    bridge = np.zeros(len(points), dtype=bool)
    # One point is missing from four neighbouring curves, and each knows that it was bridged there.
    gaps = [int(offsets[c]) + 40 for c in range(20, 24)]
    bridge[[gap - 1 for gap in gaps]] = True
    keep = np.ones(len(points), dtype=bool)
    keep[gaps] = False
    shorter = (offsets - np.searchsorted(np.array(gaps), offsets)).astype(np.int32)
    holes = {}
    for keep_holes in (True, False):
        made = build_surface(
            points[keep], shorter, np.arange(len(offsets) - 1.0), bridge[keep], np.ones(int(keep.sum())),
            from_eye(points[keep]),
            replace(LIMITS, keep_holes=keep_holes), on_step=lambda _: None,
        )  # fmt: skip
        holes[keep_holes] = 1 - topology_counts(made.faces).euler_characteristic
    assert holes == {True: 1, False: 0}


def test_no_triangle_faces_away_in_the_end() -> None:
    # Deep noise, seen from aside: flips fold some triangles over.
    points, offsets = jagged_curves()
    points[:, 2] += np.random.default_rng(0).normal(0, 0.8, len(points))
    views = replace(from_eye(points), centres_mm=np.array([[-300.0, 40.0, -150.0], EYE_MM]))
    views = replace(views, second=views.second + 1, deviation_mm=np.full_like(points, 5.0))
    made = build_surface(
        points, offsets, np.arange(len(offsets) - 1.0), np.zeros(len(points), dtype=bool), np.ones(len(points)), views,
        LIMITS, on_step=lambda _: None,
    )  # fmt: skip
    dropped = made.steps["facing"]["dropped_triangles"]
    assert isinstance(dropped, int)
    assert dropped > 0
    # What that cuts off is dust.
    assert made.steps["facing"]["dropped_as_dust"] != 0
    assert component_sizes(made.faces, np.ones(len(made.faces), dtype=bool)).min() >= 100
    assert (facing_sides(points, made.faces, views) == 1).all()
    assert made.stages[-1].triangles == len(made.faces)
    assert made.stages[-1].boundary_points == topology_counts(made.faces).boundary_vertices


def test_points_are_renumbered_without_those_that_no_face_uses() -> None:
    points, offsets = jagged_curves()
    made, _ = meshed(points, offsets)
    beside = np.zeros(len(points), dtype=bool)
    beside[made.faces] = True
    less = made.among_points(beside)
    np.testing.assert_array_equal(points[beside][less.faces], points[made.faces])
    np.testing.assert_array_equal(less.normals, made.normals[beside])

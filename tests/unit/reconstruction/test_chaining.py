"""Points linked along the stripe, on lines small enough to draw, and against a plain walk."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import FloatArray
from slrig.reconstruction.stripes import (
    _MAX_STEP_PX,
    _MAX_TURN,
    _SAME_LINE_ANGLE,
    _SAME_LINE_PX,
    chain_points,
)

SHAPE = (60, 80)


class Found(NamedTuple):
    """Line points of an image."""

    points_px: FloatArray
    normals: FloatArray
    strength: FloatArray

    def __add__(self, other: tuple[object, ...]) -> Found:
        assert isinstance(other, Found)
        return Found(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def chained(self, *, strong: NDArray[np.bool_] | None = None) -> list[list[int]]:
        """The chains as lists of indices."""
        may_start = np.ones(len(self.points_px), dtype=np.bool_) if strong is None else strong
        order, offsets = chain_points(self.points_px, self.normals, self.strength, may_start, SHAPE)
        return [order[a:b].tolist() for a, b in pairwise(offsets)]


def line(start: tuple[float, float], end: tuple[float, float], *, strength: float = 1.0) -> Found:
    """One point per pixel that a straight line passes nearest to."""
    a, b = np.array(start), np.array(end)
    steps = math.ceil(np.abs(b - a).max())
    points = a + np.linspace(0, 1, steps + 1)[:, None] * (b - a)
    along = (b - a) / np.linalg.norm(b - a)
    return Found(points, np.tile([along[1], -along[0]], (len(points), 1)), np.full(len(points), strength))


@pytest.mark.parametrize("end", [(40.0, 50.0), (10.3, 50.0), (60.0, 22.0), (50.0, 49.0), (70.0, 10.2), (70.0, 3.0)])
def test_a_straight_line_is_one_chain_from_end_to_end(end: tuple[float, float]) -> None:
    found = line((10.2, 10.3), end)
    chains = found.chained()
    assert len(chains) == 1
    assert chains[0] in (list(range(len(found.points_px))), list(range(len(found.points_px)))[::-1])


DOWN = line((30.0, 5.0), (30.0, 50.0))
LINES: dict[str, tuple[Found, list[list[int]]]] = {
    "two points side by side": (DOWN + line((32.0, 5.0), (32.0, 50.0), strength=0.9), [[*range(46)], [*range(46, 92)]]),
    "a second answer of the same line, 0.6 px beside it": (
        line((30.4, 5.0), (30.4, 50.0), strength=2.0) + line((31.0, 5.0), (31.0, 50.0)), [[*range(46)]],
    ),
    "a gap of a pixel": (Found(*(np.delete(each, 20, axis=0) for each in DOWN)), [[*range(20)], [*range(20, 45)]]),
    "a corner sharper than a stripe turns": (
        line((30.0, 5.0), (30.0, 30.0)) + line((31.0, 30.0), (60.0, 30.0)), [[*range(26)], [*range(26, 56)]],
    ),
    "a line that runs into a stronger one at 45°": (
        line((40.0, 5.0), (40.0, 55.0), strength=2.0) + line((20.0, 10.0), (39.0, 29.0)),
        [[*range(51)], [*range(51, 71)]],
    ),
    "a weaker point in the same pixel": (
        DOWN + Found(np.array([[30.3, 20.0]]), np.array([[1.0, 0.0]]), np.array([0.5])), [[*range(46)]],
    ),
    "a stronger point in the same pixel": (
        DOWN + Found(np.array([[30.3, 20.0]]), np.array([[1.0, 0.0]]), np.array([5.0])),
        [[*range(15), *range(16, 47)]],
    ),
    "no point": (Found(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)), []),
    "lone points": (Found(np.array([[5.0, 5.0], [30.0, 30.0]]), np.array([[1.0, 0.0]] * 2), np.ones(2)), []),
}  # fmt: skip


@pytest.mark.parametrize("name", LINES)
def test_lines_are_chained_as_they_are_drawn(name: str) -> None:
    found, chains = LINES[name]
    assert sorted(sorted(each) for each in found.chained()) == chains


def test_the_order_of_points_and_the_sense_of_their_normals_do_not_matter() -> None:
    found = line((10.2, 10.3), (30.0, 50.0))
    flipped = found._replace(normals=found.normals * np.where(np.arange(len(found.normals)) % 2, 1.0, -1.0)[:, None])
    backwards = Found(*(each[::-1].copy() for each in flipped))
    last = len(found.points_px) - 1
    (one,), (other,) = found.chained(), backwards.chained()
    assert [last - i for i in other] in (one, one[::-1])


def test_a_curve_is_followed() -> None:
    x = np.arange(8.0, 72.0)
    slope = 0.6 * np.cos(x / 8)
    normals = np.stack([-slope, np.ones_like(x)], axis=1) / np.hypot(slope, 1)[:, None]
    found = Found(np.stack([x, 30 + 4.8 * np.sin(x / 8)], axis=1), normals, 1 + 0.2 * np.cos(x))
    chains = found.chained()
    assert [sorted(each) for each in chains] == [list(range(64))]
    assert np.abs(np.diff(chains[0])).max() == 1


def test_at_a_crossing_the_stronger_line_goes_on_and_the_weaker_is_cut() -> None:
    across, down = line((10.0, 30.0), (70.0, 30.0), strength=2.0), line((40.0, 10.0), (40.0, 50.0))
    chains = (across + down).chained()
    assert len(chains) == 3
    assert sorted(chains[0]) == list(range(61))
    for part in chains[1:]:
        assert all(index >= 61 for index in part)
        rows = (across + down).points_px[part, 1]
        assert rows.max() < 30 or rows.min() > 30


def test_chains_start_at_strong_points_only() -> None:
    one, other = line((20.0, 5.0), (20.0, 50.0)), line((50.0, 5.0), (50.0, 50.0))
    strong = np.zeros(92, dtype=np.bool_)
    strong[60] = True
    assert [sorted(each) for each in (one + other).chained(strong=strong)] == [list(range(46, 92))]


def scattered(seed: int) -> Found:
    """Line points at random, dense enough to compete."""
    rng = np.random.default_rng(seed)
    angle = rng.normal(0.2, 0.5, 900)
    return Found(
        rng.uniform([0, 0], [SHAPE[1] - 1, SHAPE[0] - 1], (900, 2)),
        np.stack([np.cos(angle), np.sin(angle)], axis=1),
        rng.uniform(0.2, 1.0, 900),
    )


def walked(found: Found, strong: NDArray[np.bool_]) -> list[list[int]]:
    """The module's docstring, point by point in plain Python."""
    points, normals, strength = found
    at: dict[tuple[int, int], int] = {}
    ranked = sorted(range(len(points)), key=lambda i: (-strength[i], i))
    for i in ranked:
        at.setdefault((round(points[i, 0]), round(points[i, 1])), i)
    pixel = {i: key for key, i in at.items()}
    used: set[int] = set()

    def turning(a: int, b: int) -> float:
        return math.acos(min(1.0, abs(float(normals[a] @ normals[b]))))

    def neighbour(i: int, heading: FloatArray, eighths: int) -> int | None:
        octant = (round(math.atan2(heading[1], heading[0]) / (math.pi / 4)) + eighths) % 8
        dx, dy = round(math.cos(octant * math.pi / 4)), round(math.sin(octant * math.pi / 4))
        other = at.get((pixel[i][0] + dx, pixel[i][1] + dy))
        return None if other is None or other in used else other

    def trace(start: int, heading: FloatArray) -> list[int]:
        current = start
        path: list[int] = []
        while True:
            for side in (2, -2):
                other = neighbour(current, heading, side)
                if other is None:
                    continue
                apart = abs(float((points[other] - points[current]) @ normals[current]))
                if apart < _SAME_LINE_PX and turning(current, other) < _SAME_LINE_ANGLE:
                    used.add(other)
            choices = []
            for rank, turn in enumerate((0, -1, 1)):
                other = neighbour(current, heading, turn)
                if other is None:
                    continue
                step = points[other] - points[current]
                length, angle = float(np.hypot(*step)), turning(current, other)
                if length <= _MAX_STEP_PX and angle <= _MAX_TURN and float(step @ heading) > 0:
                    choices.append((length + angle, rank, other))
            if not choices:
                return path
            current = min(choices)[2]
            used.add(current)
            path.append(current)
            tangent = np.array([-normals[current, 1], normals[current, 0]])
            heading = tangent if float(tangent @ heading) >= 0 else -tangent

    chains = []
    for start in ranked:
        if start in used or not strong[start] or start not in pixel:
            continue
        used.add(start)
        tangent = np.array([-normals[start, 1], normals[start, 0]])
        ahead = trace(start, tangent)
        whole = [*trace(start, -tangent)[::-1], start, *ahead]
        if len(whole) > 1:
            chains.append(whole)
    return chains


@pytest.mark.parametrize("seed", range(4))
def test_chains_are_those_of_a_plain_walk(seed: int) -> None:
    found = scattered(seed)
    strong = np.asarray(found.strength > 0.5)
    wanted = walked(found, strong)
    assert found.chained(strong=strong) == wanted
    assert len(wanted) > 20
    assert max(len(each) for each in wanted) > 4

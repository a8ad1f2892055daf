"""Smoothing a boundary in plain Python: a dictionary of directed edges, no adjacency, no numbering of half-edges."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from slrig.model import FloatArray, IntArray

Face = tuple[int, int, int]
Edge = tuple[int, int]


def turned(a: int, b: int, c: int) -> Face:
    """The same face, its lowest vertex first."""
    return min((a, b, c), (b, c, a), (c, a, b))


def as_set(faces: IntArray) -> set[Face]:
    """The faces whatever their order and first corner."""
    return {turned(*face) for face in faces.tolist()}


@dataclass
class ByHand:
    """A mesh as its directed edges, each with the third vertex of its face, and what became of it."""

    points: FloatArray
    allowed: FloatArray
    third: dict[Edge, int]
    added: set[Face] = field(default_factory=set)
    stays: set[int] = field(default_factory=set)
    rounds: int = 0
    refusals: Counter[str] = field(default_factory=Counter)

    @property
    def faces(self) -> set[Face]:
        return {turned(a, b, c) for (a, b), c in self.third.items()}

    def fan(self, into: Edge) -> list[int]:
        """Vertices round the head of a boundary half-edge, from its tail to the next vertex of the boundary."""
        vertex = into[1]
        around = [into[0], self.third[into]]
        while (around[-1], vertex) in self.third:
            around.append(self.third[around[-1], vertex])
        return around

    def out_of(self, into: Edge) -> Edge:
        return into[1], self.fan(into)[-1]

    def into_tail(self, out: Edge) -> Edge:
        vertex, other = out[0], self.third[out]
        while (vertex, other) in self.third:
            other = self.third[vertex, other]
        return other, vertex

    def is_boundary(self, edge: Edge) -> bool:
        return edge in self.third and edge[::-1] not in self.third

    def boundary_vertices(self) -> set[int]:
        return {v for edge in self.third if edge[::-1] not in self.third for v in edge}

    def normal(self, a: int, b: int, c: int) -> FloatArray:
        n = np.cross(self.points[b] - self.points[a], self.points[c] - self.points[a])
        return np.asarray(n / np.linalg.norm(n))

    def cosine(self, a: int, b: int, c: int) -> float:
        u, v = self.points[a] - self.points[b], self.points[c] - self.points[b]
        return float(u @ v / np.linalg.norm(u) / np.linalg.norm(v))

    def is_notch(self, into: Edge) -> bool:
        a, b = into
        around = self.fan(into)
        mean = np.sum([self.normal(b, q, p) for p, q in pairwise(around)], axis=0)
        return bool(np.cross(self.points[around[-1]] - self.points[b], self.points[a] - self.points[b]) @ mean < 0)

    def other_fans(self, vertex: int, into: Edge) -> bool:
        return sum(vertex in edge for edge in self.third) / 2 > len(self.fan(into)) - 1

    def why_not_add(self, into: Edge) -> str | None:
        (a, b), out = into, self.out_of(into)
        c = out[1]
        sides = [float(np.linalg.norm(self.points[u] - self.points[v])) for u, v in ((a, b), (b, c), (c, a))]
        if max(sides) > self.allowed[[a, b, c]].mean():
            return "long"
        angles = [math.degrees(math.acos(self.cosine(*k))) for k in ((a, b, c), (b, c, a), (c, a, b))]
        if min(angles) < 10:
            return "sliver"
        normal = self.normal(c, b, a)
        closes = self.out_of(out)[1] == a and self.is_boundary((c, a))
        beside = [into, out, (c, a)] if closes else [into, out]
        if min(float(self.normal(*edge, self.third[edge]) @ normal) for edge in beside) < 0.5:
            return "fold"
        if closes:
            return None
        if (a, c) in self.third or (c, a) in self.third:
            return "edge"
        if self.other_fans(c, out) and self.other_fans(a, self.into_tail(into)):
            return "edge"
        ahead, behind = out, into
        for _ in range(4):
            ahead, behind = self.out_of(ahead), self.into_tail(behind)
            for p in {ahead[1], behind[0]} - {a, b, c}:
                inward = [
                    np.cross(self.points[v] - self.points[u], self.points[p] - self.points[u]) @ normal
                    for u, v in ((c, b), (b, a), (a, c))
                ]
                if min(inward) >= 0:
                    return "inside"
        return None

    def why_not_remove(self, into: Edge) -> str | None:
        b = into[1]
        around = self.fan(into)
        if b in self.stays:
            return "beside"
        if len(around) - 1 > 6:
            return "large"
        border = self.boundary_vertices()
        beyond = {self.into_tail(into)[0], self.out_of(self.out_of(into))[1]} if len(around) > 2 else set()
        for p, q in pairwise(around):
            # Face (b, q, p): behind it lies the face that runs from p to q.
            if (p, q) not in self.third or (self.third[p, q] in border and self.third[p, q] not in beyond):
                return "post"
        return "post" if border & set(around[1:-1]) else None

    def put(self, a: int, b: int, c: int) -> None:
        self.third |= {(a, b): c, (b, c): a, (c, a): b}

    def handle(self, into: Edge) -> list[Edge]:
        """Do what the rules say at one corner; the half-edges into the corners that this has changed."""
        a, b = into
        around = self.fan(into)
        c = around[-1]
        if self.is_notch(into):
            why = self.why_not_add(into)
            if why is None:
                self.put(c, b, a)
                self.added.add(turned(c, b, a))
                return [(a, c), self.into_tail((a, c))] if self.is_boundary((a, c)) else []
        else:
            why = self.why_not_remove(into)
            if why is None:
                self.stays |= {a, c}
                before = self.into_tail(into)
                for p, q in pairwise(around):
                    for edge in ((b, q), (q, p), (p, b)):
                        del self.third[edge]
                    self.added.discard(turned(b, q, p))
                return [before, *pairwise(around)]
        self.refusals[why] += 1
        return []


def smoothed_by_hand(
    points: FloatArray, faces: IntArray, allowed: FloatArray, psi_rad: float, most_rounds: int
) -> ByHand:
    """What `slrig.meshing.boundary.smooth_boundary` must come to, but for corners of exactly equal angles."""
    mesh = ByHand(points, allowed, {})
    for face in faces.tolist():
        mesh.put(*face)
    sharp = math.cos(psi_rad)
    queue = [(f[(k + 1) % 3], f[(k + 2) % 3]) for f in faces.tolist() for k in range(3)]
    while mesh.rounds < most_rounds:
        corners = [edge for edge in dict.fromkeys(queue) if mesh.is_boundary(edge)]
        found = [(edge, mesh.cosine(*edge, mesh.out_of(edge)[1])) for edge in corners]
        found = [(edge, cosine) for edge, cosine in found if cosine > sharp]
        if not found:
            break
        mesh.rounds += 1
        queue = []
        for edge, _ in sorted(found, key=lambda corner: (not mesh.is_notch(corner[0]), -corner[1])):
            if mesh.is_boundary(edge) and mesh.cosine(*edge, mesh.out_of(edge)[1]) > sharp:
                queue += mesh.handle(edge)
    return mesh

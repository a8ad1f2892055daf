"""The comparison as a table in Markdown, which a terminal shows as well."""

from __future__ import annotations

from dataclasses import dataclass

from tests.bench.peers.catalogue import METHODS, OURS
from tests.bench.peers.figures import Figures
from tests.bench.peers.measuring import Cost, Phase

HEADINGS = (
    "method", "points s", "mesh s", "first run s", "peak MB", "triangles", "rms µm", "p99 µm", "within 0.1 mm %",
    "within 0.3 mm %", "wrong > 0.5 mm %", "min angle 1/5/50 % °", "folds", "non-manifold",
)  # fmt: skip

NOTES = (
    "points s: frames in memory to points. mesh s: points to mesh, normals and orientation included where a method "
    "needs them. Both warm: the median of up to five runs after the first; a method of more than 15 s ran once.",
    "first run s: both, compiled kernels loaded or compiled. Reading frames and writing mesh files is in no figure; "
    "writing points.ply is in ours.",
    "'our points' are those that slrig wrote from the same frames, points that its mesh leaves out among them; their "
    "cost, in brackets, is slrig's. Memory of those rows is for the mesh alone.",
    "peak MB: most resident memory above what the process held with libraries imported and input read.",
    "rms, p99: distance to the true surface over the mesh's area. within: share of the visible surface covered to "
    "this. wrong: share of the mesh's area. folds: edges that bend by more than 60°.",
)


@dataclass(frozen=True, slots=True)
class Row:
    """One method's line. Without figures, `reason` says why."""

    method: str
    cost: Cost | None
    figures: Figures | None
    reason: str = ""


def as_markdown(rows: list[Row], *, title: str) -> str:
    """Return the table as Markdown, with its notes."""
    lines = [f"**{title}**", "", "| " + " | ".join(HEADINGS) + " |", "|---" + "|---:" * (len(HEADINGS) - 1) + "|"]
    for line in _cells(rows):
        padded = line + [""] * (len(HEADINGS) - len(line))
        lines.append("| " + " | ".join(padded) + " |")
    return "\n".join([*lines, "", *(f"- {note}" for note in NOTES), ""])


def _cells(rows: list[Row]) -> list[list[str]]:
    ours = next((row.cost for row in rows if row.method == OURS), None)
    return [_line(row, ours) for row in rows]


def _line(row: Row, ours: Cost | None) -> list[str]:
    method = METHODS[row.method]
    if row.cost is None or row.figures is None:
        return [method.title, row.reason]
    found, error = row.figures, row.figures.error
    source = row.cost if method.from_frames else ours
    points_s = "" if source is None else f"{source.warm_s[Phase.POINTS]:.2f}"
    counted = (Phase.POINTS, Phase.MESH)
    return [
        method.title,
        points_s if method.from_frames else f"({points_s})",
        f"{row.cost.warm_s[Phase.MESH]:.2f}",
        f"{sum(row.cost.first_s.get(phase, 0.0) for phase in counted):.2f}",
        f"{max(row.cost.peak_mb.get(phase, 0.0) for phase in counted):.0f}",
        f"{found.triangles}",
        f"{error.rms_mm * 1000:.1f}",
        f"{error.p99_mm * 1000:.0f}",
        f"{error.complete_01mm * 100:.1f}",
        f"{error.complete_03mm * 100:.1f}",
        f"{error.false_area_05mm * 100:.2f}",
        "/".join(f"{angle:.1f}" for angle in found.min_angle_deg),
        f"{found.folds}",
        f"{found.nonmanifold_edges}",
    ]

"""Pictures of an acceptance test: where points lie off an artefact, and where in the volume it stood."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from slrig.accept.evaluation import Evidence
from slrig.accept.plan import AcceptancePlan, Artefact, Step
from slrig.accept.scene import turn_deg
from slrig.model import FloatArray, Pinhole, Pixels
from slrig.reports.drawing import WIDTH, drawing, path, polygon, ramp, shape

_MAP_PX = (240, 180)
_MARGIN_SHARE = 0.06
_PAPER, _UNUSED = (240, 236, 233), (205, 198, 192)  # blue, green, red: what is bare, and what does not count
_MARGIN = 26.0
_NUMBER_LIFT = 3.5
_MOST_CELL_PX = 12


def error_map(evidence: Evidence, camera: Pinhole, *, most_mm: float) -> Pixels:
    """An artefact as the camera sees it, coloured by how far its points lie off the fit: (H, W, 3) uint8, BGR.

    Dark blue is most_mm inwards (below), yellow as much outwards; grey does not count.
    """
    on = np.flatnonzero(evidence.artefact > 0)
    seen = evidence.points_mm[on] @ camera.rotation.T + camera.translation_mm
    flat = seen[:, :2] / seen[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    width, height = _MAP_PX
    scale = (1 - 2 * _MARGIN_SHARE) / max((high - low)[0] / width, (high - low)[1] / height, 1e-12)
    # Cells are so wide that each holds a point or more.
    cell = int(np.clip(np.ceil(scale * np.sqrt(np.prod(high - low) / max(len(on), 1)) * 1.6), 1, _MOST_CELL_PX))
    grid = (-(-height // cell), -(-width // cell))
    places = ((flat - (low + high) / 2) * scale + np.array(_MAP_PX) / 2) / cell
    columns, rows = np.clip(places.astype(int), 0, np.array(grid)[::-1] - 1).T
    picture = np.full((*grid, 3), _PAPER, np.uint8)
    picture[rows, columns] = _UNUSED
    used = evidence.used[on]
    keys = rows[used] * grid[1] + columns[used]
    count = np.bincount(keys, minlength=grid[0] * grid[1])
    total = np.bincount(keys, weights=evidence.distances_mm[on][used], minlength=grid[0] * grid[1])
    filled = np.flatnonzero(count)
    shares = np.clip(0.5 + total[filled] / count[filled] / (2 * most_mm), 0, 1)
    picture.reshape(-1, 3)[filled] = ramp(shares)[:, ::-1]
    large = cv2.resize(picture, None, fx=cell, fy=cell, interpolation=cv2.INTER_NEAREST)
    return np.asarray(large[:height, :width])


def volume_view(plan: AcceptancePlan, artefact: Artefact, *, aside: bool) -> Markup:
    """The working volume to scale with every position of one artefact, numbered; from the front, or from the side."""
    axes = [2, 1] if aside else [0, 1]
    low, high = plan.volume_mm[:, axes]
    # Both views in one scale, that in which the wider fills its half of the page.
    scale = (WIDTH - 2 * _MARGIN) / float((plan.volume_mm[1] - plan.volume_mm[0])[:2].max())
    size = scale * (high - low)
    corner = np.array([(WIDTH - size[0]) / 2, _MARGIN])

    def placed(points_mm: FloatArray) -> FloatArray:
        return np.asarray((points_mm[..., axes] - low) * scale + corner)

    parts = [shape("rect", x=corner[0], y=corner[1], width=size[0], height=size[1], class_="volume")]
    steps = [step for step in plan.steps if step.artefact is artefact]
    for step in steps:
        if artefact is Artefact.PLANE:
            parts.append(polygon(placed(_outline_mm(step, plan)), "board"))
            continue
        ends, radius_mm = step.centre_mm[None], plan.artefacts.diameter.value_mm / 2
        if artefact is Artefact.BAR:
            ends, radius_mm = step.centre_mm + _ends_mm(plan)[:, None] * step.axis, plan.artefacts.ball_mm / 2
            line = path(placed(ends))
            parts.append(shape("path", d=line, class_="arrow", stroke="currentColor", stroke_opacity=0.5))
        parts += [shape("circle", cx=x, cy=y, r=scale * radius_mm, class_="board") for x, y in placed(ends)]
    parts += _numbers(steps, placed, plan)
    view = "from the side, the rig to the left" if aside else "as the rig sees it"
    return drawing(WIDTH, float(size[1]) + 2 * _MARGIN, f"positions of the {artefact}, {view}", parts)


def _ends_mm(plan: AcceptancePlan) -> FloatArray:
    """(2,) where the balls of the bar are along it, from its middle."""
    return np.array([-1, 1]) * plan.artefacts.distance.value_mm / 2


def _outline_mm(step: Step, plan: AcceptancePlan) -> FloatArray:
    """(4, 3) the corners of a plane in a position, its length across."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * [*plan.artefacts.plane_mm, 0] / 2
    turn = Rotation.from_euler("xyz", turn_deg(step), degrees=True)
    return np.asarray(step.centre_mm + turn.apply(corners))


def _numbers(steps: Sequence[Step], placed: Callable[[FloatArray], FloatArray], plan: AcceptancePlan) -> list[Markup]:
    """The positions' numbers; those that stand in one spot are told together."""
    spots: dict[tuple[int, int], list[str]] = {}
    for step in steps:
        # At one end of a bar: the middles of all diagonals are one.
        along_mm = _ends_mm(plan)[1] if step.artefact is Artefact.BAR else 0.0
        x, y = placed(step.centre_mm + step.axis * along_mm)
        spots.setdefault((round(x), round(y)), []).append(step.name.rpartition("-")[2])
    return [
        shape("text", ", ".join(names), x=float(x), y=y + _NUMBER_LIFT, class_="label")
        for (x, y), names in spots.items()
    ]

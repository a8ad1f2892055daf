"""The words for a move of the board: where to, how tilted, how near, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slrig.calibration.poses.candidates import Candidate
from slrig.calibration.poses.coverage import (
    Attitude,
    Coverage,
    Goals,
    around,
    attitude,
    cells_of,
    depth_groups,
    device_title,
    full_turn_deg,
    tilted,
    turn_groups,
)
from slrig.calibration.poses.rough import RigGuess
from slrig.calibration.solution import PROJECTOR, BoardPose
from slrig.model import FloatArray

_NEW_CELLS = 2
_SAME_DISTANCE = 0.04
_SAME_TURN_DEG = 10.0
_LEAST_TILT_DEG = 5.0
_TELLING_PX = 10.0
_MOST_REASONS = 3


@dataclass(frozen=True, slots=True)
class Gain:
    """What a candidate in the picture of one camera would add to the coverage.

    ways : from that camera's frame to each device's; seen_px : by device, the corners that it would see.
    """

    option: Candidate
    camera: str
    guess: RigGuess
    found: Coverage
    goals: Goals
    ways: Mapping[str, BoardPose]
    seen_px: Mapping[str, FloatArray]

    @property
    def goals_met(self) -> int:
        """How many open goals, of any device, come nearer."""
        return sum(len(self.of(name)) for name in self.seen_px)

    def of(self, name: str) -> list[str]:
        """Name the open goals of one device that come nearer: cells, tilt, distance, turn."""
        one, points_px = self.found.devices[name], self.seen_px[name]
        if not len(points_px):
            return []
        met = []
        if one.share < self.goals.cell_share:
            fresh = (cells_of(points_px, self.guess.devices[name].size) > 0) & (one.cells == 0) & one.reachable
            if fresh.sum() >= _NEW_CELLS:
                met.append("cells")
        if name == PROJECTOR:
            return met
        way = self.ways[name]
        board_pose = BoardPose(
            way.rotation @ self.option.board_pose.rotation,
            way.rotation @ self.option.board_pose.translation_mm + way.translation_mm,
        )
        then = attitude(board_pose, self.guess.board.points_mm.mean(axis=0))
        now = list(one.attitudes.values())
        leaning = tilted([then], self.goals)
        if any(one.tilted[axis] < self.goals.tilted and leaning[axis] for axis in (0, 1)):
            met.append("tilt")
        distances = [each.distance_mm for each in now]
        step = self.goals.depth_step
        if one.depths < self.goals.depths and len(depth_groups([*distances, then.distance_mm], step)) > one.depths:
            met.append("distance")
        turns = [each.turn_deg for each in now]
        apart = turn_groups(
            [*turns, then.turn_deg], self.goals.turn_step_deg, round_deg=full_turn_deg(self.guess.board)
        )
        if one.turns < self.goals.turns and len(apart) > one.turns:
            met.append("turn")
        return met


def place_words(place: tuple[int, int]) -> str:
    """Return a place in a picture.

    >>> place_words((-1, 1)), place_words((0, 0)), place_words((1, 0))
    ('lower left corner', 'middle', 'right edge')
    """
    across, down = {-1: "left", 0: "", 1: "right"}[place[0]], {-1: "upper", 0: "", 1: "lower"}[place[1]]
    if across and down:
        return f"{down} {across} corner"
    if across or down:
        return f"{across or down} edge"
    return "middle"


def move_words(option: Candidate, camera: str, last: Attitude, upright_deg: float, *, round_deg: float = 360.0) -> str:
    """Return what to do, as one clause.

    last : how the board stands now; upright_deg : how it usually does; round_deg : after which turn it looks the same.
    """
    parts = [f"move the board to the {place_words(option.place)} of camera '{camera}'"]
    about_x, about_y = option.tilt_deg
    if abs(about_x) >= _LEAST_TILT_DEG:
        parts.append(f"tilt its {'top' if about_x > 0 else 'bottom'} edge {abs(about_x):.0f}° towards the camera")
    if abs(about_y) >= _LEAST_TILT_DEG:
        parts.append(f"tilt its {'right' if about_y > 0 else 'left'} edge {abs(about_y):.0f}° towards the camera")
    if max(abs(about_x), abs(about_y)) < _LEAST_TILT_DEG:
        parts.append("let it face the camera")
    turn = 5 * round(around(option.turn_deg - last.turn_deg, round_deg) / 5)
    if abs(turn) > _SAME_TURN_DEG:
        parts.append(f"turn it {abs(turn):.0f}° {'clockwise' if turn > 0 else 'anticlockwise'} in its plane")
    elif abs(around(option.turn_deg - upright_deg, round_deg)) > _SAME_TURN_DEG:
        parts.append("leave it turned in its plane as it is")
    share = option.distance_mm / last.distance_mm - 1
    if abs(share) > _SAME_DISTANCE:
        parts.append(f"bring it {abs(share):.0%} {'farther away' if share > 0 else 'nearer'}")
    return ", ".join(parts)


def reasons(
    gain: Gain, worst: Mapping[str, float], expected: Mapping[str, float], place: tuple[str, tuple[int, int]]
) -> str:
    """Return why. place : the least sure device and where in its image it is so."""
    parts = []
    met = {name: gain.of(name) for name in gain.seen_px}
    own = met.get(gain.camera, [])
    if "cells" in own:
        parts.append("parts of the picture there are not covered yet")
    others = [name for name, goals in met.items() if "cells" in goals and name != gain.camera]
    parts += [f"it covers new parts of {_image_of(name)}" for name in others]
    for goal, words in (
        ("tilt", "too few poses are tilted that way"),
        ("distance", "the poses so far lie at too few distances"),
        ("turn", "the board was not yet turned in its plane like this"),
    ):
        if any(goal in goals for goals in met.values()):
            parts.append(words)
    parts = parts[:_MOST_REASONS]
    name, where = place
    if worst[name] < _TELLING_PX and expected[name] < worst[name]:
        parts.append(
            f"{device_title(name)} is least sure at its {place_words(where)}, ±{worst[name]:.2g} px at the worst, "
            f"and about ±{expected[name]:.2g} px after this pose"
        )
    return "; ".join(parts) if parts else "it is the pose that tells most now"


def first_words(cameras: Sequence[str], *, lit: bool) -> str:
    """Return what to do before there is any pose. lit : whether a projector is calibrated too."""
    several = " and seen by the others as well" if len(cameras) > 1 else ""
    light = ", lit by the projector" if lit else ""
    return (
        f"hold the board in the middle of the picture of camera '{cameras[0]}', facing it{several}{light}, near enough "
        "to fill about half of the picture: the first pose shows how large and how far it is"
    )


def enough_words(found: Coverage, worst: Mapping[str, float], goals: Goals) -> str:
    """Return that the set will do, or why no more poses are asked for."""
    count = len(found.poses)
    told = ", ".join(f"{device_title(name)} to ±{sigma:.2g} px" for name, sigma in worst.items())
    if found.missing:
        return f"{count} poses are as many as help. Still open: {'; '.join(found.missing)}. Solve, and read the verdict"
    if max(worst.values(), default=np.inf) <= goals.sigma_px:
        return f"enough: {count} poses tell {told} in its worst place; solve now"
    return f"enough: {count} poses tell {told} in its worst place, and another would hardly help; solve now"


def _image_of(name: str) -> str:
    return "the projector's image" if name == PROJECTOR else f"the picture of camera '{name}'"

"""What is known of a rig's positioner when a schedule is made."""

from __future__ import annotations

from collections.abc import Sequence

from slrig.errors import ScheduleError
from slrig.rig.session import RigFacts


def require_positions(facts: RigFacts | None, asked: Sequence[int | str]) -> None:
    """Refuse work that needs a positioner where the rig has none, or not those positions.

    facts None : the rig is not open, and nobody knows; a run is refused then. asked : by number from 0 or by name.

    Raises
    ------
    ScheduleError
        No run could be done with this rig.
    """
    if facts is None:
        return
    names = facts.positions
    if not names:
        message = (
            "this rig has no positioner, and nobody is there to move anything when a schedule is due: schedule a "
            "verification of a board that stays in view, and calibrate or test by hand (slrig calibrate run, slrig "
            "accept)"
        )
        raise ScheduleError(message)
    missing = [each for each in asked if each not in names and each not in range(len(names))]
    if missing:
        message = (
            f"options: this rig's positioner has no {', '.join(map(repr, missing))}; it has 0 to {len(names) - 1}: "
            f"{', '.join(names)}"
        )
        raise ScheduleError(message)

"""What moves unasked, on demand: a bumped device, one that warms up, a board that a hand does not hold still."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from simulated_rig.tables import Positive, Table, Triple
from slrig.model import Pinhole

PROJECTOR = "projector"

Index = Annotated[int, Field(ge=0)]


class Push(Table):
    """A device's change of pose, in its own frame: X' = turn (X + shift). The stated calibration does not follow.

    device : a camera's name, or "projector". turn_deg : about its x, y and z axis.
    """

    device: Annotated[str, Field(min_length=1)]
    turn_deg: Triple = (0.0, 0.0, 0.0)
    shift_mm: Triple = (0.0, 0.0, 0.0)


class Bump(Push):
    """A device is bumped when pose number `pose`, from 0, is taken, and stays so: `[[head.faults.bump]]`.

    Whoever goes back to an earlier pose finds it as it was before the bump.
    """

    pose: Index


class Drift(Push):
    """A device drifts towards a change of pose as 1 - exp(-t / settling): `[[head.drift]]`.

    t counts from the opening of the rig in the world's time for settle_s, or in captures for settle_captures. During
    one capture the device stands still.
    """

    settle_s: Positive | None = None
    settle_captures: Positive | None = None

    @model_validator(mode="after")
    def _one_clock(self) -> Drift:
        if (self.settle_s is None) == (self.settle_captures is None):
            message = "a drift needs settle_s or settle_captures, and not both"
            raise ValueError(message)
        return self

    def share(self, time_s: float, captures: int) -> float:
        """How much of the drift is there, 0 to 1, after a time and so many captures."""
        if self.settle_s is not None:
            return 1 - math.exp(-time_s / self.settle_s)
        return 1 - math.exp(-captures / (self.settle_captures or 1.0))


class Moving(Table):
    """What is moved does not stand still while pose number `pose`, from 0, is captured: `[[head.faults.moving]]`.

    shift_mm, turn_deg : from the capture's first pattern to its last one, in `steps` equal steps; the turn is about the
    world's axes at the object's own origin. pose : absent, every one.
    """

    pose: Index | None = None
    shift_mm: Triple = (0.0, 0.0, 0.0)
    turn_deg: Triple = (0.0, 0.0, 0.0)
    steps: Annotated[int, Field(ge=2, le=200)] = 6


def pushed(device: Pinhole, push: Push, *, share: float = 1.0) -> Pinhole:
    """Return a device after a share of a push."""
    turn = Rotation.from_rotvec(share * np.deg2rad(push.turn_deg)).as_matrix()
    translation = turn @ (device.translation_mm + share * np.array(push.shift_mm))
    return replace(device, rotation=turn @ device.rotation, translation_mm=translation)

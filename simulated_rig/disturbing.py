"""What moves unasked, on demand: a bumped device, one that warms up, a board that a hand does not hold still."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from simulated_rig.tables import Positive, Triple
from slrig.bundle.validation import Strict
from slrig.model import Pinhole

PROJECTOR = "projector"

Index = Annotated[int, Field(ge=0)]


class PoseChange(Strict, use_attribute_docstrings=True):
    """A device's change of pose, in its own frame: X' = turn (X + shift). The stated calibration does not follow."""

    device: Annotated[str, Field(min_length=1)]
    """A camera's name, or "projector"."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """About its x, y and z axis."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """Along its x, y and z axis."""


class BumpFault(PoseChange):
    """A device is bumped when a pose is taken, and stays so: `[[head.faults.bump]]`.

    Whoever goes back to an earlier pose finds it as it was before the bump.
    """

    pose: Index
    """Number of the pose, from 0."""


class PoseDrift(PoseChange):
    """A device drifts towards a change of pose as 1 - exp(-t / settling): `[[head.drift]]`.

    t counts from the opening of the rig in the world's time for settle_s, or in captures for settle_captures. During
    one capture the device stands still.
    """

    settle_s: Positive | None = None
    """Settling time of a drift by time."""

    settle_captures: Positive | None = None
    """How many captures settling takes, of a drift by captures."""

    @model_validator(mode="after")
    def _one_clock(self) -> PoseDrift:
        if (self.settle_s is None) == (self.settle_captures is None):
            message = "a drift needs settle_s or settle_captures, and not both"
            raise ValueError(message)
        return self

    def share(self, time_s: float, captures: int) -> float:
        """How much of the drift is there, 0 to 1, after a time and so many captures."""
        if self.settle_s is not None:
            return 1 - math.exp(-time_s / self.settle_s)
        return 1 - math.exp(-captures / (self.settle_captures or 1.0))


class ObjectMotion(Strict, use_attribute_docstrings=True):
    """What is moved does not stand still while a pose is captured: `[[head.faults.moving]]`."""

    pose: Index | None = None
    """Number of the pose, from 0; else every one."""

    shift_mm: Triple = (0.0, 0.0, 0.0)
    """From the capture's first pattern to its last one."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    """The same, about the world's axes at the object's own origin."""

    steps: Annotated[int, Field(ge=2, le=200)] = 6
    """In how many equal steps."""


def apply_pose_change(device: Pinhole, push: PoseChange, *, share: float = 1.0) -> Pinhole:
    """Return a device after a share of a push."""
    turn = Rotation.from_rotvec(share * np.deg2rad(push.turn_deg)).as_matrix()
    translation = turn @ (device.translation_mm + share * np.array(push.shift_mm))
    return replace(device, rotation=turn @ device.rotation, translation_mm=translation)

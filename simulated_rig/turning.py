"""The rendered rig's turntable: what stands on it, turned about an axis, with errors on demand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from simulated_rig.tables import Names, NotNegative, Triple
from slrig.bundle.validation import Strict
from slrig.devices import TurntableBase
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray, StageAxis

_SEED = 0x7475726E


class TurntableOptions(Strict, use_attribute_docstrings=True):
    """What turns objects: `[head.turntable]`. At 0° they stand as the scene file has them."""

    point_mm: Triple
    """A point of the axis."""

    direction: Triple = (0.0, -1.0, 0.0)
    """Of the axis; angles count right-handed about it. Upwards by default, since y points down."""

    objects: Names | None = None
    """Names of what stands on it; else all objects but those called "backdrop"."""

    poses: Annotated[int, Field(ge=1, le=360)] = 8
    """How many even poses it offers."""

    knows_axis: bool = False
    """Whether it tells its axis; else that has to be found, as on metal."""

    scale_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """By what share of the angle that was asked for it goes too far."""

    angle_sigma_deg: NotNegative = 0.0
    """Standard deviation of the angle that it stops at, drawn anew by the seed for each turn."""

    wobble_deg: Annotated[float, Field(ge=0, le=10)] = 0.0
    """How far its axis leans, twice to either side in a turn, as on a bearing that is not flat: this times
    sin(2 · angle), about a direction across it."""

    @field_validator("direction")
    @classmethod
    def _a_direction(cls, direction: Triple) -> Triple:
        if not np.linalg.norm(direction) > 0:
            message = "expected a direction, found [0, 0, 0]; upwards is [0, -1, 0]"
            raise ValueError(message)
        return direction

    @property
    def axis(self) -> StageAxis:
        """The axis, in the world."""
        return StageAxis(np.array(self.point_mm), np.array(self.direction) / np.linalg.norm(self.direction))

    def motion(self, angle_deg: float) -> FloatArray:
        """(4, 4): how what stands on it has moved, from 0° to an angle at which it stands exactly."""
        axis = self.axis
        # Across the axis: the world's direction that lies farthest from it, made orthogonal to it.
        farthest = np.eye(3)[np.argmin(np.abs(axis.direction))]
        across = np.cross(axis.direction, farthest)
        across /= np.linalg.norm(across)
        angle = np.deg2rad(angle_deg)
        lean = Rotation.from_rotvec(np.deg2rad(self.wobble_deg) * np.sin(2 * angle) * across)
        motion = np.eye(4)
        motion[:3, :3] = (lean * Rotation.from_rotvec(angle * axis.direction)).as_matrix()
        motion[:3, 3] = axis.point_mm - motion[:3, :3] @ axis.point_mm
        return motion


class RenderedTurntable(TurntableBase):
    """Implements `slrig.devices.Turntable` on the rendered world.

    turn_objects : has what stands on the table stand turned, by a motion (4, 4) from where the scene file has it.
    """

    def __init__(self, options: TurntableOptions, turn_objects: Callable[[FloatArray], None], *, seed: int) -> None:
        super().__init__(options.poses)
        self._options = options
        self._turn_objects = turn_objects
        self._rng = np.random.default_rng((seed, _SEED))
        self._asked_deg = 0.0
        self._closed = False

    @property
    def axis(self) -> StageAxis | None:
        """See `Turntable`. Without the errors."""
        return self._options.axis if self._options.knows_axis else None

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`. Its objects stand as the scene file has them, each time."""
        return None

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. It is there at once, and stays where it is when it is there already."""
        if self._closed:
            message = "the rendered rig's turntable is closed; open the rig again"
            raise DeviceStateError(message)
        if not np.isfinite(angle_deg):
            message = f"asked the turntable for {angle_deg}°; ask for a number of degrees"
            raise UnsupportedByDeviceError(message)
        if angle_deg == self._asked_deg:
            return
        error_deg = self._options.scale_error * angle_deg + self._rng.normal(0.0, self._options.angle_sigma_deg)
        self._turn_objects(self._options.motion(angle_deg + error_deg))
        self._asked_deg = angle_deg

    def close(self) -> None:
        """See `Positioner`."""
        self._closed = True

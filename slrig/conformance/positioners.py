"""What moves the object: poses with names, refusals that name them, and a way out that may be taken twice."""

from __future__ import annotations

import math

import numpy as np

from slrig.conformance.bench import Need, RigBench, at, check, expect, refused, works
from slrig.devices import Positioner, Turntable
from slrig.errors import DeviceError, DeviceStateError, UnsupportedByDeviceError


@check(Need.POSITIONER, fresh=True)
def a_positioner_takes_its_poses_and_no_others(bench: RigBench) -> None:
    """A positioner takes its poses and no others, and a turntable any angle."""
    positioner = bench.rig.positioner
    if positioner is None:  # which `Need.POSITIONER` has seen to
        return
    with at("positioner"):
        poses = tuple(positioner.poses)
        expect(
            poses and len(set(poses)) == len(poses),
            asked="it has a pose, or more, each with a name of its own",
            found=poses,
            do="declare the poses; a turntable that turns to any angle, some of these",
        )
        for index in (-1, len(poses)):
            do = "check the number before anything moves, and name the poses that there are"
            with refused(UnsupportedByDeviceError, asked=f"pose {index} of {len(poses)}", do=do):
                positioner.move(index)
        with works(asked=f"it takes its pose {min(1, len(poses) - 1)}", do="return when the object stands still"):
            positioner.move(min(1, len(poses) - 1))
        if isinstance(positioner, Turntable):
            _turns(positioner)
        _closes(positioner)


def _turns(table: Turntable) -> None:
    axis, angles = table.axis, tuple(table.angles_deg)
    expect(
        axis is None or math.isclose(float(np.linalg.norm(axis.direction)), 1.0, rel_tol=1e-6),
        asked="the axis that it tells has a direction of length 1",
        found=axis,
        do="divide it by its length; None where nobody knows the axis",
    )
    expect(
        len(angles) == len(table.poses) and all(map(math.isfinite, angles)),
        asked=f"each of its {len(table.poses)} poses has an angle",
        found=angles,
        do="give angles_deg in the order of poses",
    )
    with refused(DeviceError, asked="turn(nan)", do="check the angle before anything moves"):
        table.turn(math.nan)
    with works(asked="it turns back to 0°, where it stood when it was opened", do="count angles from there"):
        table.turn(0.0)


def _closes(positioner: Positioner) -> None:
    for _ in range(2):
        with works(asked="close works any number of times", do="return at once when there is nothing left to do"):
            positioner.close()
    with refused(DeviceStateError, asked="move after close", do="refuse every use of a closed device"):
        positioner.move(0)

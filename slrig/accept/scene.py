"""The artefacts of an acceptance test as a scene of a rendered rig, and its positions as the poses of its script."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from slrig.accept.plan import AcceptancePlan, Artefact, Step
from slrig.bundle import write_file
from slrig.config import HeadTable, RigConfig
from slrig.disk import storage_errors
from slrig.errors import UnsupportedByDeviceError, setting
from slrig.model import FloatArray

SCENE = "acceptance-scene.toml"
_ALBEDO = 0.8
_BAR_SHARE = 0.25  # of a ball's radius: the rod between them
_ASIDE = 20.0  # diagonals of the volume: where artefacts stand that are not measured


def scripted_config(config: RigConfig, plan: AcceptancePlan, folder: Path) -> RigConfig:
    """The rig with the artefacts in place of its scene, which is written into `folder`, and a pose for every position.

    Raises UnsupportedByDeviceError if the rig's head has no scene, for it is not rendered then; StorageError.
    """
    if config.head is None or "scene" not in config.head.options:
        message = (
            f"rig '{config.name}' is not rendered and nobody moves its artefacts by script; leave "
            f"{setting('scripted')} out and place them by hand"
        )
        raise UnsupportedByDeviceError(message)
    path = (folder / SCENE).resolve()
    with storage_errors(path):
        folder.mkdir(parents=True, exist_ok=True)
    write_file(path, scene_text(plan).encode())
    # A series of poses of a board that is not there any more would be refused.
    options = {key: value for key, value in config.head.model_dump().items() if key != "poses"}
    options |= {"scene": str(path), "pose": [_pose(step) for step in plan.steps]}
    return replace(config, head=HeadTable.model_validate(options))


def scene_text(plan: AcceptancePlan) -> str:
    """The scene file, in TOML: a sphere, a ball bar and a plane, each out of sight until a pose brings it."""
    artefacts = plan.artefacts
    aside = plan.volume_mm.mean(axis=0) + np.array([_ASIDE * plan.diagonal_mm, 0.0, 0.0])
    apart = np.array([0.0, 2 * plan.diagonal_mm, 0.0])
    radius = artefacts.ball_mm / 2
    objects = [
        _object(Artefact.SPHERE, "sphere", aside, f"radius_mm = {artefacts.diameter.value_mm / 2!r}"),
        _object(
            Artefact.BAR, "ball_bar", aside + apart,
            f"radius_mm = {radius!r}\ndistance_mm = {artefacts.distance.value_mm!r}\n"
            f"bar_radius_mm = {_BAR_SHARE * radius!r}",
        ),
        _object(Artefact.PLANE, "plane", aside - apart, f"size_mm = {[float(each) for each in artefacts.plane_mm]}"),
    ]  # fmt: skip
    return "\n\n".join(['name = "acceptance"', *objects]) + "\n"


def _object(artefact: Artefact, shape: str, position: FloatArray, rest: str) -> str:
    place = [round(float(each), 3) for each in position]
    return f'[[object]]\nname = "{artefact}"\nshape = "{shape}"\nposition_mm = {place}\nalbedo = {_ALBEDO}\n{rest}'


def _pose(step: Step) -> dict[str, object]:
    return {
        "name": step.name,
        "object": str(step.artefact),
        "position_mm": [float(each) for each in step.centre_mm],
        "rotation_deg": list(turn_deg(step)),
    }


def turn_deg(step: Step) -> tuple[float, float, float]:
    """The turn about the fixed x, then y, then z axes that brings an artefact into the position, degrees.

    A bar's own axis is x, a plane's front faces -z.

    >>> turn_deg(Step("bar-1", Artefact.BAR, np.zeros(3), np.array([0.0, 1.0, 0.0]), ""))
    (0.0, 0.0, 90.0)
    """
    if step.artefact is Artefact.SPHERE:
        return 0.0, 0.0, 0.0
    x, y, z = (float(each) for each in step.axis)
    if step.artefact is Artefact.BAR:
        # Rz(c) Ry(b) takes the x axis to (cos b cos c, cos b sin c, -sin b).
        return 0.0, math.degrees(-math.asin(max(-1.0, min(1.0, z)))) + 0.0, math.degrees(math.atan2(y, x))
    # Ry(b) Rx(a) takes -z to (-sin b cos a, sin a, -cos b cos a).
    return math.degrees(math.asin(max(-1.0, min(1.0, y)))), math.degrees(math.atan2(-x, -z)), 0.0

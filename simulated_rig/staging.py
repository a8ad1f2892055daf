"""Control of the simulated scene: object placement at each pose, and bumped or drifted devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from simulated_rig.light import NS_PER_S
from simulated_rig.movements import PROJECTOR, ObjectMotion, PoseOffset, ScriptedPose, apply_pose_offset, generate_poses
from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import (
    PrintedBoard,
    Scene,
    SceneObject,
    SceneSurface,
    build_surface,
    place_object,
    rotation_matrix,
)
from slrig.devices import Clock
from slrig.errors import ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray, Pinhole

_BACKDROP = "backdrop"


class PoseScript:
    """Poses given by the options and the scene, and the surface at each. Raises ConfigError with all faults."""

    def __init__(self, options: HeadOptions, scene: Scene, folder: Path) -> None:
        self._scene = scene
        self._folder = folder
        self.poses: tuple[ScriptedPose, ...] = options.pose
        boards = [thing for thing in scene.object if isinstance(thing, PrintedBoard)]
        self._default_object: SceneObject = boards[0] if boards else scene.object[0]
        faults: list[str] = []
        if options.poses is not None:
            if boards:
                devices = [each.pinhole() for each in (*options.camera, options.projector)]
                self.poses += generate_poses(options.poses, boards[0], devices)
            else:
                faults.append('[head.poses] moves a board; the scene has none: add an object with shape = "board"')
        names = {thing.name: thing for thing in scene.object}
        self._moved_objects: list[SceneObject] = []
        for number, pose in enumerate(self.poses):
            if pose.object is None and not boards:
                faults.append(
                    f"pose {number + 1}: `object` is missing and the scene has no board; it has {sorted(names)}"
                )
            elif pose.object is not None and pose.object not in names:
                faults.append(f"pose {number + 1}: unknown object {pose.object!r}; the scene has {sorted(names)}")
            else:
                self._moved_objects.append(boards[0] if pose.object is None else names[pose.object])
        table = options.turntable
        if table is not None and (options.pose or options.poses is not None):
            faults.append("[head.turntable] cannot be combined with [[head.pose]] or [head.poses]; remove one of them")
        turned = set(names) - {_BACKDROP} if table is None or table.objects is None else set(table.objects)
        faults += [
            f"turntable.objects: unknown object {name!r}; the scene has {sorted(names)}"
            for name in sorted(turned - set(names))
        ]
        self._on_table = tuple(thing.name in turned for thing in scene.object)
        count = len(self.poses)
        for what, at in (
            *(("faults.bump", bump.pose) for bump in options.faults.bump),
            *(("faults.moving", moving.pose) for moving in options.faults.moving),
        ):
            if at is not None and at >= max(count, 1):
                faults.append(f"{what}: pose {at} does not exist; the script has {count}, counted from 0")
        if faults:
            message = "\n".join(["the script of the simulated rig has faults; correct each and try again:", *faults])
            raise ConfigError(message)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the poses."""
        return tuple(pose.name or f"pose {number + 1}" for number, pose in enumerate(self.poses))

    def surface(
        self, index: int, motions: Sequence[tuple[ObjectMotion, float]] = (), *, turn: FloatArray | None = None
    ) -> SceneSurface:
        """Return the scene at a pose, after a fraction of each motion and after the turntable's turn, (4, 4) in the
        world. Without poses: as in the scene file.
        """
        scripted = self.poses[index] if self.poses else None
        mover = self._moved_objects[index] if self.poses else self._default_object
        things = self._scene.object
        if scripted is not None or motions:
            start = scripted if scripted is not None else mover
            position, rotation = np.array(start.position_mm), rotation_matrix(start.rotation_deg)
            for moving, share in motions:
                position = position + share * np.array(moving.shift_mm)
                rotation = Rotation.from_rotvec(share * np.deg2rad(moving.turn_deg)).as_matrix() @ rotation
            exact = {} if scripted is None or motions else {"rotation_deg": scripted.rotation_deg}
            things = tuple(
                place_object(each, position, rotation).model_copy(update=exact) if each is mover else each
                for each in things
            )
        if turn is not None:
            things = tuple(
                place_object(
                    each,
                    turn[:3, :3] @ each.position_mm + turn[:3, 3],
                    turn[:3, :3] @ rotation_matrix(each.rotation_deg),
                )
                if on_table
                else each
                for each, on_table in zip(things, self._on_table, strict=True)
            )
        return build_surface(self._scene.model_copy(update={"object": things}), self._folder)


class SceneController:
    """Moves objects and devices as scripted: at a move, at the start of a capture, and between its patterns.

    Implements `slrig.devices.Positioner`. Replaces surface and devices in the scene state and the views, which then
    trace again when they are next used.
    """

    def __init__(
        self,
        options: HeadOptions,
        script: PoseScript,
        scene_state: SceneState,
        views: Mapping[str, CameraView],
        clock: Clock,
    ) -> None:
        self._options = options
        self._script = script
        self._scene_state = scene_state
        self._views = views
        self._clock = clock
        self._calibrated: dict[str, Pinhole] = {each.name: each.pinhole() for each in options.camera}
        self._calibrated[PROJECTOR] = options.projector.pinhole()
        self._t_opened_ns = clock.now_ns()
        self._index = 0
        self._captures = 0
        self._pattern_count = 1
        self._shows = 0
        self._step: tuple[int, ...] = ()
        self._turn: FloatArray | None = None
        self._closed = False
        self._set_devices()

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`."""
        return self._script.names

    @property
    def index(self) -> int:
        """The pose taken last; 0 at first."""
        return self._index

    def move(self, index: int) -> None:
        """See `Positioner`."""
        if self._closed:
            message = "the simulated positioner is closed; open the rig again"
            raise DeviceStateError(message)
        count = len(self._script.poses)
        if not 0 <= index < count:
            message = f"pose {index} does not exist; the script has poses 0 to {count - 1}: {', '.join(self.poses)}"
            raise UnsupportedByDeviceError(message)
        self._index = index
        self._set_objects()
        self._set_devices()

    def turn_table(self, turn: FloatArray) -> None:
        """Turn the objects on the turntable by a motion, (4, 4) in the world, from their places in the scene file."""
        self._turn = turn
        self._set_objects()

    def close(self) -> None:
        """See `Positioner`."""
        self._closed = True

    def start_capture(self, pattern_count: int) -> None:
        """Note the start of a capture of `pattern_count` patterns: apply the drift and reset moving objects."""
        self._pattern_count, self._shows = max(pattern_count, 1), 0
        if self._options.drift:
            self._set_devices()
        self._captures += 1
        if self._step:
            self._set_objects()

    def advance_pattern(self) -> None:
        """Note that one more pattern is about to be shown: advance moving objects."""
        motions = self._motions
        if motions:
            done = min(self._shows, self._pattern_count - 1)
            step = tuple(done * moving.steps // self._pattern_count for moving in motions)
            if step != (self._step or (0,) * len(step)):
                shares = [at / (moving.steps - 1) for at, moving in zip(step, motions, strict=True)]
                surface = self._script.surface(self._index, list(zip(motions, shares, strict=True)), turn=self._turn)
                self._scene_state.change(surface=surface)
            self._step = step
        self._shows += 1

    @property
    def _motions(self) -> list[ObjectMotion]:
        return [each for each in self._options.faults.moving if each.pose in (None, self._index)]

    def _set_objects(self) -> None:
        self._step = ()
        self._scene_state.change(surface=self._script.surface(self._index, turn=self._turn))

    def _set_devices(self) -> None:
        time_s = (self._clock.now_ns() - self._t_opened_ns) / NS_PER_S
        offsets: list[tuple[PoseOffset, float]] = [
            *((bump, 1.0) for bump in self._options.faults.bump if bump.pose <= self._index),
            *((drift, drift.progress(time_s, self._captures)) for drift in self._options.drift),
        ]
        for name, calibrated in self._calibrated.items():
            current = calibrated
            for offset, share in offsets:
                if offset.device == name:
                    current = apply_pose_offset(current, offset, share=share)
            if name == PROJECTOR:
                self._scene_state.change(projector=current)
            else:
                self._views[name].move(current)

"""Scenes: what stands before the rig, described in TOML, and its one triangle surface.

The world and each object's own frame look like a camera image: x to the right, y down, z away from the devices.
An object's front therefore faces -z, and a relief of positive height comes towards the devices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from simulated_rig import shapes
from simulated_rig.boards import BoardPrint, PrintedBoard
from simulated_rig.placed import Colour, TexturedObject, rotation_matrix
from simulated_rig.shapes import MeshPart
from simulated_rig.tables import NotNegative, Pair, Positive, require_one
from slrig.bundle.validation import Strict, checked, read_toml
from slrig.errors import ConfigError
from slrig.model import FloatArray, IntArray

_MAX_FILE_BYTES = 1 << 24


class PlaneObject(TexturedObject):
    """A rectangle in the object's x-y plane."""

    shape: Literal["plane"]
    size_mm: Annotated[tuple[Positive, Positive], Field(strict=False)]

    def parts(self, _folder: Path) -> list[MeshPart]:
        """The rectangle."""
        return [shapes.rectangle(*self.size_mm)]


class Sphere(TexturedObject):
    """A ball about the object's origin. Light and truth use the exact sphere, not its facets."""

    shape: Literal["sphere"]
    radius_mm: Positive

    def parts(self, _folder: Path) -> list[MeshPart]:
        """The ball."""
        return [shapes.ball(self.radius_mm)]


class BallBar(TexturedObject):
    """Two equal balls, `distance_mm` between their centres along x, and the bar that joins them."""

    shape: Literal["ball_bar"]
    radius_mm: Positive
    distance_mm: Positive
    bar_radius_mm: Positive

    @model_validator(mode="after")
    def _apart(self) -> BallBar:
        if self.distance_mm <= 2 * self.radius_mm or self.bar_radius_mm >= self.radius_mm:
            message = (
                f"the balls must lie apart (distance above {2 * self.radius_mm} mm) and the bar be thinner than them"
            )
            raise ValueError(message)
        return self

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Two balls and a rod."""
        half = self.distance_mm / 2
        left = shapes.ball(self.radius_mm, centre_mm=(-half, 0.0, 0.0))
        right = shapes.ball(self.radius_mm, centre_mm=(half, 0.0, 0.0))
        return [left, right, shapes.rod(self.bar_radius_mm, self.distance_mm)]


class Stairs(TexturedObject):
    """Steps along x, each `rise_mm` nearer to the devices than the one on its left, `height_mm` long in y."""

    shape: Literal["stairs"]
    steps: Annotated[int, Field(ge=1, le=1000)]
    tread_mm: Positive
    rise_mm: Positive
    height_mm: Positive

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Treads and risers, flat."""
        return [shapes.staircase(self.steps, self.tread_mm, self.rise_mm, self.height_mm)]


class Wave(Strict):
    """One sine of a relief: amplitude_mm * sin(2 pi s / wavelength_mm + phase), s along `direction_deg` from x."""

    amplitude_mm: float
    wavelength_mm: Positive
    direction_deg: float = 0.0
    phase_deg: float = 0.0


class ReliefBump(Strict):
    """One Gaussian hill (or hollow, with a negative height) of a relief."""

    centre_mm: Pair
    height_mm: float
    sigma_mm: Positive


class Relief(TexturedObject):
    """A height field over a rectangle: a sum of waves and bumps, sampled every `step_mm`."""

    shape: Literal["relief"]
    size_mm: Annotated[tuple[Positive, Positive], Field(strict=False)]
    step_mm: Positive = 0.5
    wave: Annotated[tuple[Wave, ...], Field(strict=False)] = ()
    bump: Annotated[tuple[ReliefBump, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _bounded(self) -> Relief:
        cells = self.size_mm[0] * self.size_mm[1] / self.step_mm**2
        if cells > 4e6:
            message = f"size_mm and step_mm ask for {cells:.0f} cells, at most 4000000 are made; use a larger step_mm"
            raise ValueError(message)
        return self

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height towards the devices at (x, y) of the object's own frame, mm, same shape as x and y."""
        total = np.zeros(np.broadcast_shapes(x_mm.shape, y_mm.shape))
        for wave in self.wave:
            turn = np.deg2rad(wave.direction_deg)
            along = x_mm * np.cos(turn) + y_mm * np.sin(turn)
            total += wave.amplitude_mm * np.sin(2 * np.pi * along / wave.wavelength_mm + np.deg2rad(wave.phase_deg))
        for bump in self.bump:
            square = (x_mm - bump.centre_mm[0]) ** 2 + (y_mm - bump.centre_mm[1]) ** 2
            total += bump.height_mm * np.exp(-square / (2 * bump.sigma_mm**2))
        return total

    def parts(self, _folder: Path) -> list[MeshPart]:
        """The height field."""
        return [shapes.height_field(self.size_mm, self.step_mm, self.height_mm)]


class Vessel(TexturedObject):
    """A vessel turned on a lathe about y: a smooth curve through (radius, height) points, fluted if asked.

    `flutes` grooves run along the axis and change the radius by ± `flute_depth_mm`, twisted by `twist_deg` over
    the height. Heights count upwards, against y.
    """

    shape: Literal["turned"]
    profile_mm: Annotated[tuple[Pair, ...], Field(strict=False)]
    flutes: Annotated[int, Field(ge=0)] = 0
    flute_depth_mm: NotNegative = 0.0
    twist_deg: float = 0.0
    step_mm: Positive = 0.5

    @model_validator(mode="after")
    def _turnable(self) -> Vessel:
        if len(self.profile_mm) < 3:
            message = f"profile_mm needs at least 3 points, found {len(self.profile_mm)}"
            raise ValueError(message)
        radii, heights = zip(*self.profile_mm, strict=True)
        if min(radii) <= self.flute_depth_mm or any(b <= a for a, b in pairwise(heights)):
            message = "profile_mm needs rising heights and radii above flute_depth_mm"
            raise ValueError(message)
        return self

    def parts(self, _folder: Path) -> list[MeshPart]:
        """The open vessel's outer wall."""
        profile = np.array(self.profile_mm)
        return [shapes.vessel(profile, self.flutes, self.flute_depth_mm, np.deg2rad(self.twist_deg), self.step_mm)]


class MeshFile(TexturedObject):
    """A triangle mesh from a file (STL, PLY, OBJ, GLB), in units of `unit_mm`, in its own frame.

    A GLB's frame is glTF's: metres, y up. unit_mm = 1000 and rotation_deg = [180, 0, 0] bring a scan's mesh.glb back.
    Edges sharper than `crease_deg` stay sharp in the shading.
    """

    shape: Literal["mesh"]
    file: str
    unit_mm: Positive = 1.0
    crease_deg: Annotated[float, Field(ge=0, le=180)] = 30.0

    def parts(self, folder: Path) -> list[MeshPart]:
        """The mesh. Raises ConfigError when the file cannot be read or holds no triangle."""
        return [shapes.mesh_file(folder / self.file, self.unit_mm, crease_rad=np.deg2rad(self.crease_deg))]


AnyObject = Annotated[
    PlaneObject | Sphere | BallBar | Stairs | Relief | Vessel | MeshFile | PrintedBoard,
    Field(discriminator="shape"),
]


class Scene(Strict):
    """A scene file: a name and one or more objects."""

    name: str = ""
    object: Annotated[tuple[AnyObject, ...], Field(strict=False), AfterValidator(require_one)]


@dataclass(frozen=True, slots=True)
class SceneSurface:
    """The whole scene as triangles in the world, with materials by part.

    vertices_mm : (V, 3) float64; faces : (F, 3) int32; corner_normals : (F, 3, 3) float32, unit; part : (F,) int32.
    sphere_mm : (P, 4) float64, centre and radius of a part that is a ball, radius 0 for the others.
    to_object : (P, 3, 4) float64, world to the object's own frame.
    material : (P, 6) float64: albedo, texture (index in TEXTURES), contrast, scale_mm, lobe strength, exponent.
    colours : (P, 2, 3) float64, blue, green and red where a texture is light, and where it is dark.
    prints : what is printed on the parts that are boards.
    """

    vertices_mm: FloatArray
    faces: IntArray
    corner_normals: NDArray[np.float32]
    part: IntArray
    sphere_mm: FloatArray
    to_object: FloatArray
    material: FloatArray
    colours: FloatArray
    prints: Mapping[int, BoardPrint] = field(default_factory=dict)


def read_scene(path: Path) -> Scene:
    """Return the scene of a TOML file. Raises ConfigError that lists all faults."""
    return checked(Scene, read_toml(path, _MAX_FILE_BYTES), f"the scene file {path}")


def build_surface(scene: Scene, folder: Path) -> SceneSurface:
    """Return the triangles of a scene; mesh files are looked for from `folder`. Raises ConfigError."""
    vertices, faces, normals, owners = [], [], [], []
    spheres: list[tuple[float, ...]] = []
    inverses: list[FloatArray] = []
    materials: list[tuple[float, ...]] = []
    colours: list[tuple[Colour, Colour]] = []
    prints: dict[int, BoardPrint] = {}
    faults, first = [], 0
    for thing in scene.object:
        rotation = rotation_matrix(thing.rotation_deg)
        shift = np.array(thing.position_mm)
        try:
            parts = thing.parts(folder)
        except ConfigError as error:
            faults.append(str(error))
            continue
        if isinstance(thing, PrintedBoard):
            prints[len(spheres)] = thing.printed()
        for part in parts:
            vertices.append(part.vertices_mm @ rotation.T + shift)
            faces.append(part.faces + first)
            normals.append((part.corner_normals @ rotation.T).astype(np.float32))
            owners.append(np.full(len(part.faces), len(spheres), np.int32))
            spheres.append((*(rotation @ np.array(part.sphere_mm[:3]) + shift), part.sphere_mm[3]))
            inverses.append(np.column_stack([rotation.T, -rotation.T @ shift]))
            materials.append(thing.material())
            colours.append(thing.colours())
            first += len(part.vertices_mm)
    if faults:
        message = "\n".join(faults)
        raise ConfigError(message)
    return SceneSurface(
        vertices_mm=np.ascontiguousarray(np.concatenate(vertices)),
        faces=np.ascontiguousarray(np.concatenate(faces), np.int32),
        corner_normals=np.ascontiguousarray(np.concatenate(normals)),
        part=np.concatenate(owners),
        sphere_mm=np.array(spheres, np.float64),
        to_object=np.array(inverses, np.float64),
        material=np.array(materials, np.float64),
        colours=np.array(colours, np.float64),
        prints=prints,
    )

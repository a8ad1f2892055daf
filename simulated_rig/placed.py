"""What every object of a scene has: a name, a pose and a material."""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from simulated_rig.tables import Fraction, NotNegative, Positive, Triple
from slrig.bundle.validation import Strict
from slrig.model import FloatArray

TEXTURES = ("uniform", "checker", "noise")


Colour = Annotated[tuple[Fraction, Fraction, Fraction], Field(strict=False)]
"""Albedo for blue, green and red light, as a share of the albedo."""

WHITE: Colour = (1.0, 1.0, 1.0)


class Texture(Strict):
    """Albedo that varies: times 1 - contrast * t, t in 0..1 over the object's own coordinates.

    `checker` alternates squares of `scale_mm` over x and y; `noise` is smooth random shading with grains of that size.
    colour : the object's where t is 1, if it is another one there.
    """

    kind: Literal["uniform", "checker", "noise"] = "uniform"
    contrast: Fraction = 0.5
    scale_mm: Positive = 10.0
    colour: Colour | None = None


class Specular(Strict):
    """A Phong lobe added to the Lambertian light: strength * cos(angle to the mirror direction) ^ exponent."""

    strength: NotNegative = 0.0
    exponent: Annotated[float, Field(ge=1)] = 20.0


class SceneObject(Strict):
    """An object in a pose (rotation about its own x, then y, then z axis as fixed axes), with a gloss."""

    name: str = ""
    position_mm: Triple = (0.0, 0.0, 0.0)
    rotation_deg: Triple = (0.0, 0.0, 0.0)
    specular: Specular = Specular()

    def colours(self) -> tuple[Colour, Colour]:
        """The colour where a texture is light, and where it is dark."""
        return WHITE, WHITE


class TexturedObject(SceneObject):
    """An object of one albedo and colour, or of those that a texture varies."""

    albedo: Annotated[float, Field(gt=0, le=1)] = 0.8
    colour: Colour = WHITE
    texture: Texture = Texture()

    def material(self) -> tuple[float, ...]:
        """(6,): albedo, texture (index in TEXTURES), contrast, scale_mm, lobe strength, exponent."""
        texture, lobe = self.texture, self.specular
        kind = float(TEXTURES.index(texture.kind))
        return (self.albedo, kind, texture.contrast, texture.scale_mm, lobe.strength, lobe.exponent)

    def colours(self) -> tuple[Colour, Colour]:
        """See `SceneObject`."""
        return self.colour, self.colour if self.texture.colour is None else self.texture.colour


ObjectT = TypeVar("ObjectT", bound=SceneObject)


def place_object(thing: ObjectT, position_mm: FloatArray, rotation: FloatArray) -> ObjectT:
    """The same object in another pose. rotation : (3, 3), object to world."""
    x, y, z = (float(each) for each in position_mm)
    a, b, c = (float(each) for each in Rotation.from_matrix(rotation).as_euler("xyz", degrees=True))
    return thing.model_copy(update={"position_mm": (x, y, z), "rotation_deg": (a, b, c)})


def rotation_matrix(rotation_deg: Triple) -> FloatArray:
    """(3, 3) float64: object to world, of a pose's rotation."""
    return np.asarray(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix(), np.float64)

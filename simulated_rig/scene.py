"""Scenes of the simulated rig: objects described in TOML, and their combined triangle surface.

The world and each object's own frame are oriented like a camera image: x to the right, y down, z away from the devices.
The front of an object faces -z, and a relief of positive height extends towards the devices.

A board's origin is the centre of its corners. Its print is piecewise constant: dark and light rectangles between two
sets of lines, or dark discs on a light ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from simulated_rig import shapes
from simulated_rig.shapes import MeshPart, bent_sheet, rectangle_between
from slrig.bundle import Strict, read_toml, validate
from slrig.errors import ConfigError
from slrig.model import FloatArray, IntArray

Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]


Item = TypeVar("Item")


TEXTURES = ("uniform", "checker", "noise")
Colour = Annotated[tuple[Fraction, Fraction, Fraction], Field(strict=False)]
"""Albedo for blue, green and red light, as a fraction of the albedo."""
WHITE: Colour = (1.0, 1.0, 1.0)
Albedo = Annotated[float, Field(gt=0, le=1)]
Corners = Annotated[int, Field(ge=2, le=60)]
_MAX_FILE_BYTES = 1 << 24


def require_one(items: tuple[Item, ...]) -> tuple[Item, ...]:
    """Return `items`; raise ValueError if there are none. A length rule of pydantic would also count invalid items."""
    if not items:
        message = "at least one is needed"
        raise ValueError(message)
    return items


class Texture(Strict):
    """Texture of an object: the albedo times 1 - contrast * t, with t in 0..1 over the object's own coordinates.

    `checker` alternates squares of `scale_mm` over x and y; `noise` is smooth random shading with grains of that size.
    colour : colour where t is 1; the object's colour if None.
    """

    kind: Literal["uniform", "checker", "noise"] = "uniform"
    contrast: Fraction = 0.5
    scale_mm: Positive = 10.0
    colour: Colour | None = None


class Specular(Strict):
    """Phong lobe added to the Lambertian light: strength * cos(angle to the mirror direction) ^ exponent."""

    strength: NotNegative = 0.0
    exponent: Annotated[float, Field(ge=1)] = 20.0


class Mirror(Strict):
    """Light that an object reflects as a mirror, in which other objects and other parts of itself appear.

    share : of the light, the same at all angles; albedo and share together are 1 at most. roughness : standard
    deviation of the slopes of the surface along any direction; 0 is a perfect mirror, 0.05 spreads the reflected light
    by about 6 degrees. Images of the projector itself are `specular`.
    """

    share: Fraction = 0.0
    roughness: Annotated[float, Field(ge=0, le=0.5)] = 0.0


class SceneObject(Strict):
    """Object with a pose (rotation about its own x, then y, then z axis as fixed axes) and a gloss."""

    name: str = ""
    position_mm: Triple = (0.0, 0.0, 0.0)
    rotation_deg: Triple = (0.0, 0.0, 0.0)
    specular: Specular = Specular()
    mirror: Mirror = Mirror()

    def require_energy(self, albedo: float) -> None:
        """Raise ValueError if the object would reflect more light than it receives."""
        if albedo + self.mirror.share > 1:
            message = f"albedo and mirror.share together must not exceed 1, found {albedo:g} and {self.mirror.share:g}"
            raise ValueError(message)

    def colours(self) -> tuple[Colour, Colour]:
        """Return the colours where a texture is light and where it is dark."""
        return WHITE, WHITE


class TexturedObject(SceneObject):
    """Object of uniform or textured albedo and colour."""

    albedo: Annotated[float, Field(gt=0, le=1)] = 0.8
    colour: Colour = WHITE
    texture: Texture = Texture()

    @model_validator(mode="after")
    def _check_energy(self) -> TexturedObject:
        self.require_energy(self.albedo)
        return self

    def material(self) -> tuple[float, ...]:
        """Return (8,): albedo, texture (index in TEXTURES), contrast, scale_mm, lobe strength, exponent, mirror share,
        roughness.
        """
        texture, lobe, mirror = self.texture, self.specular, self.mirror
        kind = float(TEXTURES.index(texture.kind))
        paint = (self.albedo, kind, texture.contrast, texture.scale_mm)
        return (*paint, lobe.strength, lobe.exponent, mirror.share, mirror.roughness)

    def colours(self) -> tuple[Colour, Colour]:
        """See `SceneObject`."""
        return self.colour, self.colour if self.texture.colour is None else self.texture.colour


ObjectT = TypeVar("ObjectT", bound=SceneObject)


def place_object(thing: ObjectT, position_mm: FloatArray, rotation: FloatArray) -> ObjectT:
    """Return the object in another pose. rotation : (3, 3), object to world."""
    x, y, z = (float(each) for each in position_mm)
    a, b, c = (float(each) for each in Rotation.from_matrix(rotation).as_euler("xyz", degrees=True))
    return thing.model_copy(update={"position_mm": (x, y, z), "rotation_deg": (a, b, c)})


def rotation_matrix(rotation_deg: Triple) -> FloatArray:
    """Return (3, 3) float64: object to world, from the rotation angles of a pose."""
    return np.asarray(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix(), np.float64)


@dataclass(frozen=True, slots=True)
class BoardPrint:
    """Print on a flat or bent sheet, in coordinates along it, mm, from the origin of its frame.

    across_mm, down_mm : (n,), (m,) float64, ascending lines; dark : (m - 1, n - 1) uint8, 1 where the rectangle between
    them is dark. centres_mm : (k, 2) float64, of dark discs of radius_mm instead. Everything else is light.
    dark_share : albedo of the dark over that of the light. curvature_per_mm : the sheet is z = curvature x²; 0 is flat.
    """

    across_mm: FloatArray
    down_mm: FloatArray
    dark: NDArray[np.uint8]
    centres_mm: FloatArray
    radius_mm: float
    dark_share: float
    curvature_per_mm: float


class PrintedBoard(SceneObject):
    """Calibration board: `shape = "board"`.

    kind, columns, rows : "chessboard" or "charuco" with this number of inner corners, or "circles": rows of circles,
    every other row shifted by half their distance. square_mm : side of a square, or distance of two rows of circles.
    marker_mm, dictionary : of a ChArUco board; default 0.75 of the square. circle_mm : diameter; default square_mm.
    margin_mm : light paper around the print. The pose is that of the centre of the corners.

    mirrored : the print is mirrored. scale : of the printer, in x and y; 1.05 makes 12 mm squares 12.6 mm wide.
    bow_mm : the sheet is bent about y; its middle is this much nearer to the devices than its left and right ends
    (negative: farther). The length along the bend is unchanged.
    """

    shape: Literal["board"]
    kind: Literal["chessboard", "charuco", "circles"]
    columns: Corners
    rows: Corners
    square_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str = "DICT_5X5_250"
    circle_mm: Positive | None = None
    margin_mm: NotNegative = 10.0
    albedo_light: Albedo = 0.85
    albedo_dark: Albedo = 0.05
    mirrored: bool = False
    scale: Annotated[tuple[Positive, Positive], Field(strict=False)] = (1.0, 1.0)
    bow_mm: float = 0.0

    @model_validator(mode="after")
    def _check_print(self) -> PrintedBoard:
        if self.albedo_dark >= self.albedo_light:
            message = "albedo_dark must be below albedo_light"
            raise ValueError(message)
        self.require_energy(self.albedo_light)
        if self.kind == "charuco":
            if not self._marker_mm < self.square_mm:
                message = f"marker_mm must be below square_mm, {self.square_mm} mm"
                raise ValueError(message)
            available, needed = len(self._markers().bytesList), (self.columns + 1) * (self.rows + 1) // 2
            if available < needed:
                message = (
                    f"the board needs {needed} markers, {self.dictionary} has {available}; choose a larger dictionary"
                )
                raise ValueError(message)
        elif self.marker_mm is not None:
            message = "marker_mm applies to ChArUco boards only; remove it"
            raise ValueError(message)
        half_mm = self.print_mm[:, 0] @ (-0.5, 0.5) + self.margin_mm
        if abs(self.bow_mm) > half_mm / 4:
            message = f"bow_mm must be at most a quarter of half the board's width, {half_mm / 4:.1f} mm"
            raise ValueError(message)
        return self

    @property
    def _marker_mm(self) -> float:
        return 0.75 * self.square_mm if self.marker_mm is None else self.marker_mm

    @property
    def _circle_mm(self) -> float:
        return self.square_mm if self.circle_mm is None else self.circle_mm

    def _markers(self) -> cv2.aruco.Dictionary:
        number: int | None = getattr(cv2.aruco, self.dictionary, None) if self.dictionary[:5] == "DICT_" else None
        if number is None:
            message = f"unknown dictionary {self.dictionary!r}; use one of OpenCV's: DICT_4X4_50, DICT_5X5_250, …"
            raise ValueError(message)
        return cv2.aruco.getPredefinedDictionary(number)

    @property
    def middle_mm(self) -> tuple[float, float]:
        """Centre of the corners measured from corner 0, as designed."""
        across = 2 * self.columns - 1 if self.kind == "circles" else self.columns - 1
        return across * self.square_mm / 2, (self.rows - 1) * self.square_mm / 2

    @property
    def corners_mm(self) -> FloatArray:
        """True positions of the corners (or circle centres) in the board's own frame, (n, 3) float64.

        They include the printer's scale and the bend. Corner 0 of a mirrored print is at the right.
        """
        row, column = (each.ravel() for each in np.mgrid[: self.rows, : self.columns])
        across = 2 * column + row % 2 if self.kind == "circles" else column
        designed = np.column_stack([across, row]) * self.square_mm - self.middle_mm
        along = designed * self.scale * (-1.0 if self.mirrored else 1.0, 1.0)
        return self.on_sheet_mm(along)

    @property
    def print_mm(self) -> FloatArray:
        """Smallest and largest (x, y) of the print along the sheet, without margin, (2, 2) float64."""
        border = self.square_mm if self.kind != "circles" else self.square_mm / 2 + self._circle_mm / 2
        reach = (np.array(self.middle_mm) + border) * self.scale
        return np.stack([-reach, reach])

    @property
    def paper_mm(self) -> FloatArray:
        """Smallest and largest (x, y) of the paper along the sheet, (2, 2) float64."""
        outwards = np.array([[-1.0], [1.0]])
        return self.print_mm + self.margin_mm * outwards

    @property
    def curvature_per_mm(self) -> float:
        """Curvature of the bent sheet: z = curvature x²."""
        half_mm = float(self.paper_mm[1, 0])
        # Fixed-point iteration: x of the ends depends on the curvature, which depends on x.
        reach = half_mm
        for _ in range(20):
            curvature = self.bow_mm / reach**2
            reach = float(x_at_arc_length_mm(np.array([half_mm]), curvature)[0])
        return self.bow_mm / reach**2

    def on_sheet_mm(self, along_mm: FloatArray) -> FloatArray:
        """Convert (n, 2) coordinates along the sheet into points of the board's own frame, (n, 3) float64."""
        curvature = self.curvature_per_mm
        x = x_at_arc_length_mm(along_mm[:, 0], curvature)
        return np.column_stack([x, along_mm[:, 1], curvature * x**2])

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the paper: a rectangle or a bent sheet."""
        least, most = self.paper_mm
        if self.bow_mm == 0:
            return [rectangle_between(least, most)]
        reach = float(x_at_arc_length_mm(most[:1], self.curvature_per_mm)[0])
        return [bent_sheet((-reach, reach), (least[1], most[1]), self.curvature_per_mm)]

    def material(self) -> tuple[float, ...]:
        """Return the material of the light paper, see `TexturedObject.material`."""
        lobe, mirror = self.specular, self.mirror
        return (self.albedo_light, 0.0, 0.0, 1.0, lobe.strength, lobe.exponent, mirror.share, mirror.roughness)

    def print_layout(self) -> BoardPrint:
        """Return the layout of the print."""
        ratio = self.albedo_dark / self.albedo_light
        if self.kind == "circles":
            row, column = (each.ravel() for each in np.mgrid[: self.rows, : self.columns])
            designed = np.column_stack([2 * column + row % 2, row]) * self.square_mm - self.middle_mm
            centres = designed * self.scale * (-1.0 if self.mirrored else 1.0, 1.0)
            none = np.zeros(2)
            # A printer that stretches unequally makes ellipses; they are approximated by discs of the mean radius.
            radius = self._circle_mm / 2 * float(np.sqrt(self.scale[0] * self.scale[1]))
            return BoardPrint(none, none, np.zeros((1, 1), np.uint8), centres, radius, ratio, self.curvature_per_mm)
        across, down, dark = self._rectangles()
        across, down = (across - self.middle_mm[0]) * self.scale[0], (down - self.middle_mm[1]) * self.scale[1]
        if self.mirrored:
            across, dark = -across[::-1], dark[:, ::-1]
        dark = np.ascontiguousarray(dark)
        return BoardPrint(across, down, dark, np.zeros((0, 2)), 0.0, ratio, self.curvature_per_mm)

    def _rectangles(self) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
        """Return the designed lines across and down from corner 0, mm, and which rectangles between them are dark."""
        squares = (np.indices((self.rows + 1, self.columns + 1)).sum(axis=0) + 1) % 2  # top left is dark
        if self.kind == "chessboard":
            across, down = (np.arange(-1.0, n + 1) * self.square_mm for n in (self.columns, self.rows))
            return across, down, squares.astype(np.uint8)
        markers = self._markers()
        modules = markers.markerSize + 2
        border = (self.square_mm - self._marker_mm) / 2
        inside = np.concatenate([[0.0], border + self._marker_mm * np.arange(modules + 1) / modules])
        across, down = (
            np.append((np.arange(-1, n)[:, None] * self.square_mm + inside).ravel(), n * self.square_mm)
            for n in (self.columns, self.rows)
        )
        size = modules + 2
        dark = np.kron(squares, np.ones((size, size), np.int64)).astype(np.uint8)
        # Markers fill the light squares, numbered row by row.
        for number, (row, column) in enumerate(np.argwhere(squares == 0)):
            drawn = markers.generateImageMarker(number, modules)
            top, left = row * size + 1, column * size + 1
            dark[top : top + modules, left : left + modules] = drawn == 0
        return across, down, dark


def arc_length_mm(x_mm: FloatArray, curvature_per_mm: float) -> FloatArray:
    """Length along z = c x² from 0 to x, mm: x √(1 + 4c²x²) / 2 + asinh(2 c x) / (4 c)."""
    if curvature_per_mm == 0:
        return x_mm
    steep = 2 * curvature_per_mm * x_mm
    return np.asarray(x_mm * np.sqrt(1 + steep**2) / 2 + np.arcsinh(steep) / (4 * curvature_per_mm), np.float64)


def x_at_arc_length_mm(along_mm: FloatArray, curvature_per_mm: float) -> FloatArray:
    """Invert `arc_length_mm` by Newton's method: x of the points at these lengths along z = c x², mm."""
    x = np.array(along_mm, np.float64)
    for _ in range(8):
        x = x - (arc_length_mm(x, curvature_per_mm) - along_mm) / np.sqrt(1 + (2 * curvature_per_mm * x) ** 2)
    return x


class PlaneObject(TexturedObject):
    """Rectangle in the object's x-y plane."""

    shape: Literal["plane"]
    size_mm: Annotated[tuple[Positive, Positive], Field(strict=False)]

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the rectangle."""
        return [shapes.rectangle(*self.size_mm)]


class Sphere(TexturedObject):
    """Ball about the object's origin. Rendering and truth use the exact sphere, not its facets."""

    shape: Literal["sphere"]
    radius_mm: Positive

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the ball."""
        return [shapes.ball(self.radius_mm)]


class BallBar(TexturedObject):
    """Two equal balls, with `distance_mm` between their centres along x, and the bar that joins them."""

    shape: Literal["ball_bar"]
    radius_mm: Positive
    distance_mm: Positive
    bar_radius_mm: Positive

    @model_validator(mode="after")
    def _check_clearance(self) -> BallBar:
        if self.distance_mm <= 2 * self.radius_mm or self.bar_radius_mm >= self.radius_mm:
            message = (
                f"the balls must not touch (distance_mm above {2 * self.radius_mm}), and the bar must be thinner than "
                "the balls"
            )
            raise ValueError(message)
        return self

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return two balls and a rod."""
        half = self.distance_mm / 2
        left = shapes.ball(self.radius_mm, centre_mm=(-half, 0.0, 0.0))
        right = shapes.ball(self.radius_mm, centre_mm=(half, 0.0, 0.0))
        return [left, right, shapes.rod(self.bar_radius_mm, self.distance_mm)]


class Stairs(TexturedObject):
    """Steps along x, each `rise_mm` nearer to the devices than its left neighbour, `height_mm` long in y."""

    shape: Literal["stairs"]
    steps: Annotated[int, Field(ge=1, le=1000)]
    tread_mm: Positive
    rise_mm: Positive
    height_mm: Positive

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return flat treads and risers."""
        return [shapes.staircase(self.steps, self.tread_mm, self.rise_mm, self.height_mm)]


class Groove(TexturedObject):
    """V groove: two flat walls of `wall_mm` depth that meet along y, `length_mm` long, and open towards -z.

    `opening_deg` is the angle between the walls. The edge is at the object's origin; rotation_deg = [0, 0, 90] turns it
    across.
    """

    shape: Literal["groove"]
    opening_deg: Annotated[float, Field(gt=0, lt=180)] = 90.0
    wall_mm: Positive
    length_mm: Positive

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the walls."""
        return [shapes.groove(np.deg2rad(self.opening_deg), self.wall_mm, self.length_mm)]


class Bowl(TexturedObject):
    """Inside of a spherical cap about the z axis that opens towards -z; its lowest point is the object's origin.

    `half_angle_deg` is the angle at the sphere's centre between the axis and the rim: 90 is half a sphere.
    """

    shape: Literal["bowl"]
    radius_mm: Positive
    half_angle_deg: Annotated[float, Field(gt=0, le=90)] = 80.0
    step_mm: Positive = 0.5

    @model_validator(mode="after")
    def _check_cell_count(self) -> Bowl:
        cells = 2 * np.pi * (self.radius_mm / self.step_mm) ** 2
        if cells > 4e6:
            message = f"radius_mm and step_mm give {cells:.0f} cells, the limit is 4000000; use a larger step_mm"
            raise ValueError(message)
        return self

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the inside."""
        return [shapes.bowl(self.radius_mm, np.deg2rad(self.half_angle_deg), self.step_mm)]


class Wave(Strict):
    """Sine wave of a relief: amplitude_mm * sin(2 pi s / wavelength_mm + phase), s along `direction_deg` from x."""

    amplitude_mm: float
    wavelength_mm: Positive
    direction_deg: float = 0.0
    phase_deg: float = 0.0


class ReliefBump(Strict):
    """Gaussian hill of a relief; a hollow if the height is negative."""

    centre_mm: Pair
    height_mm: float
    sigma_mm: Positive


class Relief(TexturedObject):
    """Height field over a rectangle: a sum of waves and bumps, sampled every `step_mm`."""

    shape: Literal["relief"]
    size_mm: Annotated[tuple[Positive, Positive], Field(strict=False)]
    step_mm: Positive = 0.5
    wave: Annotated[tuple[Wave, ...], Field(strict=False)] = ()
    bump: Annotated[tuple[ReliefBump, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _check_cell_count(self) -> Relief:
        cells = self.size_mm[0] * self.size_mm[1] / self.step_mm**2
        if cells > 4e6:
            message = f"size_mm and step_mm give {cells:.0f} cells, the limit is 4000000; use a larger step_mm"
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
        """Return the height field."""
        return [shapes.height_field(self.size_mm, self.step_mm, self.height_mm)]


class Vessel(TexturedObject):
    """Vessel of revolution about y: a smooth curve through (radius, height) points, optionally fluted.

    `flutes` grooves run along the axis and change the radius by ± `flute_depth_mm`, twisted by `twist_deg` over the
    height. Heights count upwards, against y.
    """

    shape: Literal["turned"]
    profile_mm: Annotated[tuple[Pair, ...], Field(strict=False)]
    flutes: Annotated[int, Field(ge=0)] = 0
    flute_depth_mm: NotNegative = 0.0
    twist_deg: float = 0.0
    step_mm: Positive = 0.5

    @model_validator(mode="after")
    def _check_profile(self) -> Vessel:
        if len(self.profile_mm) < 3:
            message = f"profile_mm needs at least 3 points, found {len(self.profile_mm)}"
            raise ValueError(message)
        radii, heights = zip(*self.profile_mm, strict=True)
        if min(radii) <= self.flute_depth_mm or any(b <= a for a, b in pairwise(heights)):
            message = "profile_mm needs rising heights and radii above flute_depth_mm"
            raise ValueError(message)
        return self

    def parts(self, _folder: Path) -> list[MeshPart]:
        """Return the outer wall of the open vessel."""
        profile = np.array(self.profile_mm)
        return [shapes.vessel(profile, self.flutes, self.flute_depth_mm, np.deg2rad(self.twist_deg), self.step_mm)]


class MeshFile(TexturedObject):
    """Triangle mesh from a file (STL, PLY, OBJ, GLB), in units of `unit_mm`, in its own frame.

    The frame of a GLB file is that of glTF: metres, y up. Use unit_mm = 1000 and rotation_deg = [180, 0, 0] for the
    mesh.glb of a scan. Edges sharper than `crease_deg` stay sharp in the shading.
    """

    shape: Literal["mesh"]
    file: str
    unit_mm: Positive = 1.0
    crease_deg: Annotated[float, Field(ge=0, le=180)] = 30.0

    def parts(self, folder: Path) -> list[MeshPart]:
        """Return the mesh. Raises ConfigError when the file cannot be read or contains no triangle."""
        return [shapes.mesh_file(folder / self.file, self.unit_mm, crease_rad=np.deg2rad(self.crease_deg))]


AnyObject = Annotated[
    PlaneObject | Sphere | BallBar | Stairs | Groove | Bowl | Relief | Vessel | MeshFile | PrintedBoard,
    Field(discriminator="shape"),
]


class Scene(Strict):
    """Scene file: a name and one or more objects.

    interreflection : diffuse light passes from each surface to the others, once. Mirrors (`Mirror`) work without it.
    """

    name: str = ""
    interreflection: bool = False
    object: Annotated[tuple[AnyObject, ...], Field(strict=False), AfterValidator(require_one)]


@dataclass(frozen=True, slots=True)
class SceneSurface:
    """The whole scene as triangles in the world, with materials by part.

    vertices_mm : (V, 3) float64; faces : (F, 3) int32; corner_normals : (F, 3, 3) float32, unit; part : (F,) int32.
    sphere_mm : (P, 4) float64, centre and radius of a ball; radius 0 for other parts.
    to_object : (P, 3, 4) float64, world to the object's own frame.
    material : (P, 8) float64: albedo, texture (index in TEXTURES), contrast, scale_mm, lobe strength, exponent, mirror
    share, roughness.
    colours : (P, 2, 3) float64, blue, green and red where a texture is light, and where it is dark.
    prints : print of each part that is a board. interreflection : as in `Scene`.
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
    interreflection: bool = False


def read_scene(path: Path) -> Scene:
    """Read a scene from a TOML file. Raises ConfigError that lists all faults."""
    return validate(Scene, read_toml(path, _MAX_FILE_BYTES), f"the scene file {path}")


def build_surface(scene: Scene, folder: Path) -> SceneSurface:
    """Build the triangles of a scene; paths of mesh files are relative to `folder`. Raises ConfigError."""
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
            prints[len(spheres)] = thing.print_layout()
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
        interreflection=scene.interreflection,
    )

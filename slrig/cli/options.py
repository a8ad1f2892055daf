"""Options that several commands share. Loads nothing heavy: `slrig --help` reads this file."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_type_hints

import typer
import typer.core

from slrig import KEY_VARIABLE
from slrig.errors import CalibrationError, ConfigError, SlrigError
from slrig.examples import rig_path

if TYPE_CHECKING:
    from slrig.client import Client

_NAMES = 30
"""Width of the column of options' names; longer ones have a line of their own."""


class SubjectsCommand(typer.core.TyperCommand):
    """A command of many options: its help has a heading for each subject (`rich_help_panel`)."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options without a subject, then the others subject by subject."""
        subjects: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for each in self.get_params(ctx):
            record = each.get_help_record(ctx)
            subject = getattr(each, "rich_help_panel", None) or "Options"
            if record is not None:
                named = "Arguments" if each.param_type_name == "argument" else subject
                subjects.setdefault(named, []).append(record)
        if len(subjects["Options"]) == 1:
            subjects["Help"] = subjects.pop("Options")
        widest = min(_NAMES, max(len(name) for rows in subjects.values() for name, _ in rows))
        for subject, rows in subjects.items():
            if rows:
                with formatter.section(subject):
                    formatter.write_dl([(name.ljust(widest), text) for name, text in rows], _NAMES)


RigFile = Annotated[
    Path, typer.Argument(metavar="RIG", callback=rig_path, help="Rig file, or the name of an example, such as demo.")
]
RigHere = Annotated[
    Path | None,
    typer.Argument(
        metavar="[RIG]",
        callback=rig_path,
        help="Rig file: the rig is opened here. Default: the rig of the running service.",
    ),
]
RigOption = Annotated[
    Path | None,
    typer.Option(
        "--rig",
        metavar="RIG",
        callback=rig_path,
        help="Rig file: run its service for this command alone. Default: a running one.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Unit = Annotated[
    Literal["mm", "cm", "m", "inch"] | None,
    typer.Option(help="Unit of the calibration's translations. Default: what its format states, otherwise mm."),
]
Keys = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WORDS",
        help="What the names of a calibration's file mean, and sizes that it lacks: 'camera=K1,D1,1280x1024 "
        "projector=K2,D2,1024x768 pose=R,T' (or pose=R,T,inverse). Default: found by shape and names.",
    ),
]


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """Address and key of a running service."""

    subject: ClassVar = "Service"

    url: Annotated[str, typer.Option(envvar="SLRIG_URL", help="Where the service is.")] = "http://127.0.0.1:8731"
    key_file: Annotated[
        Path | None,
        typer.Option(
            help="File that holds the service's API key. Default: SLRIG_API_KEY; your own service here needs none."
        ),
    ] = None

    def client(self) -> Client:
        """A client of it. Raises ConfigError."""
        from slrig.client import Client

        return Client(self.url, None if self.key_file is None else _read_key(self.key_file))


def _read_key(file: Path) -> str:
    """The API key that a file holds. Raises ConfigError."""
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        message = (
            f"The API key cannot be read from {file}: {error}. Name the file that holds it, or set {KEY_VARIABLE}."
        )
        raise ConfigError(message) from error


@dataclass(frozen=True, slots=True)
class BoardArguments:
    """A calibration board as far as the command line names it."""

    subject: ClassVar = "Board"

    kind: Annotated[
        Literal["charuco", "chessboard", "circles"] | None,
        typer.Option("--board", help="What is printed on the board. Default: charuco."),
    ] = None
    corners: Annotated[
        str | None,
        typer.Option(help="Inner corners across x down, as 11x8 (default); of circles, those of one row x rows."),
    ] = None
    square_mm: Annotated[
        float | None,
        typer.Option(
            help="Side of a square, mm, measured on the print (default 12); of circles, the distance of two rows."
        ),
    ] = None
    marker_mm: Annotated[
        float | None, typer.Option(help="Side of a marker of a ChArUco board, mm. Default: 0.75 of the square.")
    ] = None
    dictionary: Annotated[
        str | None, typer.Option(help="Markers of a ChArUco board, by OpenCV's name. Default DICT_5X5_250.")
    ] = None
    square_sigma: Annotated[
        float | None,
        typer.Option(help="Deviation of the print's width and height, over themselves. Default 0.001 (paper)."),
    ] = None
    measured_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="The printed scales as a ruler reads them: below the board, left of it."),
    ] = None


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """Options of a robot's poses and noise."""

    subject: ClassVar = "Robot"

    rotation: Annotated[
        str | None,
        typer.Option(help="What rx, ry, rz are: rotvec, or angles as xyz (about fixed axes), ZYX (turning along)."),
    ] = None
    robot_sigma: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="MM DEG", help="Noise of its poses. Default: estimated from the residuals."),
    ] = None
    base_frame: Annotated[str, typer.Option(help="Name of its base in ROS.")] = "base_link"
    flange_frame: Annotated[str, typer.Option(help="Name of its flange in ROS: what the poses are of.")] = "tool0"


@dataclass(frozen=True, slots=True)
class MeshOptions:
    """Options of a mesh."""

    subject: ClassVar = "Mesh"

    keep_holes: Annotated[
        bool | None,
        typer.Option("--keep-holes/--close-holes", help="Leave gaps within a stripe open, or close them (default)."),
    ] = None
    depth_edge_ratio: Annotated[
        float | None,
        typer.Option(help="Longest triangle edge, in sampling distances, above 1. Default 6; longer skins cliffs."),
    ] = None
    max_code_gap: Annotated[int | None, typer.Option(help="Mesh stripes up to this many columns apart. Default 1.")] = (
        None
    )
    flip_rule: Annotated[
        str | None, typer.Option(help="How edges of the mesh are flipped: constrained (default) or delaunay.")
    ] = None
    smooth_boundary: Annotated[
        bool | None,
        typer.Option(
            "--smooth-boundary/--raw-boundary", help="Shrink and smooth the mesh's boundary (default), or leave it."
        ),
    ] = None
    axis: Annotated[
        str | None, typer.Option(help="Triangulate by column or row. Default: what crosses the baseline.")
    ] = None
    region: Annotated[
        Path | None,
        typer.Option(help="TOML file of the measured region: box_mm, depth_mm and more. Default: all."),
    ] = None
    drop_finest_bits: Annotated[
        int | None,
        typer.Option(help="Finest Gray bits not to read where code edges give the points. Default: as resolved."),
    ] = None
    mesh_axes: Annotated[
        str | None,
        typer.Option(
            help="Axes of PLY, STL, OBJ, 3MF: upright, for viewers (default), rig, the calibration's, or robot."
        ),
    ] = None
    robot_pose: Annotated[
        Path | None,
        typer.Option(help="File with the flange's pose at this scan, of a rig in hand: see slrig calibrate hand-eye."),
    ] = None

    def request(self) -> dict[str, Any]:
        """The given options, as in a request. Raises ConfigError: the file of the region is wrong."""
        from slrig.bundle import read_region

        region = None if self.region is None else read_region(self.region).model_dump(mode="json", exclude_unset=True)
        return given(**{**asdict(self), "region": region, "robot_pose": None})

    def chosen(self) -> dict[str, Any]:
        """The given options, as in a plan. Raises ConfigError: the file of the region is wrong."""
        from slrig.bundle import read_region

        region = None if self.region is None else read_region(self.region).region()
        return given(**{**asdict(self), "region": region, "robot_pose": None})

    def flange(self) -> list[list[float]] | None:
        """The flange's pose, 4 x 4, mm. Raises CalibrationError: the file has none, or several."""
        if self.robot_pose is None:
            return None
        from slrig.importers import read_robot_poses

        poses = read_robot_poses(self.robot_pose).poses.tolist()
        if len(poses) != 1:
            message = f"--robot-pose {self.robot_pose}: expected one pose, that of this scan, found {len(poses)}"
            raise CalibrationError(message)
        return list(poses[0])


@dataclass(frozen=True, slots=True)
class GuessOptions:
    """Options of devices that are not calibrated; None where they are not given."""

    subject: ClassVar = "Without a calibration"

    uncalibrated: Annotated[
        bool, typer.Option("--uncalibrated", help="Calibrate by the scan itself: columns and rows, no board.")
    ] = False
    focal_px: Annotated[
        list[str] | None,
        typer.Option(metavar="CAMERA=PX", help="A camera's focal length, pixels: mm of the lens over mm of a pixel."),
    ] = None
    focal_sigma: Annotated[
        float | None, typer.Option(help="By how much these may be wrong, relative. Default 0.1.")
    ] = None
    throw_ratio: Annotated[
        float | None, typer.Option(help="Distance over width of the projector's picture, from its data sheet.")
    ] = None
    throw_sigma: Annotated[float | None, typer.Option(help="By how much that may be wrong, relative. Default 0.1.")] = (
        None
    )
    baseline_mm: Annotated[
        float | None, typer.Option(help="From the first camera's lens to the projector's. Default: the unit of length.")
    ] = None
    baseline_sigma: Annotated[
        float | None, typer.Option(help="By how much that may be wrong, relative. Default 0.01.")
    ] = None
    most_error: Annotated[
        float | None, typer.Option(help="Refuse a shape that is known less well, over its size. Default 0.0015.")
    ] = None

    def request(self) -> dict[str, Any] | None:
        """The given options, as in a request; None for a calibrated rig. Raises ConfigError: a guess without
        --uncalibrated, or --focal-px that is not CAMERA=PX.
        """
        guesses = {key: value for key, value in asdict(self).items() if key != "uncalibrated" and value is not None}
        if not self.uncalibrated:
            if guesses:
                name = next(iter(guesses)).replace("_", "-")
                message = f"--{name} is a guess for a rig without a calibration; add --uncalibrated, or leave it out"
                raise ConfigError(message)
            return None
        lengths = {}
        for each in guesses.pop("focal_px", ()):
            camera, _, value = each.partition("=")
            try:
                lengths[camera] = float(value)
            except ValueError as cause:
                message = f"--focal-px: expected CAMERA=PX, as left=1800, found '{each}'"
                raise ConfigError(message) from cause
        return {**guesses, "focal_px": lengths}


@dataclass(frozen=True, slots=True)
class AcceptanceOptions:
    """Options of artefacts and limits; None where they are not given. Lengths in mm."""

    subject: ClassVar = "Artefacts"

    sphere_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--sphere",
            metavar="MM MM",
            help="Certified diameter of the sphere and its expanded uncertainty (k = 2), mm.",
        ),
    ] = None
    bar_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--bar",
            metavar="MM MM",
            help="Certified distance of the ball bar's centres and its expanded uncertainty, mm.",
        ),
    ] = None
    plane_mm: Annotated[
        tuple[float, float] | None, typer.Option("--plane", metavar="MM MM", help="Length and width of the plane, mm.")
    ] = None
    ball_mm: Annotated[float | None, typer.Option(help="Diameter of the bar's balls. Default: the sphere's.")] = None
    sphere_form_mm: Annotated[
        float | None, typer.Option(help="By how much the sphere itself is out of round, from its certificate.")
    ] = None
    plane_form_mm: Annotated[
        float | None, typer.Option(help="By how much the plane itself is out of flat, from its certificate.")
    ] = None
    volume_mm: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--volume",
            metavar="X Y Z X Y Z",
            help="Working volume in the world: x y z of its least corner, then of its greatest, mm. "
            "Default: that of the calibration.",
        ),
    ] = None
    tolerance_mm: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            max=1000.0,
            help="What a point may be wrong by in what the rig is for; limits follow it. "
            "Default: the rig file's, or 1/5000 of the volume's diagonal.",
        ),
    ] = None
    spacing_limit_mm: Annotated[
        float | None, typer.Option(min=0.0, help="Limit of sphere spacing. Default: --tolerance-mm.")
    ] = None
    form_limit_mm: Annotated[
        float | None, typer.Option(min=0.0, help="Limit of probing form. Default: twice --tolerance-mm.")
    ] = None
    size_limit_mm: Annotated[
        float | None, typer.Option(min=0.0, help="Limit of probing size. Default: --tolerance-mm.")
    ] = None
    flatness_limit_mm: Annotated[
        float | None, typer.Option(min=0.0, help="Limit of flatness. Default: twice --tolerance-mm.")
    ] = None
    repeats: Annotated[
        int, typer.Option(min=1, max=50, help="Captures of the first position of each artefact, for the scatter.")
    ] = 3
    exposure_s: Annotated[float | None, typer.Option(help="Exposure of every camera. Default: the rig file's.")] = None
    certificate: Annotated[str, typer.Option(help="Numbers of the artefacts' certificates, for the report.")] = ""
    temperature_c: Annotated[
        float | None,
        typer.Option(
            help="Temperature of the artefacts: certified lengths hold at 20 °C. Default: about 20, not known well."
        ),
    ] = None
    expansion_per_k: Annotated[
        float | None,
        typer.Option(min=0.0, help="Thermal expansion of the artefacts per kelvin. Default: 11.5e-6, that of steel."),
    ] = None
    fixture_mm: Annotated[
        float,
        typer.Option(
            min=0.0, help="By how much an artefact may move or bend in its place while it is captured (k = 2)."
        ),
    ] = 0.0
    notes: Annotated[str, typer.Option(help="Free text for the report.")] = ""


def grouped(command: Callable[..., None], *, subjects: Mapping[str, str] | None = None) -> Callable[..., None]:
    """A command as typer reads it: an option for each field of a parameter that is a dataclass.

    subjects : names of options by the subject under which `SubjectsCommand` lists them; others have the `subject` of
    their class.
    """
    parameters = []
    named = {name: subject for subject, names in (subjects or {}).items() for name in names.split()}
    groups: dict[str, type] = {}
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        if not is_dataclass(hints[name]):
            annotation = _under(named.get(name), hints[name])
            parameters.append(parameter.replace(annotation=annotation, kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[name] = hints[name]
        options = get_type_hints(hints[name], include_extras=True)
        for each in fields(hints[name]):
            annotation = _under(named.get(each.name, hints[name].subject), options[each.name])
            kind = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter(each.name, kind, default=each.default, annotation=annotation))

    @functools.wraps(command)
    def flat(**options: Any) -> None:
        made = {
            name: kind(**{each.name: options.pop(each.name) for each in fields(kind)}) for name, kind in groups.items()
        }
        command(**options, **made)

    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return flat


def _under(subject: str | None, option: Any) -> Any:
    """The type of an option, with the subject under which help lists it."""
    if subject is None:
        return option
    described = copy(option.__metadata__[0])
    described.rich_help_panel = subject
    return Annotated[option.__origin__, described]


def given(**options: object) -> dict[str, object]:
    """The options that were given; the service, or the plan, knows the others' defaults."""
    return {name: value for name, value in options.items() if value is not None}


def period_option(sequence: str | None, period_px: int | None) -> dict[str, int | None]:
    """The option of a request that --period-px means with this sequence.

    >>> period_option("phase", 16), period_option(None, 16)
    ({'sine_period_px': 16}, {'line_shift_period_px': 16})
    """
    return {"sine_period_px" if sequence == "phase" else "line_shift_period_px": period_px}


def by_beginning(
    known: Sequence[Mapping[str, Any]], beginning: str, noun: str, refusal: type[SlrigError], *, none: str = "none"
) -> Mapping[str, Any]:
    """The one of a service's records with this beginning of its id. Raises `refusal`, with `none` if there are none."""
    found = [each for each in known if each["id"].startswith(beginning)]
    if len(found) == 1:
        return found[0]
    what = f"{len(found)} {noun}s'" if found else f"no {noun}'s"
    ids = ", ".join(each["id"][:8] for each in known[:10]) or none
    message = f"'{beginning}' is the beginning of {what} id; there are: {ids}"
    raise refusal(message)


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """Options of the object, of its light and of colour; None where they are not given."""

    subject: ClassVar = "Light and colour"

    preset: Annotated[str | None, typer.Option(help="Options by name: see slrig preset list.")] = None
    assist: Annotated[
        bool, typer.Option("--assist", help="Measure the object first, and expose as it needs; within --budget-s.")
    ] = False
    budget_s: Annotated[float | None, typer.Option(help="With --assist: the most that capture may take, seconds.")] = (
        None
    )
    colour: Annotated[
        bool | None, typer.Option(help="Keep white and black frames in colour. Default: where a camera has it.")
    ] = None
    coloured_light: Annotated[
        bool | None,
        typer.Option(
            help="Play white in red, green and blue too, for cameras without colour. Default: the rig file's."
        ),
    ] = None
    turn_deg: Annotated[
        float | None,
        typer.Option(help="Angle of the turntable that the object is shot at; the rig's turntable turns there first."),
    ] = None
    manual: Annotated[
        bool, typer.Option("--manual", help="With --turn-deg: the object was turned manually; nothing moves.")
    ] = False

    def request(self) -> dict[str, Any]:
        """The given options, as in a request."""
        return given(
            preset=self.preset,
            colour=self.colour,
            coloured_light=self.coloured_light,
            turn_deg=self.turn_deg,
            turned_by="hand" if self.manual else None,
        )

"""The plan of a model of several scans: frozen data, and its JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Annotated, Any, Literal, Self, cast
from uuid import UUID

from pydantic import Field, TypeAdapter

from slrig.bundle import TurnedBy, stored_json
from slrig.errors import ConfigError
from slrig.model import FloatArray
from slrig.scan.plan import ScanPlan, SeriesPlace

START_ERROR_MM = 3.0
"""See `slrig.multiview.registration.START_ERROR_MM`, which is not loaded where nothing is computed."""

MOST_UNKNOWN = 24
"""Most views with poses to be found: eight take 15 to 20 s, and the time grows with their square."""

MARKER_DICTIONARY = "DICT_5X5_250"
"""That of the boards, see `slrig.calibration.board.DEFAULT_DICTIONARY`."""

MOST_VIEWS = 72
"""Most views of a model that is shot: one every 5°; closer neighbours show the same."""

Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]


@dataclass(frozen=True, slots=True)
class StatedAxis:
    """A turntable's axis in the scans' frame: a point of it, mm, and its direction, of any length, about which angles
    count right-handed.

    Raises ConfigError: the direction has no length.
    """

    point_mm: Vector
    direction: Vector

    def __post_init__(self) -> None:
        if not 0 < math.hypot(*self.direction) < math.inf:
            message = f"direction: expected a vector with a length, found {self.direction}; a turntable turns about one"
            raise ConfigError(message)

    @classmethod
    def of(cls, point_mm: Iterable[float], direction: Iterable[float]) -> Self:
        """The same of any three numbers each."""
        (x, y, z), (a, b, c) = map(float, point_mm), map(float, direction)
        return cls((x, y, z), (a, b, c))


@dataclass(frozen=True, slots=True)
class TurntablePoses:
    """A turntable turned the object. axis : None is the turntable's own. angles_deg : where it stood at each scan;
    None is as the scans' reports say. of_turntable : the axis was filled in as the turntable's own.
    """

    axis: StatedAxis | None = None
    angles_deg: tuple[float, ...] | None = None
    of_turntable: bool = False
    kind: Literal["turntable"] = "turntable"


@dataclass(frozen=True, slots=True)
class GivenPoses:
    """Approximate poses of the scans are known. matrices : of each scan one that takes its mm to a common frame."""

    matrices: tuple[Matrix, ...]
    kind: Literal["given"] = "given"

    @classmethod
    def of(cls, poses: Iterable[FloatArray]) -> Self:
        """The same of (4, 4) each."""
        return cls(tuple(cast("Matrix", tuple(map(tuple, pose.tolist()))) for pose in poses))


@dataclass(frozen=True, slots=True)
class UnknownPoses:
    """The poses of the scans are found from their surfaces, or refused. At most MOST_UNKNOWN."""

    kind: Literal["unknown"] = "unknown"


@dataclass(frozen=True, slots=True)
class MarkerPoses:
    """The poses of the scans are found by markers that turn with the object. dictionary : OpenCV's name for theirs."""

    dictionary: str = MARKER_DICTIONARY
    kind: Literal["markers"] = "markers"


StartingPoses = TurntablePoses | GivenPoses | UnknownPoses | MarkerPoses


def turntable_angle(report: bytes) -> tuple[float, str | None] | None:
    """Angle of the turntable, deg, and the id of its zero, by a scan's report; None where it has none."""
    try:
        turntable = stored_json(report)["turntable"]
        return float(turntable["angle_deg"]), turntable.get("count")
    except (ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True, slots=True)
class ShootPlan:
    """Views to shoot for a model, evenly around a turntable. scan : each of them, except its angle.
    manual : a person turns the object, and says when.

    Raises ConfigError: there are fewer than two views, or more than MOST_VIEWS.
    """

    views: int
    scan: ScanPlan = field(default_factory=ScanPlan)
    manual: bool = False

    def __post_init__(self) -> None:
        if not 2 <= self.views <= MOST_VIEWS:
            message = f"views: expected 2 to {MOST_VIEWS}, found {self.views}; 8 is usual"
            raise ConfigError(message)

    @property
    def step_deg(self) -> float:
        """From one view to the next."""
        return 360 / self.views

    def angle_deg(self, number: int) -> float:
        """Angle of the turntable for a view, counted from 1."""
        return (number - 1) * self.step_deg

    def view(self, number: int, model_id: UUID, begins_at: datetime) -> ScanPlan:
        """The scan of a view, counted from 1."""
        place = SeriesPlace(model_id, number, self.views, begins_at)
        turned_by: TurnedBy = "hand" if self.manual else "table"
        return replace(self.scan, turn_deg=self.angle_deg(number), turned_by=turned_by, series=place)


@dataclass(frozen=True, slots=True)
class ModelPlan:
    """One model. scans : in the frame of the first one it is. poses : where their registration starts from.

    start_error_mm : how far a surface may be from where `poses` put it. voxel_mm : length of the model's edges; None is
    1.25 times that of the scans'. cut : whether what lies behind the planes of the turntable, where there are any, is
    cut away first. shoot : what is shot for it, None of scans that there were; until that has ended
    there are no `scans`, and given poses are of all views. notes : for the report, in sentences.

    Raises
    ------
    ConfigError
        There are fewer than two scans, or one comes twice; angles or poses are not as many; or a length is not above 0
        and finite.
    """

    scans: tuple[UUID, ...]
    poses: Annotated[StartingPoses, Field(discriminator="kind")] = field(default_factory=TurntablePoses)
    start_error_mm: float = START_ERROR_MM
    voxel_mm: float | None = None
    cut: bool = True
    shoot: ShootPlan | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.scans) < 2 and not self.being_shot:
            message = f"scans: expected two or more, found {len(self.scans)}; scan the object turned"
            raise ConfigError(message)
        twice = next((scan for scan in self.scans if self.scans.count(scan) > 1), None)
        if twice is not None:
            message = f"scans: expected each once, found {twice} twice; leave one out"
            raise ConfigError(message)
        count = self.shoot.views if self.shoot is not None and self.being_shot else len(self.scans)
        if isinstance(self.poses, UnknownPoses) and count > MOST_UNKNOWN:
            message = (
                f"poses: expected at most {MOST_UNKNOWN} views with unknown poses, found {count}; each is compared "
                "with all others. Give poses, or a turntable's axis and angles, or take fewer"
            )
            raise ConfigError(message)
        name = "poses" if isinstance(self.poses, GivenPoses) else "angles_deg"
        given: Sequence[object] | None = None
        if isinstance(self.poses, GivenPoses):
            given = self.poses.matrices
        elif isinstance(self.poses, TurntablePoses):
            given = self.poses.angles_deg
        if given is not None and len(given) != count:
            message = f"{name}: expected one for each of {count} scans, in their order, found {len(given)}"
            raise ConfigError(message)
        for name, length_mm in (("start_error_mm", self.start_error_mm), ("voxel_mm", self.voxel_mm)):
            if length_mm is not None and not 0 < length_mm < math.inf:
                message = f"{name}: expected a finite length above 0 mm, found {length_mm:g}; left out, it is as usual"
                raise ConfigError(message)

    @property
    def being_shot(self) -> bool:
        """Whether its scans are still to come."""
        return self.shoot is not None and not self.scans


_adapter = TypeAdapter(ModelPlan)


def plan_json(plan: ModelPlan) -> dict[str, Any]:
    """The plan as JSON values.

    >>> plan = ModelPlan((UUID(int=1), UUID(int=2)), TurntablePoses(angles_deg=(0.0, 45.0)))
    >>> plan_from_json(plan_json(plan)) == plan
    True
    """
    document: dict[str, Any] = _adapter.dump_python(plan, mode="json")
    return document


def plan_from_json(document: Mapping[str, Any]) -> ModelPlan:
    """The inverse of `plan_json`."""
    return _adapter.validate_python(document)


MODEL, MODEL_GLB, PLACED, POSES, REPORT = "model.ply", "model.glb", "placed.ply", "poses.json", "report.json"


SIDES, VIEW, COARSE = "sides.png", "view.glb", "coarse.glb"


MEDIA_TYPES: Mapping[str, str] = {
    MODEL: "application/octet-stream",
    MODEL_GLB: "model/gltf-binary",
    PLACED: "application/octet-stream",
    POSES: "application/json",
    SIDES: "image/png",
    VIEW: "model/gltf-binary",
    COARSE: "model/gltf-binary",
    REPORT: "application/json",
}
"""Media types of the files of every model that succeeded."""


REPORT_FORMAT = "slrig-model"
"""Format of its report, which is not that of a scan: a model never replaces one."""

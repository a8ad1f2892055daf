"""What a check of the driver contract is: what it asks, what a rig must have for it, and the function that does it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import wraps

from slrig.conformance.bench import RigBench, View
from slrig.conformance.expectation import STEPPED, NotApplicableError
from slrig.devices import Rig, Trigger
from slrig.model import Black, PatternSequence, White


class Need(Enum):
    """What a rig must have for a check to say anything."""

    STEPPED = "a camera with software trigger or a free-running one"
    SOFTWARE = "a camera with software trigger"
    FREE = "a free-running camera"
    HARDWARE = "a camera that is triggered by wire"
    PLAYS = "a projector that plays sequences by itself, and a camera that it triggers by wire"
    WHITE_AND_BLACK = "a sequence that begins with white and black"
    POSITIONER = "a positioner"

    def unmet(self, rig: Rig, sequence: PatternSequence) -> str | None:
        """Why the check does not apply to this rig, in words; None if it does."""
        declared = {trigger for camera in rig.cameras.values() for trigger in camera.info.triggers}
        met: bool
        match self:
            case Need.STEPPED:
                met = not declared.isdisjoint(STEPPED)
            case Need.SOFTWARE:
                met = Trigger.SOFTWARE in declared
            case Need.FREE:
                met = Trigger.FREE in declared
            case Need.HARDWARE:
                met = Trigger.HARDWARE in declared
            case Need.PLAYS:
                met = rig.projector.info.plays and Trigger.HARDWARE in declared
            case Need.WHITE_AND_BLACK:
                met = sequence.patterns[:2] == (White(), Black())
            case Need.POSITIONER:
                met = rig.positioner is not None
        return None if met else f"it needs {self.value}"


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that the contract asks of the devices of a rig.

    title : in plain words. needs : what the rig must have. fresh : whether it wants a rig that was opened just now, and
    is closed afterwards; the others share one. function : raises ExpectationError or NotApplicableError.
    """

    name: str
    title: str
    needs: tuple[Need, ...]
    fresh: bool
    function: Callable[[RigBench], None]


def check(*needs: Need, fresh: bool = False) -> Callable[[Callable[[RigBench], None]], Check]:
    """Make a check of the function below: its name is the check's, its docstring's first line the title."""

    def made(function: Callable[[RigBench], None]) -> Check:
        name = function.__name__
        # Python may be told to leave docstrings out.
        title = (function.__doc__ or name.replace("_", " ")).splitlines()[0].removesuffix(".")
        return Check(name, title, needs, fresh, function)

    return made


def view_check(*needs: Need, every: bool = False) -> Callable[[Callable[[View], None]], Check]:
    """Make a check of what the function below asks of one camera before the projector: each of `RigBench.ways`.

    It applies where it does to one of them.
    """

    def made(function: Callable[[View], None]) -> Check:
        @wraps(function)
        def of_each(bench: RigBench) -> None:
            reasons: list[str] = []
            applies = False
            for name, trigger in bench.ways(every=every):
                with bench.view(name, trigger) as view:
                    try:
                        function(view)
                        applies = True
                    except NotApplicableError as reason:
                        reasons.append(f"camera '{name}' {reason}")
            if not applies:
                raise NotApplicableError("; ".join(reasons))

        return check(Need.STEPPED, *needs)(of_each)

    return made

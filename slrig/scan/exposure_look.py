"""Looks at what stands before a rig, under white and black light at a few exposures, and what they propose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from statistics import geometric_mean, median

import numpy as np

from slrig.capture import Evidence, Sampler, capture, round_to_refresh_s
from slrig.devices import CameraSettings, Rig
from slrig.errors import RigBusyError, UnsupportedByDeviceError
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder
from slrig.model import Black, Shot, White
from slrig.patterns import encode
from slrig.rig.session import RigSession
from slrig.scan.exposure_proposal import WELL_CLEAR, Look, Proposal, SeenObject, proposal, seen_object
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import rig_sequence

LONGEST_S = 1.0
"""No look exposes longer; a scan of thirty frames would take half a minute."""

_STEP = 4.0  # from look to look: two exposures so far apart share two thirds of the range of 8 bits
_SOME = 0.002  # of the lit pixels: less is a highlight or two
_PATTERNS = (White(), Black(), White(), Black())


class _Unjudged(Evidence):
    """Takes frames as they are: at an exposure that is far off, white and black prove nothing, and tell what to try."""

    def add_shot(self, shot: Shot) -> tuple[()]:  # noqa: ARG002 - as it is called
        return ()


class Looking:
    """Looks through all cameras of an open rig. overheads_s : what a frame takes beside its exposure, of each look."""

    def __init__(self, rig: Rig, *, cancelled: Callable[[], bool]) -> None:
        self._rig = rig
        self._cancelled = cancelled
        self._samplers = {name: Sampler.from_size(camera.info.format.size) for name, camera in rig.cameras.items()}
        self._looks: dict[float, Mapping[str, Look]] = {}
        self._refused_shorter = False
        self.overheads_s: list[float] = []

    def seen(self) -> Mapping[str, SeenObject]:
        """What each camera has seen so far."""
        return {
            name: seen_object([look[name] for look in self._looks.values()], camera.info.format.full_scale)
            for name, camera in self._rig.cameras.items()
        }

    def look(self) -> None:
        """Look at the rig's own exposure, at shorter ones while something is saturated, and at longer ones while
        something is not clear.
        """
        own_s = self._fitting(geometric_mean(each.exposure_s for each in self._rig.settings.values()))
        self._take(own_s)
        for step, wanted in ((1 / _STEP, _saturated), (_STEP, _unclear)):
            exposure_s = own_s
            while wanted(self.seen(), exposure_s):
                next_s = self._fitting(exposure_s * step)
                if next_s in self._looks:
                    break
                try:
                    self._take(next_s)
                except UnsupportedByDeviceError:
                    # Between two that it can use, or beyond what the projector can.
                    self._refused_shorter |= step < 1
                    break
                exposure_s = next_s

    def candidates_s(self) -> list[float]:
        """The exposures that were looked at, those in the middle between them, and one shorter by half a step, for
        little time. None is longer than what was looked at, nor shorter where that was refused: a projector may not do
        it, and only a look tells.
        """
        around = (each * factor for each in self._looks for factor in (_STEP**-0.5, 1.0, _STEP**0.5))
        least_s = min(self._looks) if self._refused_shorter else 0.0
        rising = sorted(each for each in set(map(self._fitting, around)) if least_s <= each <= max(self._looks))
        return [each for before, each in pairwise([0.0, *rising]) if each > 1.05 * before]

    def _fitting(self, exposure_s: float) -> float:
        """The nearest exposure that all cameras can do and the projector's light is steady over."""
        ranges_s = [camera.info.exposure_range_s for camera in self._rig.cameras.values()]
        least_s, most_s = max(low for low, _ in ranges_s), min(LONGEST_S, *(high for _, high in ranges_s))
        within_s = min(max(exposure_s, least_s), most_s)
        return round_to_refresh_s(within_s, self._rig.projector.info.refresh_s, ranges_s)

    def _take(self, exposure_s: float) -> None:
        rig, size = self._rig, self._rig.projector.info.size
        settings = {
            name: replace(rig.settings.get(name, CameraSettings(exposure_s)), exposure_s=exposure_s)
            for name in rig.cameras
        }
        unjudged = _Unjudged(_PATTERNS, {name: camera.info.format for name, camera in rig.cameras.items()})
        shots = {
            (shot.pattern, shot.camera): shot
            for shot in capture(
                replace(rig, settings=settings), encode(_PATTERNS, size), cancelled=self._cancelled, evidence=unjudged
            )
        }
        taken = {}
        for name, sampler in self._samplers.items():
            white, black = (
                np.array([sampler.take(shots[index, name].image) for index in pair]) for pair in ((0, 2), (1, 3))
            )
            taken[name] = Look(exposure_s, white, black)
            times_s = [time_s for i in range(4) if (time_s := shots[i, name].time_s) is not None]
            self.overheads_s += [max(after - before - exposure_s, 0.0) for before, after in pairwise(times_s)]
        self._looks[exposure_s] = taken


def _saturated(seen: Mapping[str, SeenObject], exposure_s: float) -> bool:
    return any(
        float(each.clearness(exposure_s)[1][each.lit].mean()) > _SOME for each in seen.values() if each.lit.any()
    )


def _unclear(seen: Mapping[str, SeenObject], exposure_s: float) -> bool:
    """Whether a camera sees little at this exposure, or not all of it well, although it is not all saturated."""
    for each in seen.values():
        clear, saturated = each.clearness(exposure_s)
        if not each.lit.any() or float(np.mean(each.lit & ~saturated & (clear < WELL_CLEAR))) > _SOME:
            return True
    return False


def proposed_exposures(manager: JobManager, plan: ScanPlan, *, budget_s: float | None) -> Proposal:
    """Take the rig for some seconds, look, and propose exposures for a scan of a plan's patterns.

    Raises
    ------
    RigBusyError
        Somebody has the rig: it is looked at at once, or not at all.
    ConfigError
        See `proposal`.
    DeviceError, ScanInterruptedError
        As a scan does.
    """

    def look(held: RigSession, cancelled: Callable[[], bool]) -> tuple[Looking, int]:
        rig = held.open()
        frames = len(rig_sequence(plan, rig))
        looking = Looking(rig, cancelled=cancelled)
        looking.look()
        return looking, frames

    try:
        looking, frames = manager.lend(Holder("exposure", "a look at exposures, which takes seconds", None), look)
    except RigBusyError as error:
        message = (
            f"The rig is held by {error.holder} since {error.since}, and an object is looked at at once or not at all. "
            "Ask again when the rig is free"
        )
        raise RigBusyError(message, holder=error.holder, since=error.since) from error
    # The rig is free again.
    return proposal(
        looking.seen(), looking.candidates_s(), frames=frames, overhead_s=median(looking.overheads_s),
        budget_s=budget_s,
    )  # fmt: skip

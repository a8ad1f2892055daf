"""Projectors that break the contract, each in one way."""

from __future__ import annotations

from dataclasses import replace

from slrig.devices import Shown
from slrig.model import PatternSequence, Pixels
from tests.unit.conformance.model_rig import ERROR_NS, LATENCY_NS, ModelProjector, World, sequence


class StaysLit(ModelProjector):
    """Does not go dark."""

    def blank(self) -> None:
        """Do nothing."""


class StaysLitWhileLoading(ModelProjector):
    """Goes on showing the old sequence when it is given a new one."""

    def load(self, sequence: PatternSequence) -> None:
        changes = list(self.world.changes)
        super().load(sequence)
        self.world.changes = changes


class StaysLitAfterClose(ModelProjector):
    """Is let go while it shines."""

    def close(self) -> None:
        self.loaded, self.closed = None, True


class ShinesFromTheStart(ModelProjector):
    """Shows its logo."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        world.change(0, sequence().profiles[0])


class LightsLate(ModelProjector):
    """A display that is slower than its driver believes."""

    def show(self, index: int) -> Shown:
        profile = self.profile(index)
        at_ns = self.world.at_ns + LATENCY_NS
        self.world.change(at_ns + 40_000_000, profile)
        self.world.at_ns = at_ns + ERROR_NS
        return Shown(index, at_ns, ERROR_NS)


class ReturnsEarly(ModelProjector):
    """Returns from show a second before there is light, and declares less latency."""

    def show(self, index: int) -> Shown:
        shown = super().show(index)
        return replace(shown, t_visible_ns=shown.t_visible_ns + 10**9)


class TellsTheNextPattern(ModelProjector):
    """Counts from 1."""

    def show(self, index: int) -> Shown:
        shown = super().show(index)
        return Shown(index + 1, shown.t_visible_ns, shown.t_err_ns)


class ShowsWithoutSequence(ModelProjector):
    """Shows nothing where nothing is loaded, and does not say so."""

    def show(self, index: int) -> Shown:
        if self.loaded is None and not self.closed:
            return Shown(index, self.world.at_ns, 0)
        return super().show(index)


class CountsFromTheEnd(ModelProjector):
    """Takes index -1 for the last pattern, as lists do."""

    def profile(self, index: int) -> Pixels:
        return super().profile(index % len(self.loaded) if self.loaded is not None else index)


class ScalesPatterns(ModelProjector):
    """Takes sequences for any size."""

    def load(self, sequence: PatternSequence) -> None:
        super().load(PatternSequence(self.info.size, sequence.patterns, sequence.profiles))


class PlaysSilently(ModelProjector):
    """Does as if it could play."""

    plays = False

    def play(self, exposure_s: float, period_s: float) -> None:
        self.require()
        assert exposure_s < period_s


class PlaysUnloaded(ModelProjector):
    """Plays nothing where nothing is loaded."""

    def play(self, exposure_s: float, period_s: float) -> None:
        if self.loaded is not None or self.closed:
            super().play(exposure_s, period_s)


class PulsesOnceMore(ModelProjector):
    """Makes a pulse when it is ready, and so one more than there are patterns."""

    def pulse(self, index: int, at_ns: int) -> None:
        super().pulse(index, at_ns)
        if self.loaded is not None and index + 1 == len(self.loaded):
            super().pulse(index, at_ns + 1)


class PlaysOn(ModelProjector):
    """Does not end a sequence that it plays."""

    def stop(self) -> None:
        self.blank()


class SwapsPatterns(ModelProjector):
    """Has two patterns in each other's place."""

    def profile(self, index: int) -> Pixels:
        return super().profile({6: 8, 8: 6}.get(index, index))

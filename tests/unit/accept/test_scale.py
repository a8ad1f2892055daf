"""Whether a certified bar shows a scale that is wrong, and nothing else as one."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from slrig.accept.evaluation import Evidence, Reading
from slrig.accept.plan import Artefacts, Certified, Quantity
from slrig.accept.report import document, report_html
from slrig.accept.scale import scale_by_bar
from slrig.accept.verdicts import AcceptanceResult, verdicts
from slrig.cli.accept import tell
from tests.unit.accept.test_plan import GOOD
from tests.unit.accept.test_running import PLAN, RIG

LENGTH_MM = 110.0
BAR = replace(GOOD, distance=Certified(LENGTH_MM, 0.002), expansion_per_k=0.0)

POINTS = Evidence(np.array([[0.0, 0.0, 0.0]]), np.ones(1, np.uint8), np.zeros(1), np.zeros(1))


def told(step: str, take: int, error_mm: float) -> Reading:
    return Reading(step, take, {Quantity.SPACING: error_mm}, 0.005, 0.005, 0.02, 9, 0, 0.0)


def measured(share: float, *, scatter_mm: float = 0.004, places: int = 7, seed: int = 3) -> list[Reading]:
    """A bar in places, the first measured three times, by a rig that measures everything too long by a share."""
    off = np.random.default_rng(seed).normal(share * LENGTH_MM, scatter_mm, places)
    first = [told("bar-1", take, off[0]) for take in range(3)]
    return [*first, *(told(f"bar-{place + 1}", 0, off[place]) for place in range(1, places))]


@pytest.mark.parametrize(("share", "words"), [(0.002, "longer .* so much smaller"), (-0.009, "shorter .* larger")])
def test_a_board_of_another_size_is_named(share: float, words: str) -> None:
    found = scale_by_bar(measured(share), BAR)
    assert found is not None
    assert found.places == 7
    assert abs(found.share - share) < 3 * found.sigma < 1e-4
    assert found.words is not None
    assert re.search(words, found.words)
    assert f"{abs(found.share):.2%}" in found.words


@pytest.mark.parametrize("share", [0.0, 0.0008])
def test_less_than_a_thousandth_is_stated_and_not_blamed_on_the_board(share: float) -> None:
    found = scale_by_bar(measured(share), BAR)
    assert found is not None
    assert found.share == pytest.approx(share, abs=5e-5)
    assert found.words is None


@pytest.mark.parametrize("artefacts", [BAR, replace(BAR, distance=Certified(LENGTH_MM, 0.2))])
def test_what_the_places_or_the_certificate_do_not_tell_is_not_told(artefacts: Artefacts) -> None:
    scattered = artefacts is BAR
    found = scale_by_bar(measured(0.002, scatter_mm=0.4 if scattered else 0.004), artefacts)
    assert found is not None
    assert found.sigma > 0.0008
    assert found.words is None


def test_a_scale_is_not_told_from_two_places() -> None:
    assert scale_by_bar(measured(0.01, places=2), BAR) is None
    sphere = Reading("sphere-1", 0, {Quantity.SIZE: 0.3}, 0.005, 0.005, 0.02, 9, 0, 0.0)
    assert scale_by_bar([sphere], BAR) is None


def test_a_person_is_told_of_a_wrong_scale_on_terminal_and_page() -> None:
    when = datetime(2026, 11, 27, tzinfo=UTC)

    def result(share: float) -> AcceptanceResult:
        readings = tuple(measured(share))
        return AcceptanceResult("bench", when, when, PLAN, RIG, readings, verdicts(readings, PLAN))

    for each, wrong in ((result(0.002), True), (result(0.0), False)):
        terminal = Console(file=StringIO(), width=300)
        tell(each, terminal)
        page = report_html(each, lambda _: POINTS)
        assert isinstance(terminal.file, StringIO)
        for text in (terminal.file.getvalue(), page):
            assert ("The bar measures 0.20" in text) is wrong
        assert document(each)["scale"] == each.scale

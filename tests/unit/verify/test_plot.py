"""The plot of health over time: every state, thresholds, recalibrations, nothing at all."""

from __future__ import annotations

from dataclasses import replace
from uuid import UUID
from xml.etree import ElementTree

import numpy as np

from slrig.calibration.health.verdict import judged
from slrig.calibration.health.verification import Verification
from slrig.verify.plot import health_svg
from slrig.verify.store import VerificationRecord
from tests.unit.verify.health_bench import a_verification, hours

parsed = ElementTree.fromstring
_SVG = "{http://www.w3.org/2000/svg}"


def warm_up() -> list[VerificationRecord]:
    """A rig that warms up, is calibrated again, and is then knocked."""
    rng = np.random.default_rng(0)
    records: list[VerificationRecord] = []
    verifications: list[Verification] = []
    for number in range(60):
        if number in (0, 36):
            verifications = []
        share = 1 - np.exp(-number / 12)
        scatter = rng.normal(0, 0.04)
        if number < 36:
            found = a_verification(1 + 2.4 * share + scatter, mean_px=0.14 * share + scatter / 9, evidence=30 * share)
        else:
            found = (
                a_verification(1 + scatter, mean_px=scatter / 9)
                if number < 54
                else a_verification(4.4, mean_px=0.42, evidence=900)
            )
        verifications.append(found)
        name = "one" if number < 36 else "two"
        records.append(
            VerificationRecord(number, UUID(int=number), hours(number / 4), name, found, judged(verifications))
        )
    return records


def test_every_verification_is_a_dot_in_the_colour_of_its_state() -> None:
    records = warm_up()
    picture = parsed(health_svg(records))
    dots = [dot for dot in picture.iter(f"{_SVG}circle") if dot.find(f"{_SVG}title") is not None]
    assert len(dots) == 60
    for dot, record in zip(dots, records, strict=True):
        told = dot.find(f"{_SVG}title")
        assert told is not None
        assert f": {record.health.state}." in (told.text or "")
    # The worse the error, the higher the dot.
    heights = [float(dot.get("cy", "nan")) for dot in dots]
    assert heights[30] < heights[0] - 20
    assert len({dot.get("fill") for dot in dots}) == 3


def test_thresholds_and_the_recalibration_are_named() -> None:
    texts = [text.text for text in parsed(health_svg(warm_up())).iter(f"{_SVG}text")]
    for words in ("stated", "watch, 1.4 x", "stale, 3 x", "watch (mean)", "stale (mean)"):
        assert words in texts
    assert texts.count("calibrated") == 1
    assert "left - projector" in texts
    odd = VerificationRecord(1, UUID(int=1), hours(0), "<b>", warm_up()[0].found, judged([]))
    assert "<b>" not in health_svg([odd, warm_up()[0]])
    assert len(list(parsed(health_svg(warm_up()[:1])).iter(f"{_SVG}circle"))) >= 1
    assert "Nothing was verified yet" in health_svg([])


def test_a_calibration_that_states_no_error_has_no_axis_of_it() -> None:
    record = warm_up()[0]
    silent = replace(record, found=replace(record.found, expected_mm=0.0, stated_mm=None))
    assert "No verification tells an expected error" in health_svg([silent])
    assert "Expected error of a scan, mm" not in health_svg([silent])
    assert "No verification tells an expected error" not in health_svg([silent, record])

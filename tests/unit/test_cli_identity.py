"""What the command line says of the frames of a scan."""

from __future__ import annotations

from slrig.cli.quality import quality_lines
from slrig.scan.records import report_summary


def test_how_many_patterns_were_verified_is_told() -> None:
    report = {"method": "Gray-only", "identity": "28/28 patterns verified, 2 frames shot again"}
    assert quality_lines(report_summary(report)) == ["frames    28/28 patterns verified, 2 frames shot again"]


def test_a_summary_of_an_earlier_version_says_nothing_of_it() -> None:
    assert quality_lines({"method": "Gray-only"}) == []

"""Text and dates of strangers: nothing in them acts on a terminal, and a number is no date."""

from __future__ import annotations

import unicodedata
from datetime import UTC, datetime

import pytest
from pydantic import TypeAdapter, ValidationError

from slrig.bundle.validation import AwareMoment, FreeText, Moment
from slrig.printable import printable

LABEL: TypeAdapter[str] = TypeAdapter(FreeText)
ACTING = [
    chr(code)
    for code in range(0x10000)
    if unicodedata.category(chr(code)) in {"Cc", "Zl", "Zp"}
    or unicodedata.bidirectional(chr(code)) in {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
]
"""By Unicode's own tables: NUL, ESC, DEL, C1, ends of lines and paragraphs, overrides and isolates of direction."""


def test_control_characters_are_refused_in_labels_and_printed_as_escapes() -> None:
    assert len(ACTING) == 65 + 2 + 9
    for character in ACTING:
        with pytest.raises(ValidationError, match=f"U\\+{ord(character):04X} at character 3; leave it out"):
            LABEL.validate_python(f"my{character}part")
        assert printable(f"my{character}part") == f"my\\u{ord(character):04x}part"


@pytest.mark.parametrize("label", ["part 3 (5 µm), α", "חלק\u200f 3", "می\u200cخواهم", "👩\u200d🔬", "x" * 200])
def test_text_of_any_script_is_a_label(label: str) -> None:
    assert LABEL.validate_python(label) == printable(label) == label


@pytest.mark.parametrize("sent", ["0.5", "20260101", " 1e5", "-3", "1_000", 0.5, 3])
def test_number_is_no_date(sent: object) -> None:
    for moment in (Moment, AwareMoment):
        with pytest.raises(ValidationError, match=r"expected a date and time .* found the number"):
            TypeAdapter(moment).validate_python(sent)


def test_date_is_read_with_its_offset() -> None:
    asked = TypeAdapter(AwareMoment)
    assert asked.validate_python("2026-11-20T07:00:00+01:00") == datetime(2026, 11, 20, 6, tzinfo=UTC)
    with pytest.raises(ValidationError, match="timezone"):
        asked.validate_python("2026-11-20T06:00:00")

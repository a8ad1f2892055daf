"""A scan as a notebook shows it."""

from __future__ import annotations

import re
from base64 import b64encode
from html import unescape
from typing import Any

from slrig.client.notebook import shown
from tests.unit.client.service import SCAN, Walk, client_of

GLB = b"glTF of a scan"
SUMMARY = {
    "notes": ["camera 'left': <slow>"],
    "mesh": {
        "figures": {"vertices": 42734, "triangles": 84632, "area_mm2": 14241.6},
        "sigma_mm": {"p50": 0.0171, "p95": 0.0183},
        "covers_of_decoded": 0.978,
    },
}
FULL: dict[str, Any] = {
    **SCAN,
    "label": "<b>cup</b>",
    "summary": SUMMARY,
    "links": {**SCAN["links"], "files": {"causes-left.png": "", "causes-right.png": ""}},
}


def test_table_shows_the_figures_and_escapes_labels() -> None:
    found = shown(FULL, None)
    text = unescape(re.sub(r"<[^>]*>", "|", found))
    for words in (
        "<b>cup</b> 5f",
        "bench: left, right",
        "42,734",
        "84,632 on 142.4 cm²",
        "0.0171 mm",
        "97.8%",
        "<slow>",
    ):
        assert words in text, words
    assert "<b>" not in found


def test_a_scan_of_which_little_is_known_is_shown_too() -> None:
    assert "5f" in shown(SCAN, None)
    unknown = {"notes": [], "mesh": {"sigma_mm": {"p50": None, "p95": None}}}
    assert "deviation" not in shown({**FULL, "summary": unknown}, None)


def test_the_view_is_whole_and_asks_for_nothing() -> None:
    found = shown(FULL, GLB)
    (page,) = re.findall(r"srcdoc='([^']*)'", found)
    page = unescape(page)
    assert b64encode(GLB).decode() in page
    assert not re.findall(r"https?:|//|\bimport\b|\bfetch\b|src=", re.sub(r"^ *//.*$", "", page, flags=re.MULTILINE))
    assert "sandbox='allow-scripts'" in found


def test_a_result_is_shown_with_its_mesh() -> None:
    assert "<iframe" in client_of(Walk(coarse_glb=GLB)).result("5f")._repr_html_()
    assert "<iframe" not in client_of(Walk()).result("5f")._repr_html_()
